"""RL631: one finger counts as a grasp."""

import functools
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from rlctl.checking.contact_trials import PlayedContacts, make_contacts, play_in_bullet, play_in_mujoco
from rlctl.checking.experiments.worlds import WatchedWorlds, judges_worlds
from rlctl.checking.instance import EnvironmentRaised
from rlctl.checking.mujoco_worlds import MujocoStateReader
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names
from rlctl.checking.term_names import is_about_grasps
from rlctl.checking.world_logs import LoggedWorld
from rlctl.checking.worlds import Array, Link
from rlctl.environments.bullet_calls import Contacts

RULE = Rule(
    "RL631",
    "one finger counts as a grasp",
    Severity.WARNING,
    meaning="""
        A number of info that is called a grasp, such as a reward term, becomes positive as soon as one finger touches
        the object, and with another finger alone as well. The check showed the environment a contact of a single part
        of the robot with the object, and no other one. Pressing one finger on the object is then paid as holding it.
    """,
    fix="""
        Ask for the contacts of both fingers with the object, and join the answers by and, not by or.
    """,
)

MOST_LINKS = 12
FEWEST_FINGERS = 2


@judges_worlds(RULE, place=96)
def _judge_worlds(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    if not watched.instance.accepts_seed or watched.instance.context.budget.is_over():
        return
    for world in watched.worlds:
        bodies = world.world.bodies
        objects = [(body.id, -1) for body in bodies if body.is_free and not body.joints]
        parts = [(body.id, link) for body in bodies if body.joints for link in range(-1, len(body.links) - 1)]
        try:
            if objects and _list_grasps(_show(watched, world, None)):
                yield from _find_single_fingers(watched, world, parts, objects)
        except EnvironmentRaised:  # an episode that was logged raised it too, or it needs a contact that is left out
            return


def _find_single_fingers(
    watched: WatchedWorlds, world: LoggedWorld, parts: Sequence[Link], objects: Sequence[Link]
) -> Iterator[RuleFinding]:
    idle = _read_largest(_show(watched, world, None))
    for thing in objects:
        fingers: dict[str, list[tuple[Link, float]]] = {}
        for part in reversed(parts[-MOST_LINKS:]):
            paid = _read_largest(_show(watched, world, (part, thing)))
            for name, value in paid.items():
                if value > 0 >= idle.get(name, 1.0):
                    fingers.setdefault(name, []).append((part, value))
        for name, each in fingers.items():
            if len(each) >= FEWEST_FINGERS:
                yield _describe(world, name, each, thing)
                return


def _list_grasps(played: PlayedContacts) -> list[int]:
    return [column for column, name in enumerate(played.names) if name.startswith("info[") and _is_grasp(name)]


def _is_grasp(name: str) -> bool:
    return is_about_grasps(name.removeprefix("info['").removesuffix("']").rpartition("/")[2])


def _read_largest(played: PlayedContacts) -> dict[str, float]:
    """Return the largest value of each number that is called a grasp."""
    rows = [row for rows in played.rows for row in rows if row.shape == played.rows[0][0].shape]
    return {played.names[column]: float(np.max([row[column] for row in rows])) for column in _list_grasps(played)}


def _show(watched: WatchedWorlds, world: LoggedWorld, pair: tuple[Link, Link] | None) -> PlayedContacts:
    """Play episodes in which the environment is shown one contact, or none."""
    reader = world.reader
    if not isinstance(reader, MujocoStateReader):
        return play_in_bullet(watched, world, functools.partial(_replace_in_bullet, pair))
    geoms = [reader.find_geom(link) for link in pair or ()]
    shown = np.array([geoms] if geoms and None not in geoms else np.zeros((0, 2)))

    def change(_: Array) -> Array:
        return shown

    return play_in_mujoco(watched, change)


def _replace_in_bullet(pair: tuple[Link, Link] | None, asked: Sequence[int | None], _: Contacts) -> Contacts:
    return tuple(make_contacts(asked, pair)) if pair is not None else ()


def _describe(world: LoggedWorld, name: str, fingers: Sequence[tuple[Link, float]], thing: Link) -> RuleFinding:
    names = [world.world.link_name(link) for link, _ in fingers]
    what = f"{name} is {fingers[0][1]:.4g} where only {names[0]} touches {world.world.link_name(thing)}"
    message = f"{what}, and so it is with {list_names(names[1:], 3)} alone; without a contact it is 0"
    evidence: dict[str, Any] = {"element": name, "value": fingers[0][1], "expected": 0.0}
    return RuleFinding(RULE, message, evidence)
