"""A few pictures of a recorded episode, drawn on the CPU: for reports."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from rlctl.errors import ArtifactError
from rlctl.replay.difference import find_difference
from rlctl.replay.recorder import play_episode, recorded_actions
from rlctl.replay.scene import encode_jpeg
from rlctl.replay.view import look_at
from rlctl.run.episode import RecordedEpisode
from rlctl.task import Sim

_WIDTH, _HEIGHT = 240, 180  # [pixels]


@dataclasses.dataclass(frozen=True)
class PictureStrip:
    """An episode in pictures."""

    pictures: list[tuple[int, bytes]]
    """Step and JPEG file."""
    deepest_contact: float
    """How far bodies overlapped at most [m]; 0 where they did not, or where there is no world of a task."""


def take_pictures(episode: RecordedEpisode, count: int) -> PictureStrip:
    """Play an episode again and return `count` steps of it, the first and the last among them.

    The camera follows the robot. Raises `TaskError` if the environment fails, `UsageError` if it cannot draw, and
    `ArtifactError` if it does something else than when it was recorded.
    """
    spec, steps = episode.info.spec, len(episode.actions)
    chosen = {int(step) for step in np.linspace(0, steps, count)} - {steps}
    pictures: list[tuple[int, bytes]] = []
    deepest = 0.0
    env = spec.make("rgb_array")
    sim = getattr(env.unwrapped, "sim", None)
    try:
        recorded, view = recorded_actions(episode, env), look_at(env, _WIDTH, _HEIGHT)

        def choose(observation: Any, step: int) -> Any:
            nonlocal deepest
            if isinstance(sim, Sim):
                deepest = max(deepest, sim.deepest_contact)
            if step == 0:
                view.begin()
            if step in chosen:
                pictures.append((step, encode_jpeg(view.draw())))
            return recorded(observation, step)

        rollout = play_episode(env, spec, episode.info.seed, choose, policy=episode.info.policy)
        pictures.append((steps, encode_jpeg(view.draw())))
    finally:
        env.close()
    if difference := find_difference(episode, rollout):
        raise ArtifactError(f"replayed, the episode differs from the recorded one; {difference}")
    return PictureStrip(pictures, deepest)
