"""Distances to goals that the reward is computed from: which places the source compares, and how far the place of the
robot gets, by the joints of its model or by what the source clips."""

import ast
import functools
import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.assignments import read_name
from rlctl.checking.compared_places import Bound, ComparedPlaces
from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiments.expressions import EPISODES, NotedEpisodes
from rlctl.checking.expressions import NotedCall
from rlctl.checking.goal_distances import DistanceReader, GoalDistance
from rlctl.checking.joint_places import find_span, read_limited_joints
from rlctl.checking.records import FIRST_SEED
from rlctl.checking.source_code import Expression
from rlctl.checking.summands import Summand
from rlctl.checking.vector_series import SAME
from rlctl.checking.workspaces import Chain, find_chains, measure_box
from rlctl.checking.worlds import Joint
from rlctl.environments.bullet_clients import ClientCalls

Array = NDArray[np.float64]

TRIED, STEPS = range(5, 13), 10  # more episodes, for links and for goals, and steps of each
RIGID = 1e-5  # by which the distance of a place and its link may change [m]
LONGEST_OFFSET = 0.5  # between both [m]
LATE, MOST_LATE = 0.01, 0.05  # the same of a place that is read a substep late, mostly and at most [m]
FALLS = 0.3  # correlation of a summand with a distance
FEWEST = 10  # steps in which both places are known
LAG = 0.15  # part of a clipped range by which a place may be off
FEWEST_CLIPPED, CLEARLY = 3, 3.0  # steps; how many times further beyond an end what is clipped is than the robot
LONGEST_TEXT = 60
MOST_AXES = 8
PLANES_AND_SPACE = (2, 3)  # axes of places that links have
OVER = 0.05  # part of a joint's range by which it may be beyond its limits
LEAST_MOTION = 1e-3  # range of a place that moves


class BoundReader:
    """Finds where the robot gets, of the places that are compared with goals."""

    def __init__(self, notes: NotedEpisodes) -> None:
        self.notes = notes

    def list_places(self) -> Iterator[ComparedPlaces]:
        """Yield the two places of each distance, in both orders."""
        for distance in self.notes.share(DistanceReader).measured:
            if not distance.is_told and not self._is_paid_near(distance):
                continue
            known = [self.notes.source.find(side.node) for side in distance.sides]
            if known[0] is None or known[1] is None:
                continue
            robots, goals = (self._read(one) for one in known)
            if robots is None or goals is None or robots[0].shape[1] != goals[0].shape[1]:
                continue
            yield ComparedPlaces(distance, known[0], known[1], robots, goals)
            yield ComparedPlaces(distance, known[1], known[0], goals, robots)

    def _is_paid_near(self, distance: GoalDistance) -> bool:
        """Say whether the reward falls with a distance."""
        known = [self._correlate(distance.expression, summand) for summand in distance.summands if summand.weight]
        rises = [one for one in known if one is not None]
        return bool(rises) and max(rises) < -FALLS

    def _correlate(self, length: Expression, summand: Summand) -> float | None:
        """Return how a summand, with its sign, rises with a distance; None where that is not known."""
        one = self.notes.source.find(summand.place.node)
        pairs = [
            [call.values.get(each.number, [None])[-1] for each in (length, one)]
            for call in self.notes.steps
            if one is not None
        ]
        rows = np.array([pair for pair in pairs if all(isinstance(value, float) for value in pair)], np.float64)
        if len(rows) < FEWEST or not (rows.std(axis=0) > 0).all() or not np.isfinite(summand.weight):
            return None
        from_mean = (rows - rows.mean(axis=0)) / rows.std(axis=0)
        return float(np.sign(summand.weight) * from_mean.prod(axis=1).mean())

    def _read(self, one: Expression | None) -> list[Array] | None:
        """Return what an expression of a few elements was worth at the end of each step, by episode."""
        return self._read_all(one, [episode[1:] for episode in self.notes.episodes]) if one is not None else None

    def _read_all(self, one: Expression, episodes: Sequence[Sequence[NotedCall]]) -> list[Array] | None:
        found = []
        for calls in episodes:
            values = [call.values.get(one.number, [None])[-1] for call in calls]
            sizes = {np.shape(value) for value in values if value is not None}
            if len(sizes) != 1 or len(shape := sizes.pop()) > 1 or not 0 < math.prod(shape) <= MOST_AXES:
                return None
            missing = np.full(math.prod(shape), np.nan)
            found.append(np.array([missing if value is None else np.ravel(value) for value in values]))
        return found

    def list_bounds(self, places: ComparedPlaces) -> Iterator[Bound]:
        """Yield what limits where the place of the robot gets."""
        rows = np.concatenate(places.robots)
        rows = rows[np.isfinite(rows).all(axis=1)]
        if len(rows) < FEWEST or np.ptp(rows, axis=0).max() < LEAST_MOTION or not places.may_be_fixed:
            return
        finders = (self._find_by_positions, self._find_by_joints, self._find_by_clips)
        bounds = (find(places) for find in finders)
        yield from (one for one in bounds if one is not None)

    def _find_by_positions(self, places: ComparedPlaces) -> Bound | None:
        """Return the ends between which the limits of joints keep what is the position of one of them."""
        instance = self.notes.instance
        if not read_limited_joints(instance.env, instance.find_clients()):
            return None
        rows = self._read_all(places.robot, [[call for call, _, _ in steps] for steps in self._samples])
        if rows is None:
            return None
        looks = [joints for steps in self._samples for _, _, joints in steps]
        spans = [find_span(column, looks) for column in np.concatenate(rows).T]
        if not any(spans):
            return None
        ends = [(-np.inf, np.inf, np.inf) if one is None else (one.low, one.high, one.period) for one in spans]
        low, high, periods = np.array(ends).T
        robots = np.concatenate(places.robots)
        beyond = np.fmax(np.nanmax(robots, axis=0) - high, low - np.nanmin(robots, axis=0))
        if (beyond > OVER * (high - low)).any():
            return None  # it is placed, whatever the limits
        names = ", ".join(dict.fromkeys(one.joint for one in spans if one is not None))
        return Bound(low, high, f"the limits of {names} keep it there", periods)

    def _find_by_joints(self, places: ComparedPlaces) -> Bound | None:
        if places.robots[0].shape[1] not in PLANES_AND_SPACE:
            return None
        for number, chain in enumerate(self._chains):
            robots, _ = self._compare_links(places.robot, number)
            goals, _ = self._compare_links(places.goal, number)
            if not robots or goals:
                continue  # a place that moves with the same joints
            link = min(robots, key=lambda one: robots[one])
            low, high = self._measure(number, link)
            size, offset = places.robots[0].shape[1], robots[link]
            how = f"{chain.names[link]} was moved by all joints within their limits"
            return Bound(low[:size] - offset, high[:size] + offset, how)
        return None

    @functools.cached_property
    def _chains(self) -> list[Chain]:
        instance = self.notes.instance
        EpisodePlayer(instance, FIRST_SEED, max_steps=0).reset()
        return list(find_chains(instance.env, instance.find_clients()))

    @functools.cached_property
    def _samples(self) -> list[list[tuple[NotedCall, list[Array], list[tuple[str, Joint, float]]]]]:
        """Steps of more episodes, and where the links of each chain and the joints with limits were after them."""
        found: list[list[tuple[NotedCall, list[Array], list[tuple[str, Joint, float]]]]] = []
        recorder, instance = self.notes.recorder, self.notes.instance
        for number in TRIED:
            kind = EPISODES[number % len(EPISODES)]
            player = EpisodePlayer(instance, FIRST_SEED + number, kind, number=number, max_steps=STEPS)
            player.reset()
            clients = instance.find_clients()
            found.append([])
            while not player.ended:
                with recorder.call(player.steps + 1) as noted:
                    player.step()
                chains = find_chains(instance.env, clients)
                joints = read_limited_joints(instance.env, clients)
                found[-1].append((noted, [chain.read() for chain in chains], joints))
        return found

    def list_goals(self, places: ComparedPlaces) -> list[Array]:
        """Return the place of the goal in each step of all episodes that were played, by episode."""
        more = [[call for call, _, _ in steps] for steps in self._samples]
        return [*places.goals, *(self._read_all(places.goal, more) or ())]

    def _compare_links(self, one: Expression, number: int) -> tuple[dict[int, float], int]:
        """Return the links of a chain that a place always has the same distance to, with that distance [m]."""
        steps = [step for episode in self._samples for step in episode]
        pairs = [(noted.values.get(one.number, [None])[-1], links[number]) for noted, links, _ in steps]
        known = [(np.asarray(value), links) for value, links in pairs if value is not None and np.shape(value)]
        if len(known) < FEWEST:
            return {}, 0
        offsets = np.array([np.linalg.norm(links[:, : value.size] - value, axis=1) for value, links in known])
        is_rigid = (np.ptp(offsets, axis=0) < RIGID) & (offsets.max(axis=0) < LONGEST_OFFSET)
        moves = np.ptp([links for _, links in known], axis=0).max(axis=1) > LEAST_MOTION
        if known[0][0].size < 3:
            is_rigid &= offsets.max(axis=0) < RIGID
        # MuJoCo's places are those before the last substep.
        is_rigid |= (np.median(offsets, axis=0) < LATE) & (offsets.max(axis=0) < MOST_LATE)
        return {int(link): float(offsets[:, link].max()) for link in np.flatnonzero(is_rigid & moves)}, len(known)

    def _measure(self, number: int, link: int) -> tuple[Array, Array]:
        instance = self.notes.instance
        clients = [ClientCalls(client) for client in instance.find_clients()]
        states = [client.saveState() for client in clients]
        try:
            return measure_box(self._chains[number], link)
        finally:
            for client, state in zip(clients, states, strict=True):
                client.restoreState(state)
                client.removeState(state)

    def _find_by_clips(self, places: ComparedPlaces) -> Bound | None:
        """Return the ends between which the source clips what the place of the robot follows, where it is clipped: what
        is given to the clip is beyond an end then, and the robot is not."""
        robots = np.concatenate(places.robots)
        known = np.isfinite(robots).all(axis=1)
        for one in self.notes.source.expressions:
            ends = self._read_clip(one, robots.shape[1])
            if ends is None or not isinstance(one.node, ast.Call):
                continue
            before, after = (self._read(part) for part in (self.notes.source.find(one.node.args[0]), one))
            if before is None or after is None:
                continue
            if not np.concatenate(before).shape == np.concatenate(after).shape == robots.shape:
                continue
            low, high = ends
            given, clipped, places_of_robot = np.concatenate(before)[known], np.concatenate(after)[known], robots[known]
            if not (np.abs(places_of_robot - clipped) < LAG * (high - low)).all():
                continue
            is_low, lowest = _find_limit(-given, -places_of_robot, -low)
            is_high, highest = _find_limit(given, places_of_robot, high)
            if is_low.any() or is_high.any():
                # What is the value of the clip itself is limited at its other end, too.
                is_itself = (np.abs(places_of_robot - clipped) < SAME).all(axis=0) & (is_low | is_high)
                is_low, is_high = is_low | is_itself, is_high | is_itself
                text = one.text if len(one.text) < LONGEST_TEXT else "np.clip"
                ends = np.where(is_low, -lowest, -np.inf), np.where(is_high, highest, np.inf)
                return Bound(*ends, f"{text} keeps it there")
        return None

    def _read_clip(self, one: Expression, size: int) -> tuple[Array, Array] | None:
        match one.node:
            case ast.Call(func=function, args=[_, low, high]) if read_name(function) == "clip":
                found = [self._read_constant(end, size) for end in (low, high)]
            case _:
                return None
        if found[0] is None or found[1] is None or not (found[0] < found[1]).all():
            return None
        return found[0], found[1]

    def _read_constant(self, node: ast.expr, size: int) -> Array | None:
        if isinstance(number := self.notes.reward.numbers.read_constant(node), float):
            return np.full(size, number)
        rows = self._read(self.notes.source.find(node))
        if rows is None:
            return None
        joined = np.concatenate(rows)
        joined = joined[np.isfinite(joined).all(axis=1)]
        return joined[0] if len(joined) and joined.shape[1] == size and np.ptp(joined, axis=0).max() < SAME else None

    def find_tolerance(self, places: ComparedPlaces) -> float | None:
        """Return the largest constant that the distance of both places is compared with, after this step or the one
        before; None where there is none."""
        found = []
        lengths = [np.linalg.norm(one - other, axis=1) for one, other in zip(places.robots, places.goals, strict=True)]
        for one in self.notes.source.expressions:
            match one.node:
                case ast.Compare(left=left, comparators=[right], ops=[ast.Lt() | ast.LtE() | ast.Gt() | ast.GtE()]):
                    pairs = ((left, right), (right, left))
                case _:
                    continue
            for length, limit in pairs:
                constant = self.notes.reward.numbers.read_constant(limit)
                if constant is not None and self._is_length(length, lengths):
                    found.append(constant)
        return max(found, default=None)

    def _is_length(self, node: ast.expr, lengths: Sequence[Array]) -> bool:
        one = self.notes.source.find(node)
        count = 0
        for episode, rows in zip(self.notes.episodes, lengths, strict=True):
            for step, call in enumerate(episode[1:] if one is not None else ()):
                value = call.values.get(one.number, [None])[-1] if one is not None else None
                near = rows[step - 1 : step + 1]  # nothing is known before the first one
                if not isinstance(value, float) or len(near) < 2 or not np.isfinite(near).all():
                    continue
                if np.abs(near - value).min() > SAME * max(1.0, value):
                    return False
                count += 1
        return count >= FEWEST


def _find_limit(given: Array, robot: Array, end: Array) -> tuple[NDArray[np.bool_], Array]:
    """Return along which axes a clip limits a place, of what is given to it, and how far the place came."""
    over, beyond = (np.maximum(0.0, np.nanmax(rows - end, axis=0)) for rows in (given, robot))
    count = (given > end + SAME).sum(axis=0)
    return (count >= FEWEST_CLIPPED) & (CLEARLY * beyond < over), end + beyond
