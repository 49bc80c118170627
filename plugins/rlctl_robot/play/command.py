"""`rlctl play`."""

import dataclasses

from rlctl.arguments import choose_checkpoint, command_in_panels
from rlctl.options import Json, Pretrained
from rlctl_robot.play.play_request import PlayRequest


@command_in_panels(
    {
        "Options": ["checkpoint", "pretrained", "task", "settings", "sim", "seed", "port"],
        "Output": ["record", "output", "json"],
    }
)
def play(request: PlayRequest, pretrained: Pretrained = False, json: Json = None) -> None:
    """Steer a policy's robot in a browser: commands, pushes, friction, pause, slow motion, recordings."""
    from rlctl import output
    from rlctl_robot.play.play import run_play, show

    checkpoint = choose_checkpoint(request.checkpoint, pretrained)
    result = run_play(
        dataclasses.replace(request, checkpoint=checkpoint),
        lambda address: output.print_notes([f"open {address} in a browser; Ctrl-C ends"]),
    )
    show(result, json)
