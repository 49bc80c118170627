"""What a call into an environment raised, as plain data."""

from __future__ import annotations

import traceback
from pathlib import Path

from rlctl.check_env.messages import Failure
from rlctl.check_env.missing_files import missing_file
from rlctl.check_env.progress import Progress
from rlctl.errors import RlctlError

_HERE = Path(__file__).parent


class EnvironmentRaised(Exception):
    """A call into the environment raised; `__cause__` is what."""

    def __init__(self, call: str) -> None:
        super().__init__(call)
        self.call = call


def failure(error: EnvironmentRaised, progress: Progress) -> Failure:
    """Describe what a call into the environment raised, and when."""
    where = progress.read()
    cause = error.__cause__ or error
    return Failure(
        kind="raised",
        call=error.call,
        phase=where.phase,
        episode=where.episode,
        seed=where.seed,
        step=where.step,
        error=describe(cause),
        details="".join(traceback.format_exception(cause)),
        file=missing_file(cause),
    )


def describe(error: BaseException) -> str:
    """Return an exception in a line, with the place in the environment's code."""
    if isinstance(error, RlctlError):  # of the task layer, which names the task and the step itself
        return f"{type(error).__name__}: {error}"
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if _HERE not in Path(frame.filename).parents]
    own = [frame for frame in frames if "site-packages" not in frame.filename] or frames
    place = f" ({Path(own[-1].filename).name}:{own[-1].lineno})" if own else ""
    text = " ".join(str(error).split()) or "no message"
    return f"{type(error).__name__}: {text}{place}"
