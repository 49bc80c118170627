"""`rlctl robot`."""

from rlctl.arguments import command_in_panels, parse_changes
from rlctl.evaluation.eval_request import Gates, MinReturn, MinSuccess, MinSuccessLower
from rlctl.options import Json, Pretrained, Settings, SimOption
from rlctl_robot.robot.robot_request import RobotRequest


@command_in_panels(
    {
        "Options": ["policy", "pretrained", "controller", "episodes", "seed", "realtime", "fault", "settings", "sim"],
        "Gates": ["min_success", "min_success_lower", "min_return"],
        "Where": ["host", "port", "key_file", "timeout_s"],
        "Output": ["json"],
    }
)
def robot(
    request: RobotRequest,
    pretrained: Pretrained = False,
    settings: Settings = [],
    sim: SimOption = None,
    min_success: MinSuccess = None,
    min_success_lower: MinSuccessLower = None,
    min_return: MinReturn = None,
    json: Json = None,
) -> None:
    """Play the robot: a program connects by WebSocket or UDP, gets observations and sends commands."""
    from rlctl import output
    from rlctl_robot.robot.report import show
    from rlctl_robot.robot.robot import run_robot

    gates = Gates(min_success, min_success_lower, min_return)
    report = run_robot(
        request,
        lambda addresses: output.print_notes([f"waiting for a program at {' or '.join(addresses)}"]),
        pretrained=pretrained,
        changes=parse_changes(settings, sim),
        gates=gates,
    )
    show(report, json, gates)
    return report.check(gates)
