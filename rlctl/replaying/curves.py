"""Sends the numbers of an episode to a recording, as curves with names and colours."""

import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import split_names
from rlctl.replaying.recorder import Rollout
from rlctl.replaying.scene import WORLD, Scene, encode_jpeg

Color = tuple[int, int, int]
# Distinct on the viewer's dark and light background; the first eight also to colour-blind eyes.
_PALETTE: list[Color] = [
    (86, 180, 233), (230, 159, 0), (0, 180, 130), (222, 110, 170), (213, 94, 0), (150, 120, 220), (170, 170, 60),
    (120, 200, 90), (200, 80, 80), (60, 120, 200),
]  # fmt: skip
_TOTAL_COLOR: Color = (150, 150, 150)
_MOST_SERIES = 64


class Timelines:
    """Sends whole columns: one call per entity is a hundred times faster than one per row."""

    def __init__(self, stream: rr.RecordingStream, dt: float | None) -> None:
        self.stream = stream
        self.dt = dt
        self.default = "step" if dt is None else "sim_time"  # the timeline that the viewer opens with

    def send(
        self, entity: str, steps: Sequence[int] | NDArray[np.int64], columns: Iterable[rr.ComponentColumn]
    ) -> None:
        """Send a row per element of `steps` to an entity."""
        if len(steps) == 0:
            return
        sequence = np.asarray(steps, np.int64)
        indexes = [rr.TimeColumn("step", sequence=sequence)]
        if self.dt is not None:
            indexes.append(rr.TimeColumn("sim_time", duration=self._convert(sequence)))
        self.stream.send_columns(entity, indexes, columns)

    def log(self, entity: str, step: int, archetype: rr.AsComponents) -> None:
        """Log an archetype at a step."""
        self.stream.set_time("step", sequence=step)
        if self.dt is not None:
            self.stream.set_time("sim_time", duration=self._convert(np.int64(step)))
        self.stream.log(entity, archetype)
        self.stream.reset_time()

    def _convert(self, steps: Any) -> Any:
        # Rerun truncates floating-point times, so equal times could become rows one nanosecond apart.
        return np.round(steps * (self.dt or 0.0) * 1e9).astype("timedelta64[ns]")


@dataclasses.dataclass(frozen=True)
class Plot:
    """A group of curves to show in one view."""

    title: str
    entity: str
    kind: str  # reward, action, joints, observation or image
    values: NDArray[np.float64] = dataclasses.field(default_factory=lambda: np.zeros((0, 0)))
    """Values of the curves, shape (rows, curves)."""

    @property
    def legend(self) -> tuple[str, tuple[float, float]]:
        """The corner for the legend, and the smallest axis range in which the legend covers no curve.

        It is assumed to cover a third of the width, and a tenth of the height for each of at most six curves.
        """
        values = self.values[np.isfinite(self.values).all(axis=1)] if self.values.size else np.zeros((1, 1))
        values = values if len(values) else np.zeros((1, 1))
        share, part = min(0.1 * values.shape[1], 0.6), -(-len(values) // 3)
        low, high = float(values.min()), float(values.max())
        low, high = (low - 0.5, high + 0.5) if low == high else (low, high)
        ranges = {}
        for side, rows in (("Right", values[-part:]), ("Left", values[:part])):
            ranges[f"{side}Top"] = low, max(high, low + (float(rows.max()) - low) / (1 - share))
            ranges[f"{side}Bottom"] = min(low, high - (high - float(rows.min())) / (1 - share)), high
        corner = min(ranges, key=lambda name: ranges[name][1] - ranges[name][0])
        return corner, ranges[corner]


def send_curves(rollout: Rollout, timelines: Timelines) -> list[Plot]:
    """Send rewards, actions, joints and observations; return the plots, in order."""
    rewards, actions = _send_rewards(rollout, timelines), _send_actions(rollout, timelines)
    return [rewards, actions, *_send_joints(rollout.scene, timelines), *_send_observations(rollout, timelines)]


def _send(
    timelines: Timelines,
    entity: str,
    first: int,
    values: NDArray[Any],
    names: Sequence[str],
    *,
    color: Color | None = None,
    width: float = 1.5,
) -> None:
    """Send curves: `values` of shape (rows, curves), its first row at the step `first`."""
    rows, count = values.shape
    if count == 0:
        return
    colors = [color or _PALETTE[index % len(_PALETTE)] for index in range(count)]
    style = rr.SeriesLines(names=list(names), colors=colors, widths=[width] * count)
    timelines.stream.log(entity, style, static=True)
    scalars = np.ascontiguousarray(values, np.float64)
    timelines.send(entity, range(first, first + rows), rr.Scalars.columns(scalars=scalars))


def _send_rewards(rollout: Rollout, timelines: Timelines) -> Plot:
    names, terms = rollout.episode.info.term_names, rollout.weighted_terms
    rewards = rollout.episode.rewards[:, None]
    _send(timelines, "reward/total", 1, rewards, ["total"], color=_TOTAL_COLOR, width=2.5)
    for index, name in enumerate(names):
        entity, color = rr.new_entity_path(["reward", "terms", name]), _PALETTE[index % len(_PALETTE)]
        _send(timelines, entity, 1, terms[:, index : index + 1], [name], color=color)
    if rollout.successes is not None:
        _send(timelines, "success", 1, rollout.successes[:, None], ["success"], color=_PALETTE[2])
    shown = np.concatenate([rewards, terms], axis=1)
    return Plot("reward, by weighted term" if names else "reward", "reward", "reward", shown)


def _send_actions(rollout: Rollout, timelines: Timelines) -> Plot:
    actions = rollout.episode.actions.reshape(rollout.length, math.prod(rollout.episode.actions.shape[1:]))
    joints, count = rollout.env.joints, actions.shape[1]
    names = list(joints.names) if joints is not None and len(joints.names) == count else _number("action", count)
    _send(timelines, "action", 1, actions, names)
    meaning = rollout.env.action_meaning
    return Plot(f"action: {meaning}" if meaning else "action", "action", "action", actions)


def _send_joints(scene: Scene, timelines: Timelines) -> list[Plot]:
    plots, robots = [], scene.robots()
    for kind, plural in (("position", "positions"), ("velocity", "velocities")) if robots else ():
        curves = [getattr(body, f"joint_{plural}") for body in robots]
        for body, values in zip(robots, curves, strict=True):
            path = [body.name] if body.world == WORLD else [body.world, body.name]
            names = [name if len(robots) == 1 else "/".join([*path, name]) for name in body.joint_names]
            _send(timelines, rr.new_entity_path(["joints", kind, *path]), 0, values, names)
        plots.append(Plot(f"joint {plural}", f"joints/{kind}", "joints", np.concatenate(curves, axis=1)))
    return plots


def _number(name: str, count: int) -> list[str]:
    return [name] if count == 1 else [f"{name}[{index}]" for index in range(count)]


def _send_observations(rollout: Rollout, timelines: Timelines) -> list[Plot]:
    plots = []
    for name, values in split_names(rollout.episode.observations, rollout.env.observation_sizes).items():
        unit = rollout.env.observation_units.get(name)
        entity = "observation" if not name else rr.new_entity_path(["observation", name])
        title = f"observed {name}" if name else "observation"
        if values.dtype == np.uint8 and values.ndim == 4 and values.shape[-1] in (1, 3):
            send_pictures(timelines, entity, [(step, encode_jpeg(image)) for step, image in enumerate(values)])
            plots.append(Plot(title, entity, "image"))
            continue
        flat = values.reshape(len(values), -1)
        shown = flat[:, :_MOST_SERIES]
        _send(timelines, entity, 0, shown, _number(name or "observation", flat.shape[1])[: shown.shape[1]])
        plots.append(Plot(f"{title} [{unit}]" if unit else title, entity, "observation", shown))
    return plots


def send_pictures(timelines: Timelines, entity: str, pictures: Sequence[tuple[int, bytes]]) -> None:
    """Send pictures: pairs of a step and a JPEG file."""
    columns = rr.EncodedImage.columns(blob=[blob for _, blob in pictures], media_type=["image/jpeg"] * len(pictures))
    timelines.send(entity, [step for step, _ in pictures], columns)
