"""The options of `rlctl serve` as data. Imports nothing heavy."""

import dataclasses
from pathlib import Path
from typing import Annotated

from rlctl.options import Option

LOOPBACK = ("127.0.0.1", "localhost", "::1")

Host = Annotated[str, Option("Address to listen on; one that other machines can reach requires a key.")]
Port = Annotated[int, Option("Port to listen on; 0: any free port.", min=0, max=65535)]
KeyFile = Annotated[
    Path | None,
    Option("File with the key that clients must send; default: the variable RLCTL_API_KEY.", metavar="FILE"),
]


@dataclasses.dataclass(frozen=True)
class ServeRequest:
    """The options of `rlctl serve` that are about the server; paths are of files."""

    host: Host = "127.0.0.1"
    port: Port = 8000
    limits: Annotated[Path | None, Option("Safety limits (YAML).", metavar="FILE")] = None
    log: Annotated[Path | None, Option("Log of events, as JSON lines, rotated at 10 MB.", metavar="FILE")] = None
    rerun: Annotated[Path | None, Option("Record actions and observations for Rerun (.rrd).", metavar="FILE")] = None
    key_file: KeyFile = None
    max_clients: Annotated[int, Option("Clients that may be connected at once.", min=1)] = 64
    watchdog: bool = True  # whether silent clients are stopped: off for a simulation, which does not run in real time
