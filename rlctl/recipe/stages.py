"""Curricula: the stages of a recipe, from an easy task to the full task."""

from collections.abc import Sequence
from typing import Annotated, Any, Self

import pydantic
from pydantic import Field

from rlctl.storage.validation import Number, Section, Whole


class Promotion(Section):
    """When training moves to the next stage: at a success rate or a mean return of the last training episodes."""

    success: Number | None = Field(None, gt=0, le=1)
    """Success rate to reach."""
    mean_return: Number | None = Field(None, alias="return")
    """Mean return to reach."""
    window: Whole = Field(100, ge=1, le=1_000_000)
    """Number of last training episodes that are averaged; the stage lasts at least that many."""
    min_steps: Whole = Field(0, ge=0)
    """Minimum length of the stage in environment steps, all environments together."""

    @pydantic.model_validator(mode="after")
    def _check_measure(self) -> Self:
        if (self.success is None) == (self.mean_return is None):
            raise ValueError("give one of success and return: promote: {success: 0.8, window: 100}")
        return self

    @property
    def threshold(self) -> float:
        """The success rate, in (0, 1], or the mean return to reach."""
        return self.success if self.success is not None else self.mean_return or 0.0


class FollowingLevel(Section):
    """A level of each environment that follows the success of its own episodes: what it has mastered gets harder."""

    start: Number = Field(0.0, ge=0, le=1)
    """Level of the first episode of each environment."""
    up: Number = Field(0.1, gt=0, le=1)
    """How much the level rises after an episode that succeeded."""
    down: Number = Field(0.05, ge=0, le=1)
    """How much it falls after one that did not."""


class Stage(Section):
    """What a stage changes in the recipe's own `task`, `reward_weights` and `events`, and when it ends.

    Each stage changes the recipe, not the stage before it: `{}` is the task as the recipe has it.
    """

    task: dict[str, Any] = {}
    """Changes of the recipe's `task`."""
    reward_weights: dict[str, Number] = {}
    """Changes of the recipe's `reward_weights`."""
    events: dict[str, dict[str, Any]] = {}
    """Changes of the recipe's `events`."""
    level: Annotated[Number, Field(ge=0, le=1)] | FollowingLevel = 1.0
    """Difficulty: `self.level` of the task, and event ranges `{from: ..., to: ...}`; or how it follows success."""
    promote: Promotion | None = None
    """When the stage ends; the last stage has none."""

    def __str__(self) -> str:
        changes = [f"{name} {value}" for name, value in self.task.items()]
        changes += [f"reward_weights.{name} {value:g}" for name, value in self.reward_weights.items()]
        for event, parameters in self.events.items():
            changes += [f"{event}.{name} {value}" for name, value in parameters.items()] or [event]
        if isinstance(self.level, FollowingLevel):
            changes.append(f"levels from {self.level.start:g} that follow success")
        elif self.level != 1:
            changes.append(f"level {self.level:g}")
        return ", ".join(changes) or "the recipe's own task"


def check_promotions(stages: list[Stage]) -> list[Stage]:
    """Return the stages; raises `ValueError` unless all but the last have a promotion rule, and the last has none."""
    for number, stage in enumerate(stages, start=1):
        last = number == len(stages)
        if stage.promote is None and not last:
            raise ValueError(
                f"stage {number} of {len(stages)} ({stage}) has no promotion rule, so it would never end; "
                "add promote: {success: 0.8, window: 100} or promote: {return: 50.0, window: 100}"
            )
        if stage.promote is not None and last:
            raise ValueError(f"stage {number} of {len(stages)} ({stage}) is the last: remove its promote")
    return stages


def format_value(key: str, value: Any) -> str:
    """Return the value of a recipe's key as text; of `stages` (plain data) only what they change."""
    try:
        stages = [Stage.model_validate(stage) for stage in value] if key == "stages" else []
    except (TypeError, ValueError):  # not set, or invalid in a file that was edited
        stages = []
    return f"{len(stages)} stages: " + "; ".join(map(str, stages)) if stages else str(value)


def format_title(number: int, stages: Sequence[Stage]) -> str:
    """Return the title of a stage: `stage 2 of 3: tolerance 0.1`."""
    return f"stage {number} of {len(stages)}: {stages[number - 1]}"
