"""Diagnoses an imported policy without a log: is there a single change of its mapping with which it walks?"""

from __future__ import annotations

import contextlib
import dataclasses
import json as json_text
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rlctl import output
from rlctl.environments.spec import EnvSpec
from rlctl.errors import AnswerIsNo, UsageError
from rlctl.play.playing import Playing
from rlctl.policy.actor import Actor, Rows
from rlctl.policy.file import PolicyFile
from rlctl.policy.numpy_actor import NumpyActor
from rlctl.task.deployment import TASKS, USUAL_TOLERANCE, Deployment
from rlctl.task.mujoco.robot import Robot, read_robot
from rlctl_robot.diagnose.mapped_actor import MappedActor
from rlctl_robot.diagnose.variants import Variant, list_variants

_WORLDS = 8  # in which a deployment is judged
_SECONDS = 6.0  # for which it is played there
_SHORT_WORLDS, _SHORT_SECONDS = 2, 2.5  # the same of the first look at each variant
_TOGETHER = 64  # worlds that play together
_CHOSEN = 8  # variants that are judged after the first look
_UP = 0.75  # of the worlds that must be up in the end, to walk
_ALL_UP = 0.85  # the same of a variant that is named
_FOLLOWS = 0.3  # [m/s], largest mean error of the velocity of one that walks
_ERROR_WEIGHT = 0.3  # [s/m], of the velocity error against the time that a robot is up
_BETTER = 0.3  # by which more worlds must be up
_SMALLER = 0.6  # of the file's velocity error, or
_WELL = 0.15  # [m/s], velocity error below which nothing is searched
_WIDE = 1e3  # action bounds in which a variant may send what the file's mapping would not


@dataclasses.dataclass(frozen=True)
class Score:
    """How a deployment walks in some episodes."""

    up: float  # part of the episodes that end upright
    time_up: float  # mean part of the time
    error: float  # mean velocity error [m/s], or of a policy that follows a clip mean error of the joints [rad]
    follows_motion: bool = False
    scale: float = 1.0  # of the errors that are allowed: less than 1 for robots whose commands are slow

    @property
    def walks(self) -> bool:
        """Whether the robot stays up and follows its commands."""
        return self.up >= _UP and self.error <= _FOLLOWS * self.scale

    @property
    def walks_well(self) -> bool:
        """Whether it walks so well that nothing is searched."""
        return self.walks and self.error <= _WELL * self.scale

    @property
    def rank(self) -> float:
        """Higher is better."""
        return self.time_up + 0.5 * self.up - _ERROR_WEIGHT * self.error / self.scale

    def describe(self) -> str:
        """Return the score as text."""
        error = f"velocity error {self.error:.2f} m/s"
        if self.follows_motion:
            error = f"error of the joints {self.error:.2f} rad"
        return f"{self.up:.0%} of the episodes end upright, {error}"


@dataclasses.dataclass(frozen=True)
class DeploymentDiagnosis:
    """What playing variants of a deployment shows."""

    policy: str
    own: Score
    tried: int
    best: Variant | None  # the variant that walks where the file's mapping does not
    best_score: Score | None
    changes: dict[str, Any]  # of the deployment, for `--set`
    also: tuple[str, ...]  # other variants that walk as well
    seconds: float

    def check(self) -> None:
        """Raise `AnswerIsNo` unless the file's own mapping walks and nothing walks much better."""
        if self.best is not None:
            raise AnswerIsNo(f"{self.policy}: a mistake in the mapping; see above")
        if not self.own.walks:
            raise AnswerIsNo(f"{self.policy}: it does not walk, the cause is unknown; see above")


def is_deployed(spec: EnvSpec) -> bool:
    """Return whether a task is that of imported policies."""
    return spec.task in TASKS


def diagnose_deployment(
    policy: PolicyFile, spec: EnvSpec, seed: int = 0, report: Callable[[str], None] = lambda _: None
) -> DeploymentDiagnosis:
    """Play an imported policy as its file says and, unless it walks well, with single changes of the mapping.

    Raises `UsageError` for any other policy.
    """
    if not is_deployed(spec):
        raise UsageError(
            f"{policy.path}: give a log of the robot: rlctl diagnose LOG; only imported policies need none"
        )
    began = time.monotonic()
    own = Deployment(**dict(spec.parameters["deployment"]))
    player = _Player(policy, spec, own, seed)
    report("playing the policy as its file says")
    own_score = player.judge(own, _WORLDS, _SECONDS)
    if own_score.walks_well:
        return DeploymentDiagnosis(str(policy.path), own_score, 0, None, None, {}, (), time.monotonic() - began)
    robot = read_robot(Path(str(spec.parameters["robot_file"])))
    variants = list_variants(own, robot)
    report(f"trying {len(variants):,} single changes of the mapping")
    chosen = player.choose(variants, robot)
    report(f"playing the best {len(chosen)} for longer")
    scores = [(player.judge(_place(variant, own, robot), _WORLDS, _SECONDS), variant) for variant in chosen]
    named = [(score, variant) for score, variant in scores if _is_named(score, own_score)]
    named.sort(key=lambda pair: -pair[0].rank)
    best_score, best = named[0] if named else (None, None)
    changes = {} if best is None else best.list_changes(own)
    also = tuple(variant.text for _, variant in named[1:3])
    seconds = time.monotonic() - began
    return DeploymentDiagnosis(str(policy.path), own_score, len(variants), best, best_score, changes, also, seconds)


def _is_named(score: Score, own: Score) -> bool:
    """Return whether a variant walks, and much better than the file's mapping does."""
    if score.up < _ALL_UP or score.error > _FOLLOWS * score.scale:
        return False
    stays_up = score.up - own.up >= _BETTER
    follows = score.error <= _SMALLER * own.error and own.error - score.error >= _WELL / 2 * own.scale
    return stays_up or follows


def _place(variant: Variant, own: Deployment, robot: Robot) -> Deployment:
    """Return a variant's deployment, with the height at which its default pose stands."""
    changed = variant.deployment
    if changed.follows_motion:  # it starts in its clip
        return changed
    if changed.default_positions == own.default_positions and changed.joints == own.joints:
        return changed
    height = robot.measure_start(dict(zip(changed.joints, changed.default_positions, strict=True)))
    return changed.model_copy(update={"start_height": height})


class _Player:
    """Plays a policy as deployments say."""

    def __init__(self, policy: PolicyFile, spec: EnvSpec, own: Deployment, seed: int) -> None:
        self._policy, self._spec, self._own, self._seed = policy, spec, own, seed
        self._scale = 1.0
        if 0 < own.fastest_command < 2 * USUAL_TOLERANCE:
            self._scale = own.fastest_command / (2 * USUAL_TOLERANCE)

    def choose(self, variants: Sequence[Variant], robot: Robot) -> list[Variant]:
        """Return the variants that do best in a short look."""
        mapped = [variant for variant in variants if not variant.moves_world]
        ranks = self._rank_mapped(mapped)
        ranked = list(zip(ranks, mapped, strict=True))
        for variant in variants:
            if variant.moves_world:
                deployment = _place(variant, self._own, robot)
                ranked.append((self.judge(deployment, 2 * _SHORT_WORLDS, _SHORT_SECONDS).rank, variant))
        ranked.sort(key=lambda pair: -pair[0])
        return [variant for _, variant in ranked[:_CHOSEN]]

    def judge(self, deployment: Deployment, count: int, seconds: float) -> Score:
        """Play a deployment in worlds of its own."""
        with contextlib.closing(self._make_worlds(deployment, count)) as worlds:
            actor = MappedActor(NumpyActor(self._policy, count), self._own, deployment, [deployment] * count)
            played = _play(worlds, actor, self._list_seeds(count), seconds)
            return self._summarize(played)

    def _rank_mapped(self, variants: Sequence[Variant]) -> list[float]:
        """Return ranks of variants that need no other robot, played together in the worlds of the file's."""
        ranks: list[float] = []
        in_turn = _TOGETHER // _SHORT_WORLDS
        with contextlib.closing(self._make_worlds(self._own, _TOGETHER)) as worlds:
            for first in range(0, len(variants), in_turn):
                some = variants[first : first + in_turn]
                deployments = [variant.deployment for variant in some for _ in range(_SHORT_WORLDS)]
                deployments += [self._own] * (_TOGETHER - len(deployments))
                actor = MappedActor(NumpyActor(self._policy, _TOGETHER), self._own, self._own, deployments)
                seeds = self._list_seeds(_SHORT_WORLDS) * in_turn
                played = _play(worlds, actor, seeds, _SHORT_SECONDS)
                parts = played.reshape(in_turn, _SHORT_WORLDS, -1)
                ranks += [self._summarize(part).rank for part in parts[: len(some)]]
        return ranks

    def _summarize(self, played: np.ndarray) -> Score:
        up, time_up, error = played.mean(axis=0).tolist()
        return Score(up, time_up, error, self._own.follows_motion, self._scale)

    def _list_seeds(self, count: int) -> list[int]:
        return [self._seed + number for number in range(count)]

    def _make_worlds(self, deployment: Deployment, count: int) -> Any:
        wide = deployment.model_copy(update={"action_clip": (-_WIDE, _WIDE)})
        spec = dataclasses.replace(self._spec, parameters={**self._spec.parameters, "deployment": wide.dump()})
        return spec.make_worlds(count)


def _play(worlds: Any, actor: Actor, seeds: Sequence[int], seconds: float) -> np.ndarray:
    """Play an episode in each world; return whether it ended upright, the part of the time, and the mean error."""
    index = np.arange(len(seeds))
    steps = max(1, round(seconds / worlds.task.control_dt))
    playing = Playing(worlds)
    actor.begin(Rows.first(len(seeds)))
    observations = playing.begin(index, list(seeds))
    alive, errors = np.zeros(len(seeds)), np.zeros(len(seeds))
    fell = np.zeros(len(seeds), bool)
    for played in playing.play(actor, index, observations):
        alive[played.index] += 1
        errors[played.index] += worlds.task.error[played.index]
        fell[played.index[played.result.terminated]] = True
        over = played.index[worlds.step_of[played.index] >= steps]
        if len(over):
            fell[over] &= alive[over] < steps
            playing.stop(over)
    time_up = np.where(fell, alive / steps, 1.0)  # also where a clip ended first
    return np.stack([1.0 - fell, time_up, errors / np.maximum(alive, 1)], axis=1)


def show(result: DeploymentDiagnosis, json: str | None) -> None:
    """Print a diagnosis, or write it as JSON to a file or, for `-`, to stdout."""
    content = dataclasses.asdict(result) | {"best": None if result.best is None else result.best.text}
    if output.present(content, json):
        return
    out = output.out()
    out.print(f"{result.policy}: as its file says {result.own.describe()}", soft_wrap=True)
    if result.best is None or result.best_score is None:
        if result.own.walks:
            out.print("no single change of the mapping walks much better" if result.tried else "it walks")
        else:
            out.print(f"none of {result.tried:,} single changes of the mapping walks")
        return
    out.print(f"mistake in the {result.best.kind}: {result.best.text}", soft_wrap=True)
    out.print(f"with that changed, {result.best_score.describe()}", soft_wrap=True)
    for text in result.also:
        out.print(f"  as good: {text}", soft_wrap=True)
    settings = " ".join(f"--set '{name}={json_text.dumps(value)}'" for name, value in result.changes.items())
    out.print(f"import it again with:\n  {settings}", soft_wrap=True)
