"""RL125: goal turned the wrong way."""

import collections
import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from rlctl.checking import attitudes
from rlctl.checking.bullet_worlds import read_poses, read_world
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.experiments.goals import judges_goals
from rlctl.checking.goal_episodes import PLACED_STEPS, GoalEpisode, GoalTrials
from rlctl.checking.instance import Instance
from rlctl.checking.lone_turns import find_lone_turns, find_wrong_points
from rlctl.checking.mujoco_worlds import MujocoStateReader
from rlctl.checking.records import FIRST_SEED, ChildMessage
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.worlds import ORIENTATION, Array, Link, Poses, World
from rlctl.checking.wrong_turns import find_broken_turns, find_wrong_turns
from rlctl.environments.simulations import find_mujoco

RULE = Rule(
    "RL125",
    "goal turned the wrong way",
    Severity.WARNING,
    meaning="""
        The observation has the way to a goal, turned by the orientation of a body, or by its yaw, in the wrong
        direction: it is neither in the world's frame nor in that of the body. The check moved the goal to see how it
        is turned, or a line of the source turns the way by the orientation itself, turns a point of the body by the
        inverse before it adds it to its place, has one wrong sign, or turns one vector of the observation the other way
        than all others. A policy that does not see the heading too cannot learn where the goal is.
    """,
    fix="""
        From the world to the body it is the inverse rotation: R.T @ v, or rotation.inv().apply(v); by a yaw
        x' = cos(yaw) x + sin(yaw) y and y' = cos(yaw) y - sin(yaw) x.
    """,
)

EPISODES, MOST_EPISODES = 4, 8  # that have to show it, and that are played
SAME, LEAST_TURN = 0.01, 0.2  # of the elements of rotation matrices; of a rotation and its inverse


class _Frame(NamedTuple):
    """A free body, or a link of a robot."""

    name: str
    client: int
    link: Link


@judges_expressions(RULE, decides=False)
def _judge_source(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    turned = noted.turned
    found = itertools.chain(
        find_wrong_turns(RULE, turned, of_ways=True),
        find_wrong_points(RULE, turned),
        find_broken_turns(RULE, turned, of_ways=True),
        () if any(find_wrong_turns(RULE, turned, of_ways=False)) else find_lone_turns(RULE, noted),
    )
    yield from itertools.islice(found, 1)


@judges_goals(RULE)
def _find_turned_goals(trials: GoalTrials) -> Iterator[ChildMessage]:
    """Compare how the observation turns the way to the goal with how the engine has turned what moves."""
    for element, _ in trials.drawn.turned:
        frame = _find_wrong_frame(trials, element)
        if frame:
            size = trials.goals.shape[1]
            name = trials.name_elements(element, size)
            message = f"{name} is the way to {trials.drawn.name}, turned by the orientation of {frame} the wrong way"
            evidence = {"element": name, "seed": FIRST_SEED, "value": frame}
            yield RuleFinding(RULE, f"{message}: in no frame of the robot", evidence)
            return


def _find_wrong_frame(trials: GoalTrials, element: int) -> str:
    """Return what has turned the way to the goal the wrong way in several episodes, in which it was turned enough to
    tell; empty if it is in the frame of anything, or there are too few."""
    counts: collections.Counter[_Frame] = collections.Counter()
    others: set[_Frame] = set()
    for seed in range(FIRST_SEED, FIRST_SEED + MOST_EPISODES):
        episode = GoalEpisode(trials, seed, "repeated", PLACED_STEPS)
        if episode.has_ended:
            continue
        turn = episode.read_turn(element) / trials.drawn.read_scale(element)
        for frame, quaternion in _read_orientations(trials.instance).items():
            matrices = [m for m in _list_turns(quaternion, len(turn)) if np.abs(m - m.T).max() >= LEAST_TURN]
            if any(_is_same_turn(turn, matrix.T) for matrix in matrices):
                return ""
            if any(_is_same_turn(turn, matrix) for matrix in matrices):
                counts[frame] += 1
            elif matrices:
                others.add(frame)
    return next((frame.name for frame, count in counts.items() if count >= EPISODES and frame not in others), "")


def _is_same_turn(turn: Array, matrix: Array) -> bool:
    return min(float(np.abs(turn - sign * matrix).max()) for sign in (1.0, -1.0)) < SAME


def _list_turns(quaternion: Array, size: int) -> list[Array]:
    """Return the rotation about the vertical, and in space the whole one. Shape (size, size) each."""
    (matrix,) = attitudes.compute_matrices(quaternion[None])
    yaw = np.arctan2(matrix[1, 0], matrix[0, 0])
    level = np.eye(3)
    level[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    return [level, matrix] if size == 3 else [level[:size, :size]]


def _read_orientations(instance: Instance) -> dict[_Frame, Array]:
    """Return the quaternions, x, y, z, w, of free bodies, and of the links of robots."""
    worlds: list[tuple[World, Poses]] = []
    if (simulation := find_mujoco(instance.env)) is not None:
        reader = MujocoStateReader(*simulation)
        reader.update()
        worlds.append((reader.world, reader.read_poses()))
    for client in instance.find_clients():
        world = read_world(client)
        worlds.append((world, read_poses(world)))
    return {
        _Frame(world.link_name(link), world.client, link): pose[ORIENTATION]
        for world, poses in worlds
        for link, pose in poses.items()
    }
