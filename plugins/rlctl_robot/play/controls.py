"""What a person does on the page, for the thread that simulates: commands, pushes, friction, pause, speed, reset."""

import dataclasses
import threading
from collections.abc import Collection
from typing import Annotated

import pydantic
from pydantic import Field

Number = Annotated[float, Field(allow_inf_nan=False)]


class PageMessage(pydantic.BaseModel, extra="forbid"):
    """A message of the page; it has only what the person changes."""

    commands: dict[str, Number] | None = None
    push: tuple[Number, Number] | None = None  # direction in the world's x and y
    friction: Annotated[float, Field(ge=0.0, le=5.0, allow_inf_nan=False)] | None = None  # of the ground
    paused: bool | None = None
    speed: Annotated[float, Field(ge=0.05, le=2.0)] | None = None  # of the simulated clock
    reset: bool = False
    record: bool | None = None  # begins or ends a recording, and with it an episode


@dataclasses.dataclass
class Wishes:
    """What the person wants now."""

    commands: dict[str, float] = dataclasses.field(default_factory=dict)  # those that the person has ever set
    friction: float | None = None  # None: that of the built world
    push: tuple[float, float] | None = None  # once
    paused: bool = False
    speed: float = 1.0
    reset: bool = False  # once
    record: bool = False
    stop: bool = False


class Controls:
    """The wishes of the person, written by the page's thread and read by the simulation's."""

    def __init__(self, *, record: bool = False) -> None:
        self._wishes = Wishes(record=record)
        self._changed = threading.Condition()

    def take(self) -> Wishes:
        """Return the wishes; pushes and resets are returned once."""
        with self._changed:
            wishes = dataclasses.replace(self._wishes, commands=dict(self._wishes.commands))
            self._wishes.push, self._wishes.reset = None, False
            return wishes

    def keep_commands(self, names: Collection[str]) -> None:
        """Forget all commands but these: a new episode has a new goal."""
        with self._changed:
            self._wishes.commands = {name: value for name, value in self._wishes.commands.items() if name in names}

    def wait(self, seconds: float) -> None:
        """Return when a wish has changed, or after some seconds."""
        with self._changed:
            self._changed.wait(seconds)

    def stop(self) -> None:
        """End the game."""
        with self._changed:
            self._wishes.stop = True
            self._changed.notify_all()

    def apply(self, message: PageMessage) -> None:
        """Take what a message of the page changes."""
        with self._changed:
            wishes = self._wishes
            wishes.commands.update(message.commands or {})
            for name in ("push", "friction", "paused", "speed"):
                if (value := getattr(message, name)) is not None:
                    setattr(wishes, name, value)
            wishes.reset |= message.reset
            if message.record is not None and message.record != wishes.record:
                wishes.record, wishes.reset = message.record, True
            self._changed.notify_all()
