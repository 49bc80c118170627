"""Robot learning in simulation, end to end: check an environment, train, evaluate, export, replay."""

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
