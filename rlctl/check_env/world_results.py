"""What was found out about the PyBullet worlds behind an environment, and in its functions."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class Worlds:
    """What went on in the physics clients of an instance; without worlds where it has none."""

    worlds: list[World] = dataclasses.field(default_factory=list)
    steps: int = 0
    """How many steps of the environment were watched."""
    resets: int = 0
    source: Source = dataclasses.field(default_factory=lambda: Source())


@dataclasses.dataclass(frozen=True)
class World:
    """One physics client."""

    gravity: list[float]
    """The strongest that was seen [m/s^2]."""
    bodies: list[WorldBody]
    penetrations: list[Penetration]
    excesses: list[Excess]
    speeds: list[TopSpeed]
    falls: list[Fall]
    jumps: list[Jump]
    weight_matters: bool | None = None
    """Whether anything would move otherwise with gravity; tried only where there is none."""


@dataclasses.dataclass(frozen=True)
class WorldBody:
    """A body as it was at the resets that were watched."""

    name: str
    joints: int
    """How many of its joints move."""
    is_free: bool
    """Whether its base is not fixed to the world."""
    links: list[WorldLink]
    """The base first."""


@dataclasses.dataclass(frozen=True)
class WorldLink:
    """A link, with a value per reset of what may be randomised."""

    name: str
    masses: list[float]
    frictions: list[float]
    mass_built: float | None = None
    """Its mass before the first reset; None where it was not there yet."""
    has_shape: bool | None = None
    """Whether it has a shape to collide with; None where that was not tried."""
    collides: bool | None = None
    """Whether a box around it touches it."""


@dataclasses.dataclass(frozen=True)
class Moment:
    """A step of an episode that was watched; step 0 is the reset."""

    seed: int
    episode: int
    actions: str
    step: int


@dataclasses.dataclass(frozen=True)
class Penetration:
    """Two links inside each other for several steps in a row."""

    links: list[str]
    depth: float
    """[m]."""
    limit: float
    """What is still fine for links of their size [m]."""
    steps: int
    """The longest row of steps."""
    since: int
    """Where that row begins."""
    at: Moment


@dataclasses.dataclass(frozen=True)
class Excess:
    """A joint farthest outside its limits."""

    body: str
    joint: str
    is_angle: bool
    low: float
    high: float
    value: float
    steps: int
    """How many steps it was outside by much."""
    at: Moment


@dataclasses.dataclass(frozen=True)
class TopSpeed:
    """The highest speed of one kind that lasted, in a body."""

    body: str
    joint: str
    """Empty for the body's base."""
    kind: str
    """`m/s` or `rad/s`."""
    value: float | str
    """The speed, or the text of a number that is not finite."""
    at: Moment


@dataclasses.dataclass(frozen=True)
class Fall:
    """How far a free body sank after a reset before it touched anything [m]."""

    body: str
    height: float
    at: Moment


@dataclasses.dataclass(frozen=True)
class Jump:
    """How fast a free body became right after a reset, with nothing done to it."""

    body: str
    speed: float
    """[m/s]."""
    explained: float
    """The speed that it had, and that falling adds [m/s]."""
    after_s: float
    seed: int


@dataclasses.dataclass(frozen=True)
class Source:
    """Calls of PyBullet without physicsClientId."""

    ran: list[Place] = dataclasses.field(default_factory=list)
    """In functions that ran."""
    not_run: list[Place] = dataclasses.field(default_factory=list)
    """In the environment's other methods."""


@dataclasses.dataclass(frozen=True)
class Place:
    """A call in the source."""

    file: str
    line: int
    call: str
