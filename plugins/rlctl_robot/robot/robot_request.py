"""The options of `rlctl robot` as data. Imports nothing heavy."""

import dataclasses
from typing import Annotated

from rlctl.options import TASK_FORMS, Argument, EpisodeSeed, Option
from rlctl_robot.serve.serve_request import Host, KeyFile, Port


@dataclasses.dataclass(frozen=True)
class RobotRequest:
    """The robot that is simulated, what is wrong with it, and where the program under test connects."""

    task: Annotated[
        str,
        Argument(
            f"{TASK_FORMS} Or a policy file: its task, and commands are compared with the policy.",
            metavar="TASK",
            completes="task",
        ),
    ]
    policy: Annotated[
        str | None, Option("Compare the commands with this policy: a run, a policy file or a task.", metavar="RUN")
    ] = None
    controller: Annotated[
        bool,
        Option(
            "Send what an exported controller takes, and take its joint targets; default: observation and action.",
            ("--controller",),
        ),
    ] = False
    episodes: Annotated[int, Option("Episodes, each with its own seed; as many with each --fault.", min=1)] = 100
    seed: EpisodeSeed = 0
    realtime: Annotated[bool, Option("Keep to the clock; default: wait for each command.", ("--realtime",))] = False
    fault: Annotated[
        list[str],
        Option(
            "Play the episodes again with faults: delay=S, jitter=S, drop=SHARE, frozen=SENSOR, nan=SENSOR, "
            "stuck=JOINT; several with commas. Repeatable.",
            ("--fault",),
            metavar="KIND=VALUE",
        ),
    ] = dataclasses.field(default_factory=list)
    host: Host = "127.0.0.1"
    port: Port = 8001
    key_file: KeyFile = None
    timeout_s: Annotated[
        float, Option("How long to wait for the program.", ("--timeout",), metavar="SECONDS", min=0.1, max=1e6)
    ] = 60.0
