"""Relations between the signals of nearby rows, learned from rollouts in simulation.

Each relation predicts one element of an observation: from the other observations (`across`), its change from the other
observations (`moves`), from the rows before and the actions (`ahead`), or from nothing, its usual value (`alone`). A
`window` holds the standardised observations of five rows, two actions that the robot executed, and a logged action.
All are linear in the window and in random tanh features of a few observations of the row: positions of links are no
linear functions of angles, and gravity and inertia change with the pose.
"""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from rlctl_robot.diagnose.correction import EVERYTHING, Correction, turn
from rlctl_robot.diagnose.reference import Recordings
from rlctl_robot.diagnose.rows import measure_motion
from rlctl_robot.diagnose.signals import ACTIONS, Array, LoggedSignals

_RIDGE = 1e-3  # about the variance of a sensor's noise: what only differences below the noise tell is not used
_SMALLEST_ERROR = 0.01  # of an element's standard deviation: sensors are no better
_WIDER = 1.5  # errors are counted in units of so many usual errors
_FEATURES = 400
_MOST_INPUTS = 3  # observations of a feature
_STEEPNESS = (0.7, 2.0)  # of a feature
STRIDE = 8  # rows to the first and the last row of a window: changes in so long a time are larger than noise
STEPS = (-STRIDE, -1, 0, 1, STRIDE)  # the rows of a window
_BLOCK = 24  # rows after which errors of predictions are independent of those before
_ECHO = 1e-4  # median difference to the action before, of an observation that repeats it


class Windows:
    """Lays out windows, and makes them from signals with corrections."""

    def __init__(self, reference: Recordings) -> None:
        self.sizes, self.slices = reference.sound.sizes, reference.sound.slices
        self.width = sum(self.sizes.values())
        self.statistics = reference.statistics
        self.actions = len(self.statistics[ACTIONS].mean)
        self.columns = {
            name: np.arange(len(STEPS) * part.start, len(STEPS) * part.stop) for name, part in self.slices.items()
        }
        base = len(STEPS) * self.width
        self.columns[ACTIONS] = np.arange(base, base + 2 * self.actions)  # executed: before, and at the row
        self.logged_action = np.arange(base + 2 * self.actions, base + 3 * self.actions)  # before
        self.total = base + 3 * self.actions
        self.features = _FEATURES
        self._draw_features()

    def _draw_features(self) -> None:
        """Draw features, each of a few of the observations and of the executed action of the middle row."""
        rng = np.random.default_rng(0)
        middle = STEPS.index(0)
        inputs = {name: self.columns[name][middle * n : (middle + 1) * n] for name, n in self.sizes.items()}
        inputs[ACTIONS] = self.columns[ACTIONS][self.actions :]
        names = list(inputs)
        self.projection = np.zeros((self.total, self.features))
        uses: dict[str, list[int]] = {name: [] for name in names}
        for index in range(self.features):
            count = min(int(rng.integers(1, _MOST_INPUTS + 1)), len(names))
            some = [names[number] for number in rng.choice(len(names), count, replace=False)]
            columns = np.concatenate([inputs[name] for name in some])
            steepness = rng.uniform(*_STEEPNESS) / np.sqrt(len(columns))
            self.projection[columns, index] = steepness * rng.standard_normal(len(columns))
            for name in some:
                uses[name].append(index)
        self.features_of = {name: np.array(some, np.int64) for name, some in uses.items()}
        self.bias = rng.uniform(-1.0, 1.0, self.features)

    def extend(self, window: Array) -> Array:
        """Return windows with their features, shape (rows, total + features)."""
        return np.concatenate([window, np.tanh(window @ self.projection + self.bias)], axis=1)

    def make(self, signals: LoggedSignals, rows: Array, corrections: Sequence[Correction] = ()) -> Array:
        """Return the windows of rows, shape (rows, total)."""
        window = np.empty((len(rows), self.total))
        for name in (*self.sizes, ACTIONS):
            window[:, self.columns[name]] = self.block(name, signals, rows, corrections)
        window[:, self.logged_action] = self._standardize(ACTIONS, signals.actions[rows - 1])
        return window

    def block(self, name: str, signals: LoggedSignals, rows: Array, corrections: Sequence[Correction]) -> Array:
        """Return the part of the windows with an observation, or with the executed actions."""
        own = [one for one in corrections if one.term in (name, EVERYTHING)]
        late = sum(one.delay for one in own)
        is_action = name == ACTIONS
        steps, late = ((-1, 0), -late) if is_action else (STEPS, late)
        part, parts = signals.term(name), []
        for step in steps:
            values = part[rows + step + late]
            for one in own:
                values = self._apply(one, name, values)
                if one.frame:
                    values = turn(values, signals.term(one.attitude)[rows + step], one.frame)
            parts.append(self._standardize(name, values))
        return np.concatenate(parts, axis=1)

    def _apply(self, one: Correction, name: str, values: Array) -> Array:
        if one.term == EVERYTHING and name != EVERYTHING:
            if name == ACTIONS:
                return values
            columns = self.slices[name]
            return values * np.array(one.factor)[columns] + np.array(one.offset)[columns]
        return one.change(values)

    def _standardize(self, name: str, values: Array) -> Array:
        statistics = self.statistics[name]
        standardized: Array = (values - statistics.mean) / statistics.std
        return standardized


@dataclasses.dataclass(frozen=True, eq=False)
class Relations:
    """errors = extended window @ matrix.T + constant, in units of the usual error; a row per relation."""

    matrix: Array  # shape (relations, total + features)
    constant: Array
    element: Array  # the element of the observation that is predicted
    samples: Array  # how many independent rows a row counts for, in (0, 1]
    typical: Array  # mean loss of logs of a sound robot
    kind: tuple[str, ...]


def compute_losses(errors: Array) -> Array:
    """Return log(1 + error^2) / 2: for large errors it grows as the logarithm, so one mistake does not hide another."""
    losses: Array = 0.5 * np.log1p(np.square(errors))
    return losses


def fit_relations(reference: Recordings, windows: Windows) -> tuple[Relations, list[str]]:
    """Return the relations, and the observations that repeat the action before."""
    train, held = (
        np.concatenate([windows.extend(windows.make(signals, signals.inner_rows(STRIDE))) for signals in some])
        for some in ((reference.sound, reference.varied), (reference.held_out,))
    )
    held_out = reference.held_out
    motion = measure_motion(held_out, held_out.inner_rows(STRIDE), windows.statistics)
    echoes = [name for name in windows.sizes if _repeats_action(reference.sound, windows, name)]
    rows, constants, kinds, elements = [], [], [], []
    for kind, name, targets, weights, bias in _list_fits(train, windows, echoes):
        for index in range(windows.sizes[name]):
            row = targets[index].copy()
            row -= weights[index]
            rows.append(row)
            constants.append(-bias[index])
            kinds.append(kind)
            elements.append(windows.slices[name].start + index)
    matrix, constant = np.array(rows), np.array(constants)
    errors, all_errors = (rows @ matrix.T + constant for rows in (held, train))
    usual = np.sqrt(np.average(np.square(errors), axis=0, weights=motion))
    # `alone` also where a wrong mapping gets: a robot that has fallen is no mistake of each of its sensors.
    anywhere = np.sqrt(np.mean(np.square(all_errors), axis=0))
    usual = np.where(np.array(kinds) == "alone", np.maximum(usual, anywhere), usual)
    scale = _WIDER * np.maximum(usual, _SMALLEST_ERROR)
    losses = compute_losses(errors / scale)
    episodes = np.split(losses, np.cumsum([length - 2 * STRIDE for length in held_out.lengths])[:-1])
    blocks = [part[begin : begin + _BLOCK] for part in episodes for begin in range(0, len(part) - _BLOCK + 1, _BLOCK)]
    samples = np.where(np.array(kinds) == "alone", _count_samples(losses, episodes), _count_samples(losses, blocks))
    samples[np.isin(elements, _find_elements(windows, echoes))] = 1.0
    typical = np.average(losses, axis=0, weights=motion)
    return Relations(
        matrix / scale[:, None], constant / scale, np.array(elements), samples, typical, tuple(kinds)
    ), echoes


def _find_elements(windows: Windows, names: Sequence[str]) -> list[int]:
    return [index for name in names for index in range(windows.slices[name].start, windows.slices[name].stop)]


def _repeats_action(signals: LoggedSignals, windows: Windows, name: str) -> bool:
    values, rows = signals.term(name), signals.inner_rows(1)
    if values.shape[1] != windows.actions:
        return False
    difference = np.abs(values[rows] - signals.actions[rows - 1]) / windows.statistics[ACTIONS].std
    return bool(np.median(difference) < _ECHO)


def _list_fits(train: Array, windows: Windows, echoes: Sequence[str]) -> Iterator[tuple[str, str, Array, Array, Array]]:
    """Yield kind, observation, targets and weights as rows of a matrix over windows, and the biases."""
    sizes, columns, total = windows.sizes, windows.columns, windows.total + windows.features
    features = np.arange(windows.total, total)
    gram = _Gram(train)
    plain = [name for name in sizes if name not in echoes]
    of_echoes = np.concatenate([np.zeros(0, np.int64), *(windows.features_of[name] for name in echoes)])
    nothing = np.zeros(0, np.int64)
    for name in plain:
        size, own = sizes[name], columns[name]
        first, _, now, after, last = (own[step * size : (step + 1) * size] for step in range(len(STEPS)))
        others = np.concatenate([*(columns[other] for other in plain if other != name), columns[ACTIONS]])
        others = np.concatenate([others, np.delete(features, np.union1d(windows.features_of[name], of_echoes))])
        past = np.concatenate([*(columns[other][sizes[other] : 3 * sizes[other]] for other in plain), columns[ACTIONS]])
        past = np.concatenate([past, np.delete(features, of_echoes)])
        eye = np.eye(total)
        for kind, targets, inputs in (
            ("across", eye[now], others),
            ("moves", eye[last] - eye[first], others),
            ("ahead", eye[after], past),
            ("alone", eye[now], nothing),
        ):
            weights, bias = gram.solve(targets, inputs)
            yield kind, name, targets, weights, bias
    for name in echoes:
        size, eye = sizes[name], np.eye(total)
        usual, action = windows.statistics[name], windows.statistics[ACTIONS]
        targets = eye[columns[name][2 * size : 3 * size]]
        weights = eye[windows.logged_action] * (action.std / usual.std)[:, None]
        yield "across", name, targets, weights, (action.mean - usual.mean) / usual.std


class _Gram:
    """Ridge regressions of different columns of the same rows."""

    def __init__(self, rows: Array) -> None:
        ones = np.column_stack([rows, np.ones(len(rows))])
        self._gram = ones.T @ ones / len(rows)
        self._total = rows.shape[1]

    def solve(self, targets: Array, inputs: Array) -> tuple[Array, Array]:
        """Return the weights over all columns, shape (targets, columns), and the biases."""
        used = np.append(inputs, self._total)
        left = self._gram[np.ix_(used, used)] + _RIDGE * np.eye(len(used))
        solution = np.linalg.solve(left, self._gram[used, : self._total] @ targets.T)
        weights = np.zeros((len(targets), self._total))
        weights[:, inputs] = solution[:-1].T
        return weights, solution[-1]


def _count_samples(losses: Array, parts: Sequence[Array]) -> Array:
    """Return how many independent rows a row counts for, from the variance of the means of parts."""
    means = np.array([part.mean(axis=0) for part in parts])
    usual = float(np.mean([len(part) for part in parts]))
    ratio = losses.var(axis=0) / np.maximum(usual * means.var(axis=0), 1e-12)
    return np.clip(ratio, 1.0 / usual, 1.0)
