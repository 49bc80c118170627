"""Robot learning in simulation, end to end: check an environment, train, evaluate, export, replay.

    cli           the command line: parse, call one function, print
    check_env  train  eval  export  replay    the five verbs, a folder each
    tasks         list, show and begin tasks
    rollout       many environments in worker processes; seeds; episodes
    run           what is on disk: recipes, run folders, policies, episodes
    task          for authors of tasks: Task, Sim, Body, Event, rewards
    env_spec      what an environment is made from; registry: from a task's name to its class
    errors        every error that a user can cause, with its exit code

From Python: `rlctl.make`, `rlctl.load_policy`; `docs/architecture.md` has the whole picture.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rlctl.env_spec import make
    from rlctl.run.policy import load_policy

__version__ = "0.1.0"
__all__ = ["__version__", "load_policy", "make"]


def __getattr__(name: str) -> Any:
    # Lazy, so that `import rlctl` and the command line load neither gymnasium nor torch.
    if name == "make":
        from rlctl.env_spec import make

        return make
    if name == "load_policy":
        from rlctl.run.policy import load_policy

        return load_policy
    raise AttributeError(f"module 'rlctl' has no attribute {name!r}")
