"""Question 1: does the policy, given the logged observations, produce the logged actions? If not, what is wrong?"""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from rlctl_robot.diagnose.actor import RIGHT, LoggedActor, Variant
from rlctl_robot.diagnose.candidates import make_offset, make_scale
from rlctl_robot.diagnose.correction import Correction, correct
from rlctl_robot.diagnose.signals import ACTIONS, MAX_DELAY, Array, LoggedSignals

SAME = 0.02
"""Mean difference, in standard deviations of the action, below which actions are the same."""
EXACT = 1e-3
"""The same, below which they are equal but for the precision of a log."""
_FAR_BETTER = 0.1  # of a difference between the two, which a correction must bring it to
_BETTER = 0.25  # of the difference before, below which a correction that explains only a part must bring it
_CLEARLY_BETTER = 0.5  # of the difference with one correction, which a pair must bring it to
_FITTED_COST = 2.0
_ROWS = 100
_STARTS = 6
_ITERATIONS = 8


@dataclasses.dataclass(frozen=True, eq=False)
class PolicyMatch:
    """How well the policy produces the logged actions, and the corrections of the log with which it does."""

    difference: float  # mean |logged - computed| in standard deviations of the action, each at most 1
    corrected: float  # with the corrections
    corrections: tuple[Correction, ...] = ()
    variant: Variant = RIGHT
    also: tuple[tuple[Correction, ...], ...] = ()  # other corrections with the same result

    @property
    def is_same(self) -> bool:
        """Whether the policy produces the logged actions as they are."""
        return self.difference < SAME and not (self.corrections or self.variant.text)

    @property
    def is_explained(self) -> bool:
        """Whether it does so with the corrections."""
        return self.corrected < SAME or (
            self.corrected < _BETTER * self.difference and bool(self.corrections or self.variant.text)
        )


@dataclasses.dataclass(frozen=True, eq=False)
class _ExplainedActions:
    difference: float
    corrections: tuple[Correction, ...]
    variant: Variant = RIGHT

    @property
    def cost(self) -> float:
        """The difference; more where every element of the actions was fitted by itself."""
        is_fitted = any(one.term == ACTIONS and one.factor and one.offset for one in self.corrections)
        return self.difference * (_FITTED_COST if is_fitted else 1.0)


class Matcher:
    """Compares logged actions with those of the policy under corrections of the log."""

    def __init__(
        self,
        actor: LoggedActor,
        signals: LoggedSignals,
        std: Array,
        candidates: Sequence[Correction],
        unknown: Mapping[int, float] | None = None,
        limited: Array | None = None,
    ) -> None:
        """`unknown`: usual values of elements that the log does not hold, such as of a frozen sensor, by their column.

        For each row the values are used with which the policy comes nearest to the logged action. Rows are left out
        where `limited`, shape (T,), is true.
        """
        self._actor, self._std = actor, np.maximum(std, 1e-6)
        self._unknown = dict(unknown or {})
        self.signals = signals
        self._candidates = candidates
        rows = signals.inner_rows(MAX_DELAY + 1)
        rows = rows if limited is None else rows[~limited[rows]]
        self._rows = rows if len(rows) <= _ROWS else rows[np.linspace(0, len(rows) - 1, _ROWS).astype(int)]
        # Only the windows around these rows are corrected.
        around = np.arange(-MAX_DELAY, MAX_DELAY + 1)
        picked = (self._rows[:, None] + around).ravel()
        self._windows = dataclasses.replace(
            signals,
            observations=signals.observations[picked],
            actions=signals.actions[picked],
            lengths=(len(around),) * len(self._rows),
        )
        self._middle = np.arange(len(self._rows)) * len(around) + MAX_DELAY

    def compare(self, corrections: Sequence[Correction] = (), variant: Variant = RIGHT) -> float:
        """Return the mean difference with corrections."""
        return float(np.minimum(np.abs(self._residuals(corrections, variant)), 1.0).mean())

    def _residuals(self, corrections: Sequence[Correction], variant: Variant = RIGHT) -> Array:
        corrected = correct(self._windows, corrections)
        observations, actions = corrected.observations[self._middle], corrected.actions[self._middle]
        if self._unknown:
            observations = self._complete(observations, actions, variant)
        residuals: Array = (actions - self._actor.compute(observations, variant)) / self._std
        return residuals

    def _complete(self, observations: Array, actions: Array, variant: Variant) -> Array:
        """Return the observations with the unknown elements that suit the actions, by Levenberg-Marquardt's method."""
        columns = list(self._unknown)
        best = observations.copy()
        best[:, columns] = list(self._unknown.values())
        residuals = (actions - self._actor.compute(best, variant)) / self._std
        damping = np.ones(len(best))
        for _ in range(_ITERATIONS):
            slopes = np.stack([self._slope(best, column, variant) for column in columns], axis=2)
            squares = slopes.transpose(0, 2, 1) @ slopes
            squares += (damping[:, None] * np.trace(squares, axis1=1, axis2=2)[:, None] + 1e-9)[..., None] * np.eye(
                len(columns)
            )
            steps = np.linalg.solve(squares, slopes.transpose(0, 2, 1) @ residuals[..., None])[..., 0]
            tried = best.copy()
            tried[:, columns] += steps
            errors = (actions - self._actor.compute(tried, variant)) / self._std
            is_better = np.square(errors).sum(axis=1) < np.square(residuals).sum(axis=1)
            best[is_better], residuals[is_better] = tried[is_better], errors[is_better]
            damping = np.where(is_better, damping / 4, damping * 4)
        return best

    def _slope(self, observations: Array, column: int, variant: Variant) -> Array:
        """Return the change of the actions, in standard deviations, with an element, shape (rows, actions)."""
        step = 1e-4 * max(1.0, abs(self._unknown[column]))
        ends = []
        for sign in (1, -1):
            moved = observations.copy()
            moved[:, column] += sign * step
            ends.append(self._actor.compute(moved, variant))
        slope: Array = (ends[0] - ends[1]) / (2 * step) / self._std
        return slope

    def match(self, *, pairs: bool = True) -> PolicyMatch:
        """Search single corrections, then pairs."""
        begin = self.compare()
        if begin < EXACT:
            return PolicyMatch(begin, begin)
        singles = self._list_singles()
        best = singles[0]
        if begin < SAME and best.difference > _FAR_BETTER * begin:  # rounded numbers, or another machine
            return PolicyMatch(begin, begin)
        if best.difference < EXACT:
            also = tuple(one.corrections for one in singles[1:4] if one.difference < EXACT and one.corrections)
            return PolicyMatch(begin, best.difference, best.corrections, best.variant, also)
        better = _FAR_BETTER if best.difference < SAME else _CLEARLY_BETTER
        for first in singles[:_STARTS] if pairs else ():
            pair = min(self._list_pairs([first]), key=lambda guess: guess.cost)
            if pair.difference < better * best.difference:
                best = pair
            if best.difference < EXACT:
                break
        found = PolicyMatch(begin, best.difference, best.corrections, best.variant)
        return found if found.is_explained else PolicyMatch(begin, best.difference)

    def _list_singles(self) -> list[_ExplainedActions]:
        guesses = [_ExplainedActions(self.compare([one]), (one,)) for one in self._candidates]
        guesses += [_ExplainedActions(self.compare([], variant), (), variant) for variant in self._actor.variants()]
        guesses += self._fit([])
        return sorted(guesses, key=lambda guess: guess.cost)

    def _list_pairs(self, singles: Sequence[_ExplainedActions]) -> list[_ExplainedActions]:
        pairs = []
        for first in singles:
            for one in self._candidates:
                if one not in first.corrections:
                    both = (*first.corrections, one)
                    pairs.append(_ExplainedActions(self.compare(both, first.variant), both, first.variant))
            for variant in self._actor.variants() if first.variant is RIGHT else ():
                pairs.append(_ExplainedActions(self.compare(first.corrections, variant), first.corrections, variant))
            pairs += self._fit(first.corrections, first.variant)
        return pairs

    def _fit(self, before: Sequence[Correction], variant: Variant = RIGHT) -> list[_ExplainedActions]:
        """Return corrections with fitted numbers: a factor of a term, an offset or a factor of one of its elements."""
        guesses = [*self._fit_actions(before, variant)]
        # With unknown observations there is no regression of the actions.
        terms = {one.term for one in self._candidates}
        for name in [*(name for name in self.signals.sizes if name in terms), *([ACTIONS] if self._unknown else [])]:
            guesses += self._fit_term(name, before, variant)
        return guesses

    def _fit_actions(self, before: Sequence[Correction], variant: Variant) -> list[_ExplainedActions]:
        corrected = correct(self._windows, before)
        computed = self._actor.compute(corrected.observations[self._middle], variant)
        logged = corrected.actions[self._middle]
        size = logged.shape[1]
        centred = logged - logged.mean(axis=0)
        slopes = (centred * (computed - computed.mean(axis=0))).sum(axis=0) / np.maximum(
            (centred**2).sum(axis=0), 1e-12
        )
        offsets = computed.mean(axis=0) - slopes * logged.mean(axis=0)
        ones = np.ones(size)
        fitted = []
        usual = float(np.median(slopes))
        if abs(usual) > 1e-6:
            fitted.append(make_log_scale(size, range(size), usual))
        worst = int(np.abs(self._residuals(before, variant)).mean(axis=0).argmax())
        factor = ones.copy()
        if abs(slopes[worst]) > 1e-6:
            factor[worst] = slopes[worst]
            fitted.append(make_log_scale(size, [worst], float(slopes[worst])))
        shift = np.zeros(size)
        shift[worst] = float(np.median(computed[:, worst] - logged[:, worst]))
        fitted.append(make_offset(ACTIONS, [worst], shift))
        if (np.abs(slopes) > 1e-6).all():
            fitted.append(
                Correction(
                    ACTIONS,
                    "scale",
                    "the logged actions are scaled and shifted: they may be commands of the joints",
                    factor=tuple(slopes.tolist()),
                    offset=tuple(offsets.tolist()),
                )
            )
        return [_ExplainedActions(self.compare([*before, one], variant), (*before, one), variant) for one in fitted]

    def _fit_term(self, name: str, before: Sequence[Correction], variant: Variant) -> list[_ExplainedActions]:
        """Return the best factor of a whole term near the best of a coarse grid."""
        from scipy.optimize import minimize_scalar

        size = self.signals.term(name).shape[1]

        def guess(factor: float) -> _ExplainedActions:
            scale = make_log_scale if name == ACTIONS else partial(make_scale, name)
            both = (*before, scale(size, range(size), factor))
            return _ExplainedActions(self.compare(both, variant), both, variant)

        grid = [guess(factor) for factor in np.geomspace(0.15, 6.0, 9)]
        best = min(grid, key=lambda one: one.difference)
        begin = float(np.log(best.corrections[-1].factor[0]))
        found = minimize_scalar(
            lambda log_factor: guess(float(np.exp(log_factor))).difference,
            bounds=(begin - 0.5, begin + 0.5),
            method="bounded",
            options={"maxiter": 25, "xatol": 1e-4},
        )
        return [guess(float(np.exp(found.x)))]


def describe_in_log(one: Correction) -> str:
    """Return what a correction with which the policy produces the logged actions says."""
    if one.term == ACTIONS and one.kind == "delay":
        return f"{ACTIONS}: the log holds each action {one.delay} control step{'s' if one.delay > 1 else ''} late"
    if one.term == ACTIONS and one.kind == "scale" and "acts" in one.text:
        return f"{ACTIONS}: in the log they are {1 / min(one.factor, key=lambda x: x):.3g} times as large"
    return f"{one.describe()} (in the log, not in what the policy received)"


def make_log_scale(size: int, elements: Sequence[int], factor: float) -> Correction:
    """Return the correction of logged actions that differ from the policy's by a factor."""
    one = make_scale(ACTIONS, size, list(elements), factor)
    some = "all elements are" if len(elements) == size else f"element {next(iter(elements))} is"
    return dataclasses.replace(one, text=f"{some} {1 / factor:.4g} times as large in the log as the policy's")
