"""All recorded steps as one table, and the quantities that rewards and successes are usually made of."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.records import FIRST_SEED, CheckedEpisode, Records
from rlctl.checking.rule import NotJudged
from rlctl.environments.leaves import Leaf, name_element, name_leaf, pick
from rlctl.environments.success import SUCCESS

ROLES = ("episodes", "seeds", "starts", "search")  # each plays other states; the other roles repeat an episode
MOST_ELEMENTS = 64
MOST_COMPARED = 16  # numbers of an observation whose differences are looked at: there are many pairs
LONGEST_BLOCK = 3  # consecutive numbers that may be a vector
FEWEST_STEPS = 100
MOST_ROWS = 1_200  # steps that rewards are fitted to
SCALES = (1, 2, 3, 4, 5, 10, 20)  # [1/m] as rewards use them
UNIT = 1e-4  # how far from 1 the squares of a cosine and a sine may add up
Numbers = NDArray[np.float64]


@dataclasses.dataclass(frozen=True, eq=False)
class Transitions:
    """Steps of many episodes, one a row; observations without the elements that never change."""

    before: Numbers  # Observations that the actions were chosen from. Shape (n, elements)
    after: Numbers  # Observations that step returned. Shape (n, elements)
    actions: Numbers  # Shape (n, numbers)
    earlier_actions: Numbers  # of the step before, 0 at the first one. Shape (n, numbers)
    rewards: Numbers  # Shape (n,)
    success: NDArray[np.bool_]  # Shape (n,)
    terminated: NDArray[np.bool_]  # Shape (n,)
    is_last: NDArray[np.bool_]  # Whether the step ended its episode. Shape (n,)
    seeds: NDArray[np.int64]  # Shape (n,)
    episodes: NDArray[np.int64]  # Number of the episode in this table. Shape (n,)
    names: Sequence[str]  # of the elements

    def select(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> "Transitions":
        """Return some of the rows."""
        fields = [field.name for field in dataclasses.fields(self) if field.name != "names"]
        return dataclasses.replace(self, **{name: getattr(self, name)[rows] for name in fields})


def find_float_leaves(leaves: Sequence[Leaf]) -> list[int]:
    """Return the places of the leaves that observations are read from."""
    return [index for index, leaf in enumerate(leaves) if leaf.supported and leaf.dtype.startswith("float")]


def name_floats(leaves: Sequence[Leaf]) -> list[str]:
    """Return the names of these numbers, in the same order."""
    return [
        name_element(leaves[index], flat)
        for index in find_float_leaves(leaves)
        for flat in range(int(np.prod(leaves[index].shape)))
    ]


def list_float_parts(leaves: Sequence[Leaf]) -> list[tuple[str, int]]:
    """Return the name and the size of each array of these numbers."""
    return [(name_leaf(leaves[index]), int(np.prod(leaves[index].shape))) for index in find_float_leaves(leaves)]


def flatten_floats(leaves: Sequence[Leaf], observation: Any) -> NDArray[np.float64]:
    """Return the numbers of an observation that rules read, shape (elements,).

    Raises `NotJudged` for an observation that does not have them.
    """
    try:
        picked = [pick(observation, leaves[index].path) for index in find_float_leaves(leaves)]
        parts = [np.ravel(np.asarray(part, np.float64)) for part in picked]
    except (LookupError, TypeError, ValueError):
        raise NotJudged("an observation does not fit its space (RL101)") from None
    return np.concatenate([np.zeros(0), *parts])


def collect_transitions(records: Records, *, with_constants: bool = False) -> Transitions:
    """Return the steps of all episodes that differ; raises `NotJudged` where there are too few, or too many numbers."""
    built = records.require_built()
    leaves = find_float_leaves(built.leaves)
    sizes = [int(np.prod(built.leaves[index].shape)) for index in leaves]
    if not leaves or sum(sizes) > MOST_ELEMENTS:
        raise NotJudged(f"the observation has no numbers, or more than {MOST_ELEMENTS}")
    episodes = [episode for episode in records.alone if episode.role in ROLES and _is_whole(episode, leaves)]
    if sum(episode.steps for episode in episodes) < FEWEST_STEPS:
        raise NotJudged(f"fewer than {FEWEST_STEPS} steps were recorded")
    observed = [np.hstack([episode.observations[index].rows for index in leaves]) for episode in episodes]
    names = [built.element(index, flat) for index, size in zip(leaves, sizes, strict=True) for flat in range(size)]
    table = _join(episodes, observed, names, with_constants)
    finite = np.isfinite(table.before).all(axis=1) & np.isfinite(table.after).all(axis=1) & np.isfinite(table.rewards)
    return table.select(finite)


def _is_whole(episode: CheckedEpisode, leaves: Sequence[int]) -> bool:
    series = [episode.observations.get(index) for index in leaves]
    return episode.steps > 0 and all(one is not None and len(one.values) == episode.steps + 1 for one in series)


def _join(
    episodes: Sequence[CheckedEpisode], observed: Sequence[Numbers], names: Sequence[str], with_constants: bool
) -> Transitions:
    lengths = [episode.steps for episode in episodes]
    everything = np.concatenate(observed)
    changes = (everything != everything[0]).any(axis=0) | with_constants
    ends = np.cumsum(lengths) - 1
    has_ended = np.array([episode.has_ended for episode in episodes])
    is_last = np.zeros(sum(lengths), np.bool_)
    is_last[ends] = has_ended
    return Transitions(
        before=np.concatenate([rows[:-1] for rows in observed])[:, changes],
        after=np.concatenate([rows[1:] for rows in observed])[:, changes],
        actions=np.concatenate([episode.taken for episode in episodes]),
        earlier_actions=np.concatenate(
            [np.vstack([np.zeros_like(episode.taken[:1]), episode.taken[:-1]]) for episode in episodes]
        ),
        rewards=np.concatenate([episode.rewards for episode in episodes]),
        success=np.concatenate([_read_success(episode) for episode in episodes]),
        terminated=np.concatenate([episode.terminated for episode in episodes]),
        is_last=is_last,
        seeds=np.repeat([episode.seed for episode in episodes], lengths),
        episodes=np.repeat(np.arange(len(episodes)), lengths),
        names=[name for name, changed in zip(names, changes.tolist(), strict=True) if changed],
    )


def _read_success(episode: CheckedEpisode) -> NDArray[np.bool_]:
    success = np.zeros(episode.steps, np.bool_)
    if SUCCESS in episode.infos:
        series = episode.infos[SUCCESS]
        inside = (series.steps >= 1) & (series.steps <= episode.steps)
        success[series.steps[inside] - 1] = series.values[inside] > 0
    return success


@dataclasses.dataclass(frozen=True, eq=False)
class Quantities:
    """Quantities of observations, one a column."""

    values: Numbers  # Shape (n, quantities)
    names: Sequence[str]

    def __add__(self, other: "Quantities") -> "Quantities":
        return Quantities(np.hstack([self.values, other.values]), [*self.names, *other.names])


def find_lengths(rows: Numbers, names: Sequence[str]) -> Quantities:
    """Return the size of each element, and the lengths of two and three consecutive elements."""
    size = rows.shape[1]
    blocks = [(i, i + k) for k in range(2, LONGEST_BLOCK + 1) for i in range(size - k + 1)]
    columns = [*np.abs(rows).T, *(np.linalg.norm(rows[:, i:j], axis=1) for i, j in blocks)]
    named = [*(f"|{name}|" for name in names), *(f"length of {_span(names[i:j])}" for i, j in blocks)]
    return Quantities(np.array(columns).reshape(len(columns), len(rows)).T, named)


def find_simple(rows: Numbers, names: Sequence[str]) -> Quantities:
    """Return each element, its square and its size, the lengths of two and three consecutive elements, and angles."""
    squares = Quantities(np.square(rows), [f"{name} squared" for name in names])
    angles = []
    for i, j in find_unit_pairs(rows):
        for one, two in ((i, j), (j, i)):
            name, angle = f"the angle of ({names[one]}, {names[two]})", np.arctan2(rows[:, two], rows[:, one])
            angles += [(angle, name), (np.abs(angle), f"|{name}|"), (np.square(angle), f"{name} squared")]
    columns = np.array([angle for angle, _ in angles]).reshape(len(angles), len(rows)).T
    angular = Quantities(columns, [name for _, name in angles])
    return Quantities(rows, names) + squares + find_lengths(rows, names) + angular


def find_unit_pairs(rows: Numbers) -> list[tuple[int, int]]:
    """Return pairs of elements that are a cosine and a sine, or the other way. Shape of rows: (n, elements)."""
    few, squares = np.square(rows[:50]), np.square(rows)
    pairs = [(i, j) for j in range(rows.shape[1]) for i in range(j) if np.abs(few[:, i] + few[:, j] - 1).max() < UNIT]
    return [(i, j) for i, j in pairs if np.abs(squares[:, i] + squares[:, j] - 1).max() < UNIT]


def find_differences(rows: Numbers, names: Sequence[str]) -> Quantities:
    """Return sizes and squares of differences of two elements, and lengths of those of consecutive ones."""
    size, columns, named = rows.shape[1], [], []
    for k in range(1, LONGEST_BLOCK + 1) if size <= MOST_COMPARED else ():
        for i in range(size - 2 * k + 1):
            for j in range(i + k, size - k + 1):
                difference = rows[:, i : i + k] - rows[:, j : j + k]
                text = f"{_span(names[i : i + k])} - {_span(names[j : j + k])}"
                columns.append(np.linalg.norm(difference, axis=1))
                named.append(f"length of {text}" if k > 1 else f"|{text}|")
                if k == 1:
                    columns.append(np.square(difference[:, 0]))
                    named.append(f"({text}) squared")
                else:
                    columns.append(np.abs(difference).sum(axis=1))
                    named.append(f"sum of |{text}|")
    return Quantities(np.array(columns).reshape(len(columns), len(rows)).T, named)


def find_functions(rows: Numbers, names: Sequence[str]) -> Quantities:
    """Return what falls from 1 to 0 with the length of consecutive elements, or of their differences."""
    differences = find_differences(rows, names)
    others = [i for i, name in enumerate(differences.names) if name.startswith(("length", "|"))]
    lengths = find_lengths(rows, names) + Quantities(
        differences.values[:, others], [differences.names[i] for i in others]
    )
    values, of = lengths.values, lengths.names
    columns, named = [1 / (1 + values)], [f"1 / (1 + {name})" for name in of]
    for scale in SCALES:
        columns += [np.exp(-scale * values), np.exp(-scale * np.square(values)), np.tanh(scale * values)]
        forms = ("exp(-{} {})", "exp(-{} {} squared)", "tanh({} {})")
        named += [form.format(scale, name) for form in forms for name in of]
    return Quantities(np.hstack(columns), named)


def _span(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"({names[0]} to {names[-1]})"


def sample_ordinary_steps(steps: Transitions) -> Transitions:
    """Return some steps in random order, without those whose reward may have a bonus or a penalty for the end."""
    steps = steps.select(~(steps.success | steps.terminated | steps.is_last))
    order = np.random.default_rng(FIRST_SEED).permutation(len(steps.rewards))
    return steps.select(order[:MOST_ROWS])
