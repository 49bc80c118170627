"""RL707: action falls back."""

import dataclasses
from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.action_trials import REWARD, ActionNumber, Trials
from rlctl.checking.experiments.action_effects import ActionTrials, judges_actions
from rlctl.checking.records import FIRST_SEED, SECOND_SEED
from rlctl.checking.rule import OutOfTime, Rule, RuleFinding, Severity, list_names
from rlctl.checking.values import name_numbers

RULE = Rule(
    "RL707",
    "action falls back",
    Severity.WARNING,
    meaning="""
        The check played the same step with the action at many values from its lowest to its highest. What is
        observed then follows the action, but at one value it jumps the other way, from many states at the same
        value: a little more of the action does much less. Most often two branches of a map do not meet, as
        where 0 means hover and 0.01 one hundredth of full thrust. A jump in the direction of all else, as of a
        gripper or a switch, is no finding.
    """,
    fix="Let both branches of the map have the same value where they meet, or use one line from end to end.",
)

VALUES = 11  # of the sweep; an odd number has the middle of the range among them, where branches meet
LEAST_JUMP = 2.0  # times the usual change between two values of the sweep
MOST_AGAINST = 0.1  # part of all other changes that may be in the direction of the jump
STILL = 1e-6  # smaller changes are none, relative to the largest number of the observation or to 1
HALVINGS = 10  # by which the place of a jump is narrowed down
PART_LEFT = 0.5  # of the jump that has to be left when it is narrowed down
STATES = ((FIRST_SEED, 0), (SECOND_SEED, 0), (FIRST_SEED, 3))
"""Seeds, and random steps before the one that is compared. The first is swept."""
Numbers = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class _Jump:
    """Where one number of the observation jumps, between two parts of the range of all actions."""

    column: int  # from the beginning of the observation
    low: float
    high: float
    size: float  # with its sign


@judges_actions(RULE)
def _find_falls(shown: ActionTrials) -> Iterator[RuleFinding]:
    floats = [dimension for dimension in shown.dimensions if "float" in dimension.leaf.dtype]
    if not floats:
        return
    sweep = _Sweep(shown.trials, floats, min(shown.earliest) if shown.is_late else 1)
    jump = sweep.find_jump()
    if jump is None:
        return
    before, after = sweep.play(dict.fromkeys(floats, jump.low)), sweep.play(dict.fromkeys(floats, jump.high))
    alone = [one for one in floats if sweep.jumps_alone(one, jump)]
    names = list_names([one.name for one in alone or floats])
    one = (alone or floats)[0]
    low, high = (_find_value(one, part) for part in (jump.low, jump.high))
    observed = name_numbers(shown.trials.parts, jump.column)
    message = f"{observed} follows {names}, but falls back by {abs(jump.size):.4g} between"
    message += f" {low:.4g} and {high:.4g}: from {before[jump.column]:.4g} to {after[jump.column]:.4g}"
    evidence = {
        "element": one.name,
        "value": [low, high],
        "seed": FIRST_SEED,
        "observed": observed,
    }
    yield RuleFinding(RULE, message, evidence)


def _find_value(dimension: ActionNumber, part: float) -> float:
    low, high = dimension.ends
    return float(low + part * (high - low))


class _Sweep:
    """Plays one step with numbers of the action at parts of their ranges."""

    def __init__(self, trials: Trials, dimensions: list[ActionNumber], steps: int) -> None:
        self._trials, self._dimensions = trials, dimensions
        self._steps = steps  # after which the observation has followed

    def find_jump(self) -> _Jump | None:
        """Return where a number of the observation jumps against its trend, in all states."""
        try:
            parts = np.linspace(0.0, 1.0, VALUES)
            rows = [self._play_all(part) for part in parts]
            if len({row.shape for row in rows}) != 1 or not np.isfinite(rows).all():
                return None
            suspects = sorted(_find_suspects(np.array(rows)), key=lambda found: -found[2])
            for column, pair, _ in suspects:
                jump = self._narrow(column, float(parts[pair]), float(parts[pair + 1]))
                if jump is not None and all(self._jumps_in(state, jump) for state in STATES[1:]):
                    return jump
        except OutOfTime:
            pass
        return None

    def play(self, parts: Mapping[ActionNumber, float], state: tuple[int, int] = STATES[0]) -> Numbers:
        """Return what is observed after the step; shape (elements,)."""
        seed, at = state
        values = {dimension: _find_value(dimension, part) for dimension, part in parts.items()}
        return self._trials.with_values(seed, at + self._steps, values, at)[-1][:REWARD]

    def jumps_alone(self, dimension: ActionNumber, jump: _Jump) -> bool:
        """Say whether one number of the action makes the jump while the others stay below it."""
        low = dict.fromkeys(self._dimensions, jump.low)
        change = self.play(low | {dimension: jump.high})[jump.column] - self.play(low)[jump.column]
        return bool(change / jump.size > PART_LEFT)

    def _play_all(self, part: float, state: tuple[int, int] = STATES[0]) -> Numbers:
        return self.play(dict.fromkeys(self._dimensions, part), state)

    def _narrow(self, column: int, low: float, high: float) -> _Jump | None:
        """Halve the pair of values again and again; None where the change is no jump."""
        first, last = (float(self._play_all(part)[column]) for part in (low, high))
        whole = last - first
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            value = float(self._play_all(middle)[column])
            if abs(value - first) > abs(last - value):
                high, last = middle, value
            else:
                low, first = middle, value
        size = last - first
        return _Jump(column, low, high, size) if size / whole > PART_LEFT else None

    def _jumps_in(self, state: tuple[int, int], jump: _Jump) -> bool:
        low, high = (self._play_all(part, state) for part in (jump.low, jump.high))
        if low.shape != high.shape or jump.column >= low.size:
            return False
        return bool((high - low)[jump.column] / jump.size > PART_LEFT)


def _find_suspects(rows: Numbers) -> Iterator[tuple[int, int, float]]:
    """Yield the columns that change against their trend between one pair of values only, that pair, and by how much.
    Shape of rows: (values, elements)."""
    changes = np.diff(rows, axis=0)
    for column, change in enumerate(changes.T):
        still = STILL * max(1.0, float(np.abs(rows[:, column]).max()))
        pair = int(np.abs(change).argmax())
        others = np.delete(change, pair)
        against = others[np.sign(others) == np.sign(change[pair])]
        is_trend = np.count_nonzero(np.abs(others) > still) > len(others) / 2
        is_against = np.abs(against).sum() <= MOST_AGAINST * np.abs(others).sum()
        if is_trend and is_against and abs(change[pair]) > LEAST_JUMP * np.median(np.abs(others)):
            yield column, pair, float(np.abs(change[pair]))
