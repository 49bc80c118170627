"""Robot learning in simulation, end to end: check an environment, train, evaluate, export, replay.

    cli           the command line: parse, call one function, print
    check_env  train  eval  export  replay    the five verbs, a folder each
    tasks  runs   what can be asked of tasks, and of runs
    deploy        what comes after: a safety filter, a policy server, physical values of the robot
    rollout       many environments in worker processes; seeds; episodes
    run           what is on disk: recipes, run folders, policies, episodes
    task          for authors of tasks: Task, Sim, Body, Event, rewards
    env_spec      what an environment is made from; registry: from a task's name to its class
    errors        every error that a user can cause, with its exit code

From Python: `rlctl.make`, `train`, `evaluate`, `load_policy`; `docs/architecture.md` has the whole picture.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rlctl.env_spec import make
    from rlctl.python_api import evaluate, train
    from rlctl.run.policy import load_policy

__version__ = "0.1.0"
__all__ = ["__version__", "evaluate", "load_policy", "make", "train"]


def __getattr__(name: str) -> Any:
    # Lazy, so that `import rlctl` and the command line load neither gymnasium nor torch.
    if name == "make":
        from rlctl.env_spec import make

        return make
    if name == "load_policy":
        from rlctl.run.policy import load_policy

        return load_policy
    if name == "evaluate":
        from rlctl.python_api import evaluate, train  # noqa: F401 (the package of that name can be called as it)

        return evaluate
    if name == "train":
        import importlib

        return importlib.import_module("rlctl.train")  # which can be called; see there
    raise AttributeError(f"module 'rlctl' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
