"""What is done with an environment to learn about it: short studies, whose results all rules share.

They run in three child processes at once, in this order in each. A study yields messages, each as soon as it is
known, so that what comes before a crash is not lost; those that may crash the environment come last.
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable, Collection, Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rlctl.check_env.context import Context
    from rlctl.check_env.messages import Message

PARTS = {"probe": 0, "instances": 1, "checkers": 0}
"""The child processes and their hash seeds: that of `instances` is another, so that hash order shows."""
PART_S = 18.0
"""How long the studies of one process may take together [s]; importing and building comes on top."""


@dataclasses.dataclass(frozen=True)
class Study:
    """One thing to do with an environment; a rule names those whose results it reads."""

    name: str
    part: str
    """The child process it runs in."""
    share: float
    """Its part of the time there is, relative to the other studies of the same process."""
    function: str
    """`module:function` below this package; imported where it runs."""
    provokes: bool = False
    """Whether it does what no learner would; how the environment takes it is the matter of the rules that need it."""

    def run(self, context: Context) -> Iterator[Message]:
        """Do it; raises `EnvironmentRaised` where the environment does and the study has nothing to add."""
        module, _, name = self.function.partition(":")
        run: Callable[[Context], Iterator[Message]] = getattr(importlib.import_module(f"{__name__}.{module}"), name)
        return run(context)


STUDIES = (Study("worlds", "instances", 4.0, "worlds:worlds"),)

LIVES = ("comparisons", "episodes", "instances")
"""The studies that record whole lives of an environment."""
CHECKERS = ("gymnasium checker", "sb3 checker")
PROVOKING = (*(study.name for study in STUDIES if study.provokes), "out of range", "nan action")


def of_part(part: str, names: Collection[str]) -> list[Study]:
    """Return the studies of a child process that were asked for, in order."""
    return [study for study in STUDIES if study.part == part and study.name in names]


def names() -> list[str]:
    """Return the name of every study."""
    return [study.name for study in STUDIES]
