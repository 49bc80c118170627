"""`rlctl eval --push`: the smallest horizontal push at mid-episode at which a policy fails."""

import contextlib
import dataclasses
from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rlctl.environments.spec import EnvSpec
from rlctl.errors import UsageError
from rlctl.evaluation.episode_statistics import summarize
from rlctl.evaluation.robustness import PushLevel, PushTest
from rlctl.play.messages import EpisodeResult
from rlctl.policy.shipped import Interval

_DURATION_S = 0.1
_FIRST_SPEED = 0.25  # [m/s], the change of the whole robot's speed by the smallest push
_DOUBLINGS = 6  # up to 16 m/s
_BISECTIONS = 4
_RESAMPLES = 2000


@dataclasses.dataclass(frozen=True)
class PushedBody:
    """What is pushed, and when."""

    body: str
    link: str | None
    mass: float  # of the whole body [kg]
    duration_s: float
    max_steps: int  # of an episode
    every_s: float  # more than half an episode [s], so that an interval event acts once, in its middle

    def parameters(self, impulse: float) -> dict[str, object]:
        """Return the parameters of the event `push`, in a direction that follows from the episode's seed."""
        force = impulse / self.duration_s
        where = {"body": self.body, "link": self.link, "every_s": self.every_s}
        return {**where, "force": [force, force], "duration_s": [self.duration_s, self.duration_s]}


def find_pushed(spec: EnvSpec) -> PushedBody:
    """Build the world and find the base, or the trunk on rails, of its robot; raises `UsageError` without one."""
    from rlctl.task.env import TaskEnv

    with contextlib.closing(spec.make()) as env:
        inner = env.unwrapped
        if not isinstance(inner, TaskEnv):
            raise UsageError(
                f"--push: {spec.task} is a plain Gymnasium environment; only robots of tasks can be pushed"
            )
        bodies = list(inner.sim.bodies.values())
        robots = [body for body in bodies if body.joint_names] or bodies
        movable = [(body, link) for body in robots if (link := body.find_trunk()) is not None]
        if not movable:
            names = ", ".join(body.name for body in robots)
            raise UsageError(f"--push: {spec.task} has no movable base: {names} is fixed to the world")
        body, link = max(movable, key=lambda pair: pair[0].total_mass())
        dt, steps = inner.task.control_dt, inner.max_steps
        return PushedBody(
            body=body.name,
            link=None if link == body.base_name else link,
            mass=body.total_mass(),
            duration_s=max(1, round(_DURATION_S / dt)) * dt,
            max_steps=steps,
            every_s=(steps // 2 + 1) * dt,
        )


def measure_push(
    spec: EnvSpec, unpushed: Sequence[EpisodeResult], play: Callable[[dict[str, object]], Sequence[EpisodeResult]]
) -> PushTest:
    """Double the impulse until half of the episodes fail, then bisect.

    `unpushed` are the episodes without a push; `play` plays the same with the event `push` of these parameters.
    """
    pushed = find_pushed(spec)
    has_success = any(result.success is not None for result in unpushed)

    def find_held(results: Sequence[EpisodeResult]) -> NDArray[np.bool_]:
        held = [result.success if has_success else result.length >= pushed.max_steps for result in results]
        return np.array(held, bool)

    played = {0.0: unpushed}

    def fails(impulse: float) -> bool:
        played[impulse] = play(pushed.parameters(impulse))
        return float(find_held(played[impulse]).mean()) <= 0.5

    if find_held(unpushed).mean() > 0.5:
        _search(fails, _FIRST_SPEED * pushed.mass)
    impulses = sorted(played)
    held = np.array([find_held(played[impulse]) for impulse in impulses])
    threshold, interval = find_threshold(impulses, held)
    measure: Literal["success", "upright"] = "success" if has_success else "upright"
    return PushTest(
        body=pushed.body,
        link=pushed.link,
        duration_s=pushed.duration_s,
        mass=pushed.mass,
        measure=measure,
        levels=[
            PushLevel(**summarize(played[impulse]).model_dump(), impulse=impulse, held=float(rate))
            for impulse, rate in zip(impulses, held.mean(axis=1), strict=True)
        ],
        threshold=threshold,
        threshold_interval=interval,
        verdict=_describe_result(pushed.mass, measure, impulses[-1], held, threshold, interval),
    )


def _search(fails: Callable[[float], bool], first: float) -> None:
    low, high = 0.0, first
    while not fails(high):
        if high >= first * 2**_DOUBLINGS:
            return
        low, high = high, 2 * high
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        low, high = (low, middle) if fails(middle) else (middle, high)


def find_threshold(impulses: Sequence[float], held: NDArray[np.bool_]) -> tuple[float | None, Interval | None]:
    """Return the impulse at which half of the episodes fail, and its 95 % interval; None where they never do.

    `held`, shape (impulses, episodes), is True for episodes that went well. The rate falls with the impulse (isotonic
    regression) and is linear between two impulses; the interval resamples episodes (percentile bootstrap).
    """
    threshold = _cross(impulses, held.mean(axis=1))
    if threshold is None or held[0].mean() <= 0.5:
        return None, None
    rng = np.random.default_rng(0)  # the same episodes give the same interval
    episodes = held.shape[1]
    samples = [held[:, rng.integers(episodes, size=episodes)].mean(axis=1) for _ in range(_RESAMPLES)]
    crossings = [impulses[-1] if (crossing := _cross(impulses, rates)) is None else crossing for rates in samples]
    low, high = np.percentile(crossings, [2.5, 97.5])
    return threshold, (float(low), float(high))


def _cross(impulses: Sequence[float], rates: NDArray[np.float64]) -> float | None:
    from scipy.optimize import isotonic_regression

    falling = isotonic_regression(rates, increasing=False).x
    if falling[-1] > 0.5:
        return None
    return float(np.interp(-0.5, -falling, impulses))  # np.interp needs rising values


def _describe_result(
    mass: float,
    measure: str,
    largest: float,
    held: NDArray[np.bool_],
    threshold: float | None,
    interval: Interval | None,
) -> str:
    goes_well = "succeed" if measure == "success" else "last until the time limit"
    if held[0].mean() <= 0.5:
        return f"cannot tell: without a push only {held[0].mean():.0%} of the episodes {goes_well}"
    if threshold is None or interval is None:
        if measure == "upright" and held.all():
            return "cannot tell: this task reports no success, and no episode ended early"
        return f"more than half of the episodes {goes_well} with every push tried, up to {largest:.3g} N s"
    return (
        f"half of the episodes fail at a push of {threshold:.3g} N s (95 % interval {interval[0]:.3g} to "
        f"{interval[1]:.3g}), which changes the speed of the robot ({mass:.3g} kg) by {threshold / mass:.2g} m/s"
    )
