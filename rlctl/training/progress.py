"""How far a training is: the counters that checkpoints store."""

import dataclasses

from rlctl.play.messages import EpisodeResult


@dataclasses.dataclass
class Progress:
    """The state of the training loop; plain data, stored in checkpoints. Steps are environment steps."""

    next_eval: int  # the first boundary at or after this step is evaluated
    next_row: int = 0  # the first boundary at or after this step gets a row of metrics
    last_row: int = 0  # step of the last row of metrics
    last_eval: int = 0  # step of the last evaluation
    good_in_a_row: int = 0  # evaluations in a row that reached the recipe's `stop_success`
    failed_evaluations: int = 0
    first_failure: str = ""  # why the first of the failed evaluations failed
    observations_outside: int = 0  # number of training observations outside their space
    done: bool = False  # whether the training has finished
    seconds: float = 0.0
    metrics_bytes: int = 0
    evals_bytes: int = 0  # sizes of the tables [bytes]
    metrics_sha256: str = ""
    evals_sha256: str = ""  # hashes of these bytes; empty if there was no table yet
    recent: list[EpisodeResult] = dataclasses.field(default_factory=list)  # episodes that ended after the last row
    steps_to_learn: int = 0  # environment steps in the replay buffer whose updates are still due
    stage: int = 0  # stage of the curriculum, from 1; 0 where there is none
    stage_began: int = 0  # environment steps at the start of the stage
    last_segment: int = 0  # step of the last `on_segment` of callbacks
    logged: dict[str, float | None] = dataclasses.field(default_factory=dict)  # by callbacks, for the next row
    parameters: dict[str, float] = dataclasses.field(default_factory=dict)  # what callbacks have changed
    stop_reason: str = ""  # why a callback ended the training
    stage_episodes: list[float | None] = dataclasses.field(default_factory=list)
    """Success (0 or 1; None if not reported) or return of the stage's last episodes, as its promotion rule needs."""
