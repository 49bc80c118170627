"""Numbers of info, and terms of the reward, that are how far something moved in a step over the time of the physics."""

import dataclasses
import math
from collections.abc import Collection, Iterator, Mapping, Sequence

import numpy as np

from rlctl.checking import attitudes
from rlctl.checking.body_frames import list_turns_of
from rlctl.checking.experiments.attributes import AttributeLog
from rlctl.checking.rewards import RAW_TERMS, TERMS
from rlctl.checking.step_times import StepTimes
from rlctl.checking.term_names import is_paid
from rlctl.checking.world_logs import WorldLog
from rlctl.checking.worlds import FRAME, TURN, Array

REWARD = "the reward"  # the name of what a step pays in all
CLOSE = 1e-3  # part of a number's standard deviation: differences of float32 positions
SAME = 2e-3  # relative error of a weight
NEARLY_ALL, FEWEST_STEPS = 0.95, 40  # of all steps: goals are drawn again
LEAST_WAY = 1e-6  # standard deviation of what moves in a step [m], [rad]
MOST_PLACES = 30  # links, or angles, by whose orientation ways are turned


@dataclasses.dataclass(frozen=True, eq=False)
class Ways:
    """How far what moves in each step, in the world's axes and in those of bodies."""

    values: Array  # Shape (steps, ways)
    names: Sequence[str]


@dataclasses.dataclass(frozen=True)
class ToldSpeed:
    """A number that is a way over the time of a step of the physics, times a weight."""

    name: str
    way: str
    weight: float


def find_told_speeds(
    told: Mapping[str, Array], ways: Ways, times: StepTimes, weights: Collection[float], actions: Array
) -> Iterator[ToldSpeed]:
    """Yield the numbers that are ways over the wrong time; of terms of the reward the weight must be a known one, and
    the reward may also have terms of the actions, shape (steps, numbers)."""
    moves = ways.values.std(axis=0) > LEAST_WAY
    values, names = ways.values[:, moves], [name for name, moving in zip(ways.names, moves, strict=True) if moving]
    for name, numbers in told.items():
        rows = np.isfinite(numbers)
        if rows.sum() < FEWEST_STEPS or numbers[rows].std() <= LEAST_WAY or not names:
            continue
        is_term = name == REWARD or (is_paid(name) and RAW_TERMS not in name)
        known = {1.0, *weights} if is_term else {1.0}
        found = list(_match(name, numbers[rows], values[rows], names, times, known))
        if not found and name == REWARD:
            both = _leave(_list_action_terms(actions[rows]), np.column_stack([numbers[rows], values[rows]]))
            found = list(_match(name, both[:, 0], both[:, 1:], names, times, known))
        yield from found


def _list_action_terms(actions: Array) -> Array:
    changes = np.diff(actions, axis=0, prepend=actions[:1])
    sums = [np.square(changes).sum(axis=1), np.linalg.norm(actions, axis=1)]
    return np.column_stack([np.ones(len(actions)), actions, np.square(actions), np.abs(actions), *sums])


def _leave(terms: Array, numbers: Array) -> Array:
    """Return what terms leave of numbers. Shapes (n, terms) and (n, k)."""
    basis, sizes, _ = np.linalg.svd(terms, full_matrices=False)
    basis = basis[:, sizes > 1e-9 * sizes[0]]
    return np.asarray(numbers - basis @ (basis.T @ numbers))


def _match(
    name: str, numbers: Array, ways: Array, names: Sequence[str], times: StepTimes, known: Collection[float]
) -> Iterator[ToldSpeed]:
    if numbers.std() <= LEAST_WAY:
        return
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = np.where(np.abs(ways) > LEAST_WAY, numbers[:, None] / ways, np.nan)
    factors = np.array(
        [np.median(ratio[np.isfinite(ratio)]) if np.isfinite(ratio).any() else 0.0 for ratio in ratios.T]
    )
    near = (np.abs(numbers[:, None] - factors * ways) <= CLOSE * numbers.std()).mean(axis=0)
    for way in np.flatnonzero(near >= NEARLY_ALL).tolist():
        factor = abs(float(factors[way]))
        right, wrong = factor * times.control_s, factor * times.physics_s
        # A way itself may be paid, times a weight.
        if any(math.isclose(one, weight, rel_tol=SAME) for weight in known for one in (right, factor)):
            return
        if any(math.isclose(wrong, weight, rel_tol=SAME) for weight in known):
            yield ToldSpeed(name, names[way], wrong)
            return


def read_engine_ways(logs: Sequence[WorldLog]) -> Ways | None:
    """Return how links moved in each step, in the world, and in the axes of each by its orientation before or after,
    whole or about the vertical only, and their lengths; None where it is not known of all looks."""
    columns: list[Array] = []
    if len({rows.shape for log in logs for rows in log.points}) != 1:
        return None
    for log in logs:
        rows = np.stack(log.points)[:, :MOST_PLACES]
        ways = np.diff(rows[:, :, FRAME], axis=0)  # Shape (steps, links, 3)
        parts = [
            ways,
            np.linalg.norm(ways, axis=2, keepdims=True),
            np.linalg.norm(ways[..., :2], axis=2, keepdims=True),
        ]
        for turns in (rows[1:, :, TURN], rows[:-1, :, TURN]):
            flat = attitudes.rotate(turns.reshape(-1, 4), ways.reshape(-1, 3))
            parts += [flat.reshape(*ways.shape[:2], -1)[..., [0, 1, 2, 6, 7]]]
        columns.append(np.concatenate(parts, axis=2).reshape(len(ways), -1))
    names = [f"the place of {name}" for name in logs[0].reader.name_points()[:MOST_PLACES]]
    per_link = columns[0].shape[1] // max(1, len(names))
    return Ways(np.nan_to_num(np.concatenate(columns)), [name for name in names for _ in range(per_link)])


def read_attribute_ways(log: AttributeLog) -> Ways:
    """Return how attributes changed in each step, and two of them in the axes of an angle, or as a length."""
    steps = np.flatnonzero(log.is_step)
    changes = log.changes(log.values)
    columns, names = [changes], list(log.names)
    first = [i for i in range(len(log.names) - 1) if _are_neighbours(log.names[i], log.names[i + 1])]
    turns = [(name, matrices) for name, matrices in list_turns_of(log.names, log.values) if matrices.shape[1] == 3]
    for i in first:
        pair, name = changes[:, i : i + 2], f"({log.names[i]}, {log.names[i + 1]})"
        columns.append(np.linalg.norm(pair, axis=1, keepdims=True))
        names.append(f"the length of {name}")
        for turn, matrices in turns[:MOST_PLACES]:
            for looks in (steps, steps - 1):
                columns.append(np.einsum("nji,nj->ni", matrices[looks][:, :2, :2], pair))
                names += [f"{name}, turned by {turn},"] * 2
    return Ways(np.hstack(columns), names)


def _are_neighbours(one: str, two: str) -> bool:
    return one.rpartition("[")[0] == two.rpartition("[")[0]


def read_told(infos: Mapping[str, Array], rewards: Array) -> dict[str, Array]:
    """Return the numbers that may be speeds; terms without their weights tell more than the same with them."""
    is_raw = any(name.startswith(RAW_TERMS) for name in infos)
    told = {name: values for name, values in infos.items() if not (is_raw and name.startswith(TERMS))}
    return {f"info[{name!r}]": values for name, values in told.items()} | {REWARD: rewards}
