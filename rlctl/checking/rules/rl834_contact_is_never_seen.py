"""RL834: contact is never seen."""

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np

from rlctl.checking.bullet_fields import NORMAL_FORCE, find_taken_for_force
from rlctl.checking.compared_ids import find_wrong_ids
from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.experiments.worlds import MujocoTrials, WatchedWorlds, judges_trials, judges_worlds
from rlctl.checking.feet import BASE, find_feet, list_touched, read_touches
from rlctl.checking.mujoco_worlds import MujocoStateReader, library
from rlctl.checking.records import FIRST_SEED
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_others
from rlctl.checking.shared_frames import name_observed
from rlctl.checking.source_code import write_code
from rlctl.checking.term_names import is_paid, split_name
from rlctl.checking.world_logs import LoggedWorld
from rlctl.checking.worlds import Array
from rlctl.environments.simulations import find_mujoco

RULE = Rule(
    "RL834",
    "contact is never seen",
    Severity.WARNING,
    meaning="""
        The robot stands on its feet or wheels, and what says so is 0 in every step: a touch sensor of MuJoCo whose
        site does not contain the points of contact, which counts only forces inside its site; or numbers of the
        observation, or a reward term, that are called after the contact of feet. Or such a number is always 1, also
        while nothing touches. Or a line compares the geoms of a contact with ids of joints, or its distance with a
        force. What is rewarded, observed or ended by contacts never changes.
    """,
    fix="""
        Make the site of a touch sensor larger than the geom that touches, and place it around the contact. Compare the
        geoms of a contact with ids of geoms, and not of bodies or links; look them up by their names.
    """,
)

MOSTLY = 0.2  # part of the looks in which a body touches something
AWAY = 0.1  # part of the looks in which nothing touches
FALLEN = 0.1  # part of the looks in which its base touches something
FEWEST = 30  # looks
EPISODES = (("zero", 30), ("random", 40))  # actions and steps
CONTACT_WORDS = {"contact", "contacts", "grounded", "touch", "touches", "touching"}
FEET = {"feet", "foot", "ground", "wheel", "wheels"}
MEANT_WORDS = {"on", "in", "flag", "flags", "force", "forces", "sensor", "sensors", "state", "left", "right", "all"}
"""What may stand beside the words above without saying that something else is touched."""


@judges_expressions(RULE, decides=False)
def _judge_source(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    found = itertools.chain(find_wrong_ids(RULE, noted.definitions, noted.episodes), _find_distances(noted))
    yield from itertools.islice(found, 1)


def _find_distances(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    """Yield where the distance of a contact point has to be larger than it can be, as a force has to."""
    for node, least in find_taken_for_force(noted.definitions, noted.functions, noted.reward.numbers):
        text = write_code(node)
        message = f"{text} is never true: field 8 of a contact point is the distance, below 0 where bodies touch, and"
        message += f" {least:g} m apart there is no contact; the normal force is field 9"
        place = noted.source.find_place(node)
        yield RuleFinding(RULE, message, {"element": text, "value": least}, fix=NORMAL_FORCE, where=place)


@judges_trials(RULE, place=31)
def _find_dead_sensors(trials: MujocoTrials) -> Iterator[RuleFinding]:
    """Yield the touch sensors that are 0 although the bodies of their sites touch something."""
    model = trials.reader.model
    if not (sensors := _list_sensors(model)):
        return
    bodies = model.site_bodyid[model.sensor_objid[sensors]]
    felt, touched, nearest = np.zeros(len(sensors)), np.zeros(len(sensors)), np.full(len(sensors), np.inf)
    looks = 0
    for number, (kind, steps) in enumerate(EPISODES):
        for moment in EpisodePlayer(trials.instance, FIRST_SEED + number, kind, max_steps=steps):
            simulation = find_mujoco(trials.instance.env)
            if moment.step == 0 or simulation is None:
                continue
            data, looks = simulation[1], looks + 1
            felt = np.maximum(felt, data.sensordata[model.sensor_adr[sensors]])
            distances = [_measure_contacts(model, data, sensor) for sensor in sensors]
            touched += np.isfinite(distances)
            nearest = np.minimum(nearest, distances)
    alive = set(bodies[felt > 0].tolist())  # another sensor of the same body may be the one that is meant
    dead = [
        place
        for place, body in enumerate(bodies.tolist())
        if body not in alive and looks >= FEWEST and touched[place] >= MOSTLY * looks
    ]
    if dead:
        names = [model.sensor(sensors[place]).name or f"sensor {sensors[place]}" for place in dead]
        site = int(model.sensor_objid[sensors[dead[0]]])
        message = f"touch sensor {names[0]} is 0 in {looks} steps{list_others(names)}, and its body"
        message += (
            f" {model.body(int(bodies[dead[0]])).name} touches something in {touched[dead[0]] / looks:.0%} of them:"
        )
        message += f" the nearest contact is {nearest[dead[0]]:.3g} m from the centre of site"
        message += (
            f" {model.site(site).name or site}, whose size is {', '.join(f'{x:.3g}' for x in model.site_size[site])} m"
        )
        yield RuleFinding(RULE, message, {"element": names[0], "elements": names[:8], "value": 0.0})


def _list_sensors(model: Any) -> list[int]:
    """Return the touch sensors of a model."""
    return [int(sensor) for sensor in np.flatnonzero(model.sensor_type == int(library().mjtSensor.mjSENS_TOUCH))]


def _measure_contacts(model: Any, data: Any, sensor: int) -> float:
    """Return how far the nearest contact of the body of a sensor is from its site [m]; infinite without one."""
    site = int(model.sensor_objid[sensor])
    contacts = data.contact
    if not data.ncon:
        return np.inf
    geoms = contacts.geom[(contacts.exclude == 0) & (contacts.geom >= 0).all(axis=1)]
    places = contacts.pos[(contacts.exclude == 0) & (contacts.geom >= 0).all(axis=1)]
    of_body = (model.geom_bodyid[geoms] == model.site_bodyid[site]).any(axis=1)
    return float(np.linalg.norm(places[of_body] - data.site_xpos[site], axis=1).min(initial=np.inf))


@judges_worlds(RULE)
def _find_constant_contacts(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    """Yield numbers that are called after contacts of feet and never change, where no touch sensor is their reason."""
    for one in watched.observed:
        reader = one.world.reader
        if isinstance(reader, MujocoStateReader) and _list_sensors(reader.model):
            continue
        feet, robots = find_feet(one.world), [body.id for body in one.world.world.bodies if body.joints]
        looks = [list_touched(log, look) for log in one.logs for look in range(len(log.touching))]
        lies = np.mean([any((robot, BASE) in touched for robot in robots) for touched in looks])
        if lies > FALLEN or len(looks) < FEWEST or not feet:
            continue  # of a robot that fell, others than the feet touch
        touches = np.concatenate([read_touches(log, feet) for log in one.logs])
        standing = touches[:, touches.mean(axis=0) >= MOSTLY]
        count, away = standing.shape[1], float((~touches.any(axis=1)).mean())
        all_stand = float(standing.all(axis=1).mean()) if count else 0.0
        names, parts = name_observed(watched.instance.env, one)
        for place, (name, values) in enumerate(zip(names, one.observed.T, strict=True)):
            if not _is_about_feet(name, one.world):
                continue
            if not values.any() and 0 < parts.count(parts[place]) <= count:
                yield _describe(name, values, f"{count} links of the robot touch something in {MOSTLY:.0%} of them")
                return
            if (values == 1).all() and away >= AWAY:
                yield _describe(name, values, f"nothing touches the robot in {away:.0%} of them")
                return
        for name, values in _read_terms(one.world):
            if _is_about_feet(name, one.world) and len(values) >= FEWEST and not values.any() and all_stand >= MOSTLY:
                what = f"all {count} links that touch something do so at once in {all_stand:.0%} of all looks"
                yield _describe(name, values, what)
                return


def _describe(name: str, values: Array, what: str) -> RuleFinding:
    message = f"{name} is {values[0]:g} in all {len(values)} looks, and {what}"
    return RuleFinding(RULE, message, {"element": name, "value": float(values[0])})


def _read_terms(world: LoggedWorld) -> Iterator[tuple[str, Array]]:
    told = [numbers for log in world.logs for numbers in log.told if numbers]
    for name in dict.fromkeys(name for numbers in told for name in numbers):
        if is_paid(name):
            yield name, np.array([numbers[name] for numbers in told if name in numbers])


def _is_about_feet(name: str, world: LoggedWorld) -> bool:
    """Say whether a name is about contacts with the ground: of a robot with a free base those without another word."""
    words = set(split_name(name.rpartition("/")[2] or name)) - {"observation", "info"}
    words = {word for word in words if not word.isdigit()}
    is_free = any(body.is_free and body.joints for body in world.world.bodies)
    is_known = bool(words & CONTACT_WORDS) and words <= CONTACT_WORDS | FEET | MEANT_WORDS
    return is_known and (is_free or bool(words & FEET) or "grounded" in words)
