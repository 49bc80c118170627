"""What a user says of clips: of those of `rlctl tasks new --motion`, and of that of an imported policy."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class ClipOptions:
    """What a user says of the clips; None is found in the file."""

    rate: float | None = None  # [1/s]
    quaternion: str | None = None
    joints: tuple[str, ...] = ()  # of the columns, in their order
    frames: str | None = None  # `FIRST:LAST`, counted from 0, LAST not included
    rate_option: str = "--rate"  # what gives the rate, for messages
