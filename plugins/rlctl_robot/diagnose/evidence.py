"""How much more plausible corrections make a log for the robot in simulation, in nats."""

import dataclasses
from collections.abc import Collection, Iterable, Sequence

import numpy as np

from rlctl_robot.diagnose.correction import EVERYTHING, Correction, list_parts
from rlctl_robot.diagnose.reference import Recordings
from rlctl_robot.diagnose.relations import STRIDE, Windows, compute_losses, fit_relations
from rlctl_robot.diagnose.rows import ChosenRows, choose_rows
from rlctl_robot.diagnose.signals import ACTIONS, MAX_DELAY, Array, LoggedSignals

_MOST_SAMPLES = 30.0
"""Independent rows that a relation counts for at most: a real robot differs a little, however long the log is."""

_CHANCE_LOGS, _CHANCE_ROWS = 6, 1500  # logs of a sound robot in simulation, and for how many rows each counts
_CHANCE_SAMPLE = 400  # rows of such a log that are scored
_CHANCE_FACTOR = 1.5
_SMALL_OFFSET = 0.3  # in standard deviations: the effect of an offset is measured with it


@dataclasses.dataclass(frozen=True, eq=False)
class _AffectedPart:
    """What depends on some columns of the windows; with float32, which halves the time of most of the search."""

    columns: Array
    relations: Array
    features: Array
    projection: Array  # of the columns on the features
    of_columns: Array  # what the columns add to the errors of the relations
    of_features: Array


class Likelihood:
    """The relations of a task, and what they count for."""

    def __init__(self, reference: Recordings) -> None:
        self.reference = reference
        self.windows = Windows(reference)
        self.relations, self.echoes = fit_relations(reference, self.windows)
        matrix = self.relations.matrix[:, : self.windows.total]
        self.affected = {
            name: np.flatnonzero(np.abs(matrix[:, columns]).max(axis=1) > 0)  # its features are of these relations too
            for name, columns in self.windows.columns.items()
        }
        self._parts: dict[tuple[str, ...], _AffectedPart] = {}
        self.margin = MAX_DELAY + reference.allowed_delay + STRIDE
        """Rows that are left out at both ends of a segment."""
        self._chances: dict[tuple[str, str] | Correction, float] = {}
        self.largest_error = 1.0
        """How many times the usual error the errors of the next row are in the worst log of a sound robot."""

    def learn_chances(self, candidates: Sequence[Correction]) -> None:
        """Learn which evidence wrong corrections have in simulation, where nothing is wrong.

        It is not zero where a linear relation does not hold, such as for a finger that has reached its end stop.
        """
        held_out = self.reference.held_out
        starts, groups = held_out.starts, min(_CHANCE_LOGS, len(held_out.lengths))
        for group in np.array_split(np.arange(len(starts)), groups):
            first, last = int(group[0]), int(group[-1])
            rows = np.arange(starts[first], starts[last] + held_out.lengths[last])
            part = dataclasses.replace(
                held_out,
                observations=held_out.observations[rows],
                actions=held_out.actions[rows],
                lengths=held_out.lengths[first : last + 1],
            )
            if not len(inner := part.inner_rows(self.margin)):
                continue
            chosen = choose_rows(part, inner, self.reference.statistics, _CHANCE_SAMPLE)
            scorer = Scorer(self, part, dataclasses.replace(chosen, stands_for=_CHANCE_ROWS))
            self.largest_error = max(self.largest_error, scorer.times_usual(None))
            for one in candidates:
                gain = scorer.gain(one)
                for key in (one, _group(one)):
                    self._chances[key] = max(self._chances.get(key, 0.0), gain)

    def affect(self, names: tuple[str, ...]) -> "_AffectedPart":
        """Return what a change of some observations and actions affects."""
        if names not in self._parts:
            self._parts[names] = self._find_affected(names)
        return self._parts[names]

    def _find_affected(self, names: tuple[str, ...]) -> "_AffectedPart":
        windows, matrix = self.windows, self.relations.matrix
        columns = np.concatenate([windows.columns[name] for name in names])
        relations = np.unique(np.concatenate([self.affected[name] for name in names]))
        features = np.unique(np.concatenate([windows.features_of[name] for name in names]))
        return _AffectedPart(
            columns,
            relations,
            features,
            windows.projection[np.ix_(columns, features)].astype(np.float32),
            matrix[np.ix_(relations, columns)].T.astype(np.float32),
            matrix[np.ix_(relations, windows.total + features)].T.astype(np.float32),
        )

    def learn_more(self, recordings: LoggedSignals) -> "Likelihood":
        """Return the likelihood with relations that are also those of further recordings in simulation."""
        varied = self.reference.varied.join(recordings)
        more = Likelihood(dataclasses.replace(self.reference, varied=varied))
        more._chances, more.largest_error = self._chances, self.largest_error
        return more

    def chance(self, one: Correction) -> float:
        """Return the evidence to take off a correction: more than it had in simulation without any mistake [nats]."""
        return _CHANCE_FACTOR * self._chances.get(one, self._chances.get(_group(one), 0.0))


def _group(one: Correction) -> tuple[str, str]:
    """Return which corrections one with a fitted number is like."""
    return one.term, "scale" if one.kind == "unit" else one.kind


class Scorer:
    """Scores corrections on some rows of a log; lower is more plausible, a difference is evidence in nats."""

    def __init__(
        self,
        likelihood: Likelihood,
        signals: LoggedSignals,
        chosen: ChosenRows,
        frozen: Collection[tuple[str, int]] = (),
    ) -> None:
        self._likelihood, self._signals, self._rows = likelihood, signals, chosen.rows
        relations, windows = likelihood.relations, likelihood.windows
        weights = np.minimum(relations.samples * chosen.stands_for, _MOST_SAMPLES)
        self._keep = np.ones(windows.total)  # 0 for columns of frozen elements: their usual value is used
        for name, element in frozen:
            weights[relations.element == windows.slices[name].start + element] = 0.0
            self._keep[windows.columns[name][element :: windows.sizes[name]]] = 0.0
        self._weights = weights
        self.rebase([])

    def rebase(self, corrections: Sequence[Correction]) -> float:
        """Begin from these corrections; return their score."""
        cost = 0.0
        self.base: list[Correction] = []
        self._begin()
        for one in corrections:
            cost += self._cost(one)
            self.base = [*self.base, *list_parts([one])]
            self._begin()
        self.score = float(self._losses @ self._weights) + cost
        return self.score

    def _begin(self) -> None:
        windows, relations = self._likelihood.windows, self._likelihood.relations
        self._window = windows.make(self._signals, self._rows, self.base) * self._keep
        extended = windows.extend(self._window)
        self._features = extended[:, windows.total :]
        self._before = self._window @ windows.projection + windows.bias
        self._errors = extended @ relations.matrix.T + relations.constant
        self._losses = compute_losses(self._errors).mean(axis=0)
        self._single = [part.astype(np.float32) for part in (self._before, self._features, self._errors)]

    def _cost(self, one: Correction) -> float:
        """Return what a correction that makes values smaller gains where they are noise; it is no evidence."""
        windows, relations = self._likelihood.windows, self._likelihood.relations
        if one.term == ACTIONS or not one.factor:
            return 0.0
        shrinks = np.ones(windows.width)
        columns = slice(None) if one.term == EVERYTHING else windows.slices[one.term]
        shrinks[columns] = np.minimum(np.abs(one.factor), 1.0)
        factors = shrinks[relations.element]
        some = np.flatnonzero(factors < 1.0)
        if not len(some):
            return 0.0
        gains = self._losses[some] - compute_losses(self._errors[:, some] * factors[some]).mean(axis=0)
        return float(gains @ self._weights[some])

    def gain(self, one: Correction) -> float:
        """Return the evidence for one more correction [nats]."""
        return float((self._losses - self._try(one)) @ self._weights) - self._cost(one)

    def _try(self, one: Correction) -> Array:
        """Return the mean losses with one more correction, shape (relations,)."""
        windows, relations = self._likelihood.windows, self._likelihood.relations
        parts = list_parts([one])
        corrections = [*self.base, *parts]
        if one.term == EVERYTHING and EVERYTHING not in windows.sizes:
            window = windows.make(self._signals, self._rows, corrections) * self._keep
            everything: Array = compute_losses(windows.extend(window) @ relations.matrix.T + relations.constant).mean(
                axis=0
            )
            return everything
        names = tuple(dict.fromkeys(part.term for part in parts))
        blocks = [windows.block(name, self._signals, self._rows, corrections) for name in names]
        block = np.concatenate(blocks, axis=1) * self._keep[self._likelihood.affect(names).columns]
        losses = self._losses.copy()
        affected = self._likelihood.affect(names).relations
        losses[affected] = compute_losses(self._errors_with(names, block)).mean(axis=0, dtype=np.float64)
        return losses

    def _errors_with(self, names: tuple[str, ...], block: Array) -> Array:
        """Return the errors of the affected relations with other parts of the windows, shape (rows, affected)."""
        part = self._likelihood.affect(names)
        before, features, all_errors = self._single
        change = (block - self._window[:, part.columns]).astype(np.float32)
        projected = before[:, part.features] + change @ part.projection
        moved = np.tanh(projected) - features[:, part.features]
        errors: Array = all_errors[:, part.relations] + change @ part.of_columns
        errors += moved @ part.of_features
        return errors

    def share(self, one: Correction) -> float:
        """Return which part of the errors that it changes a correction explains, in [0, 1]."""
        return self._explain(self._try(one))

    def share_of(self, other: "Scorer") -> float:
        """Return which part of the errors that differ another log of the same rows explains, in [0, 1]."""
        return self._explain(other._losses)

    def _explain(self, after: Array) -> float:
        typical, before = self._likelihood.relations.typical, self._losses
        better = self._weights * (before > after + 0.05)
        removable = float(np.maximum(before - np.minimum(typical, before), before - after) @ better)
        return float((before - after) @ better) / max(removable, 1e-9)

    def rank(self, candidates: Iterable[Correction]) -> list[tuple[float, Correction]]:
        """Return candidates with their evidence, the best first."""
        return sorted(((self.gain(one), one) for one in candidates), key=lambda pair: -pair[0])

    def times_usual(self, name: str | None) -> float:
        """Return how many times larger than in simulation errors of an observation are; None: of the next row's."""
        relations, windows = self._likelihood.relations, self._likelihood.windows
        used = np.array([kind == "ahead" for kind in relations.kind])
        if name is not None:
            part = windows.slices[name]
            used = (relations.element >= part.start) & (relations.element < part.stop)
        used &= self._weights > 0
        if not used.any():
            return 1.0
        return float(np.exp((self._losses - relations.typical)[used].mean()))

    def fit_offset(self, name: str) -> Array:
        """Return the offset of each element alone that suits the log best, by reweighted least squares."""
        windows = self._likelihood.windows
        columns, size = windows.columns[name], windows.sizes[name]
        affected = self._likelihood.affect((name,)).relations
        errors, offset = self._errors[:, affected], np.zeros(size)
        for index in range(size):
            moved = self._window[:, columns]
            moved[:, index::size] += _SMALL_OFFSET
            effect = (self._errors_with((name,), moved) - errors) / _SMALL_OFFSET
            for _ in range(6):
                now = errors + effect * offset[index]
                weights = self._weights[affected] / (1.0 + np.square(now))
                slope = float((weights * np.square(effect)).mean(axis=0).sum())
                offset[index] -= float((weights * now * effect).mean(axis=0).sum()) / max(slope, 1e-9)
        found: Array = offset * windows.statistics[name].std
        return found
