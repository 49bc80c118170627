"""Questions 2 and 3: which corrections, singly or in pairs, make a log plausible for the robot in simulation."""

import dataclasses
from collections.abc import Callable, Collection, Sequence

import numpy as np

from rlctl_robot.diagnose.candidates import make_offset, make_scale
from rlctl_robot.diagnose.correction import Correction
from rlctl_robot.diagnose.evidence import Likelihood, Scorer
from rlctl_robot.diagnose.rows import choose_rows
from rlctl_robot.diagnose.signals import ACTIONS, MAX_DELAY, LoggedSignals

_ROWS = 300  # of a log, in each half
_STARTS = 3  # best single corrections that are tried as parts of pairs
EVIDENCE = 8.0
"""Evidence in nats that a finding needs in the rows it was searched in, and half of it in the others."""
LEAST_SHARE = 0.2
"""Part of the errors that it changes which a finding must explain."""
_APART = 3.0  # nats that two explanations must differ by to be told apart
_LEAST_FACTOR = 1.6  # smaller differences of a gain are between robots, such as how well they follow a command
_LEAST_OFFSET = 0.5  # in standard deviations of the element in simulation
_OFFSET_SHARE = 0.6  # of the errors that a fitted offset must explain
_OFFSET_TRUST = 0.5  # of its evidence: an offset also imitates what linear relations miss far from the usual states
_SOME_ELEMENTS = 3.0  # nats that a mistake of some of the elements costs
_FITTED = 4.0  # nats that a fitted number costs


@dataclasses.dataclass(frozen=True)
class Found:
    """A correction, and how much more plausible it makes the log."""

    correction: Correction
    evidence: float  # [nats]
    explains: float  # part of the log's implausibility, in [0, 1]
    also: tuple[Correction, ...] = ()  # corrections that this log cannot tell from it


@dataclasses.dataclass(frozen=True)
class _Guess:
    score: float  # lower is more plausible
    base: list[Correction]  # a delay of the actions that the task's own events have
    corrections: list[Correction]


class Search:
    """Searches a log for corrections, in one half of its rows, and confirms them in the other."""

    def __init__(
        self,
        likelihood: Likelihood,
        signals: LoggedSignals,
        candidates: Sequence[Correction],
        frozen: Collection[tuple[str, int]] = (),
    ) -> None:
        rows = signals.inner_rows(likelihood.margin)
        block = max(10, min(50, len(rows) // 10))
        is_second = (np.arange(len(rows)) // block) % 2 == 1
        self._search, self._confirm = (
            Scorer(likelihood, signals, choose_rows(signals, part, likelihood.reference.statistics, _ROWS), frozen)
            for part in (rows[~is_second], rows[is_second])
        )
        self._likelihood = likelihood
        allowed = likelihood.reference.allowed_delay
        self._candidates = [one for one in candidates if one.term != ACTIONS or one.kind in ("order", "sign", "scale")]
        self._terms = {one.term for one in candidates}  # the others are not corrected
        self._late = [make_delay(steps) for steps in range(allowed + 1, allowed + MAX_DELAY + 1)]
        self._allowed: list[list[Correction]] = [[], *([make_delay(steps)] for steps in range(1, allowed + 1))]

    def find(self, most: int = 2) -> list[Found]:
        """Return the corrections that the log needs, at most `most`, the one with the most evidence first."""
        base, chosen = self._choose(most) if most else ([], [])
        chosen = self._refine(base, chosen)
        found = []
        for one in chosen:
            others = [other for other in chosen if other is not one]
            self._search.rebase([*base, *others])
            self._confirm.rebase([*base, *others])
            gain = self._search.gain(one) + self._confirm.gain(one) - self._likelihood.chance(one)
            found.append(Found(one, gain, self._search.share(one), self._list_equals(one, gain)))
        convincing = [one for one in found if one.evidence >= EVIDENCE and one.explains >= LEAST_SHARE]
        if len(convincing) < len(found) == 2:
            return self.find(1)
        return sorted(convincing, key=lambda one: -one.evidence)

    def list_guesses(self, most: int, chosen: Sequence[Correction] = ()) -> list[list[Correction]]:
        """Return `chosen` with one correction more: the most plausible ones, of different observations or kinds."""
        guesses = [guess for base in self._allowed for guess in self._guess(base, list(chosen))]
        guesses.sort(key=lambda guess: guess.score, reverse=True)
        different = {(guess.corrections[-1].term, guess.corrections[-1].kind): guess for guess in guesses}
        best = sorted(different.values(), key=lambda guess: guess.score)[:most]
        return [[*guess.base, *guess.corrections] for guess in best]

    def _refine(self, base: list[Correction], chosen: list[Correction]) -> list[Correction]:
        """Return the corrections with the factors that suit all rows best, without those that are small then."""
        refined = list(chosen)
        for index, one in enumerate(chosen):
            if one.kind == "scale" and not one.offset:
                for scorer in (self._search, self._confirm):
                    scorer.rebase([*base, *refined[:index], *refined[index + 1 :]])
                refined[index] = _fit_factor(one, lambda scale: self._search.gain(scale) + self._confirm.gain(scale))
        return [one for one in refined if _is_large(one)]

    def _choose(self, most: int) -> tuple[list[Correction], list[Correction]]:
        """Return the allowed delay, and no, one or two corrections: two only with evidence beyond any single one."""
        nothing = min(self._search.rebase(base) for base in self._allowed)
        null = min(self._confirm.rebase(base) for base in self._allowed)
        guesses = [guess for base in self._allowed for guess in self._guess(base, [])]
        guesses.sort(key=lambda guess: guess.score)
        best = next((guess for guess in guesses[:5] if self._is_confirmed(guess, nothing, null)), None)
        if best is None:
            return [], []
        if most > 1:
            starts = [guess for guess in guesses if guess.score < nothing][:_STARTS]
            pairs = [pair for guess in starts for pair in self._guess(guess.base, guess.corrections)[:3]]
            pairs.sort(key=lambda guess: guess.score)
            confirmed = self._confirm.rebase([*best.base, *best.corrections])
            for pair in pairs[:3]:
                if self._is_confirmed(pair, best.score, confirmed):
                    return pair.base, pair.corrections
        return best.base, best.corrections

    def _is_confirmed(self, guess: "_Guess", before: float, confirmed_before: float) -> bool:
        if before - guess.score < EVIDENCE:
            return False
        return confirmed_before - self._confirm.rebase([*guess.base, *guess.corrections]) >= EVIDENCE / 2

    def _guess(self, base: list[Correction], chosen: list[Correction]) -> list["_Guess"]:
        """Return `chosen` with one correction more, the most plausible first; numbers are fitted."""
        late: list[_Guess] = []
        if not base and not any(one in self._late for one in chosen):
            late = [_Guess(self._search.rebase([*chosen, one]), base, [*chosen, one]) for one in self._late]
        score = self._search.rebase([*base, *chosen])
        possible = [one for one in self._candidates if not any(_exclude(one, other) for other in chosen)]
        if chosen:  # a driver's mistake is searched alone: there are many
            possible = [one for one in possible if not one.parts]
        ranked = [
            (gain - self._likelihood.chance(one) - _get_cost(one), one) for gain, one in self._search.rank(possible)
        ]
        ranked += self._fit_scales(ranked)
        ranked += [pair for pair in self._fit_offsets() if not any(_exclude(pair[1], other) for other in chosen)]
        guesses = [_Guess(score - gain, base, [*chosen, one]) for gain, one in ranked if _is_large(one)]
        return sorted([*guesses, *late], key=lambda guess: guess.score)

    def _fit_scales(self, ranked: Sequence[tuple[float, Correction]]) -> list[tuple[float, Correction]]:
        """Return the best scales with the factor that suits the log best."""
        fitted = []
        scales = [(gain, one) for gain, one in ranked[:20] if one.kind == "scale" and not one.offset][:3]
        for gain, one in scales:
            scale = _fit_factor(one, self._search.gain)
            if (better := self._search.gain(scale) - self._likelihood.chance(scale)) > gain:
                fitted.append((better, scale))
        return fitted

    def _fit_offsets(self) -> list[tuple[float, Correction]]:
        fitted = []
        for name, size in self._likelihood.windows.sizes.items():
            if name not in self._terms:
                continue
            std = self._likelihood.windows.statistics[name].std
            offset = self._search.fit_offset(name)
            large = np.flatnonzero(np.abs(offset) > _LEAST_OFFSET * std).tolist()
            for index in large:
                some = np.zeros(size)
                some[index] = offset[index]
                one = make_offset(name, [index], some)
                if self._search.share(one) >= _OFFSET_SHARE:
                    fitted.append((_OFFSET_TRUST * self._search.gain(one) - _FITTED, one))
        return fitted

    def _list_equals(self, one: Correction, gain: float) -> tuple[Correction, ...]:
        """Return other candidates with nearly the same evidence."""
        alike = []
        for more, other in self._search.rank(self._candidates)[:6]:
            is_same = (other.term, other.kind, other.order) == (one.term, one.kind, one.order)
            is_same = is_same and bool(other.parts) == bool(one.parts)
            if not is_same and other.kind not in ("scale", "unit", "offset"):
                alike += [other] if more + self._confirm.gain(other) > gain - _APART else []
        return tuple(alike[:2])


def _fit_factor(one: Correction, score: Callable[[Correction], float]) -> Correction:
    """Return a scale with the factor near its own that has the highest score."""
    from scipy.optimize import minimize_scalar

    elements = np.flatnonzero(np.array(one.factor) != 1.0).tolist()
    begin = float(np.log(one.factor[elements[0]]))

    def make(log_factor: float) -> Correction:
        return make_scale(one.term, len(one.factor), elements, float(np.exp(log_factor)))

    best = minimize_scalar(
        lambda log_factor: -score(make(log_factor)),
        bounds=(begin - 0.8, begin + 0.8),
        method="bounded",
        options={"maxiter": 14},
    )
    return make(float(best.x))


def make_delay(steps: int) -> Correction:
    """Return the correction of actions that take effect late."""
    plural = "s" if steps > 1 else ""
    return Correction(ACTIONS, "delay", f"take effect {steps} control step{plural} late", delay=steps)


def _exclude(one: Correction, other: Correction) -> bool:
    """Return whether two corrections of one term are of the same kind, and so would be a single other one."""
    sizes = ("scale", "unit", "offset", "normalised")
    alike = (one.kind == other.kind and one.kind in ("delay", "frame")) or (one.kind in sizes and other.kind in sizes)
    return one.term == other.term and (alike or one == other)


def _get_cost(one: Correction) -> float:
    """Return what a mistake of some but not all elements costs: one of an element, or of all, is more common."""
    changed = sum(factor != 1.0 for factor in one.factor)
    return _SOME_ELEMENTS if one.kind == "sign" and 1 < changed < len(one.factor) else 0.0


def _is_large(one: Correction) -> bool:
    if one.kind != "scale" or one.offset:
        return True
    factors = np.array(one.factor)
    return bool((np.abs(np.log(factors[factors != 1.0])) > np.log(_LEAST_FACTOR)).all())
