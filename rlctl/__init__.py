"""Robot learning in simulation, end to end: check an environment, train, evaluate, export, replay.

    cli           the command line: parse, call one function, print
    tuning        trainings that are compared, to find hyperparameters
    checking  training  evaluation  exporting  replaying    the five verbs
    runs  tasks  importing    what can be asked of runs and of tasks; models of other libraries
    deploy        what comes after export: safety filter, policy server, physical values of the robot
    rollout       many environments in worker processes; seeds; episodes
    processes     one watched child process
    run  policy  recipe       the three formats: run folder and episodes, policy file, recipe
    environments  from what the user typed to an environment
    task          for authors of tasks: Task, Sim, Body, Event, rewards
    storage       atomic files, tables, YAML, and reading what others may have written
    errors        every error that a user can cause, with its exit code

From Python: `rlctl.make`, `check_env`, `train`, `evaluate`, `load_policy`. `docs/architecture.md` is a tour.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rlctl.version import __version__

if TYPE_CHECKING:
    from rlctl.api import check_env, evaluate, load_policy, train
    from rlctl.environments.spec import make
    from rlctl.training.callbacks import Callback

__all__ = ["Callback", "__version__", "check_env", "evaluate", "load_policy", "make", "train"]

_DEFINED_IN = {
    "Callback": "rlctl.training.callbacks",
    "check_env": "rlctl.api",
    "evaluate": "rlctl.api",
    "load_policy": "rlctl.api",
    "make": "rlctl.environments.spec",
    "train": "rlctl.api",
}


def __getattr__(name: str) -> Any:
    # Lazy, so that `import rlctl` and the command line load neither gymnasium nor torch.
    if name not in _DEFINED_IN:
        raise AttributeError(f"module 'rlctl' has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(_DEFINED_IN[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
