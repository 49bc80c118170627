"""`rlctl demo`: the five verbs, one after the other."""

import subprocess
import sys

import typer

from rlctl import output
from rlctl.arguments import command

_COMMANDS = (
    ("train", "reach"),
    ("eval", "reach", "--min-success", "0.95"),
    ("export", "reach", "--onnx"),
    ("replay", "reach"),
)


@command
def demo() -> None:
    """Train `reach` to the end, evaluate it, export it to ONNX and record an episode: under a minute."""
    for arguments in _COMMANDS:
        print("$ rlctl", *arguments, file=sys.stderr, flush=True)
        done = subprocess.run([sys.executable, "-m", "rlctl", *arguments], stdout=output.results(), check=False)
        if done.returncode:
            raise typer.Exit(done.returncode)
