"""RL618: rewards that jump where an angle passes from pi to -pi."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.families import rewards
from rlctl.checking.records import Records
from rlctl.checking.rules import NotApplicable, RuleFinding, check
from rlctl.checking.transitions import Transitions, collect_transitions

NEAR_TURN = 1.0  # an angle that passes pi changes by 2 pi +- NEAR_TURN [rad]
SMALL_TURN = 1.5  # and by less than this in all other steps [rad]
UNIT = 1e-4  # how far from 1 the squares of a cosine and a sine may add up
NEIGHBOURS = 3  # steps before and after a jump that it is compared with
JUMP = 3.0  # times the largest change of its neighbours
FEWEST_JUMPS, FEWEST_SEEDS = 4, 3
MOST_PASSES = 0.4  # part of the passes with a jump: those near a difference of 0 have none
RARE = 0.05  # the same of all other steps, relative to that of the passes


@check("RL618", *rewards.WITH_SEARCH)
def _find_jumps_of_angles(records: Records) -> Iterator[RuleFinding]:
    rewards.require_rewarded(records)
    steps = collect_transitions(records)
    passes = _find_passes(steps)
    if not passes:
        raise NotApplicable("no angle that was observed passes pi often enough")
    is_jump, is_judged, sizes = _find_jumps(steps)
    for name, is_pass in passes.items():
        judged = is_pass & is_judged
        jumps = judged & is_jump
        others = float((is_jump & ~is_pass).sum() / max(1, (is_judged & ~is_pass).sum()))
        share = float(jumps.sum() / max(1, judged.sum()))
        is_rare = share >= MOST_PASSES and others <= RARE * share
        if jumps.sum() >= FEWEST_JUMPS and len(np.unique(steps.seeds[jumps])) >= FEWEST_SEEDS and is_rare:
            size = float(np.median(sizes[jumps]))
            where = f"in {int(jumps.sum())} of {int(judged.sum())} steps in which {name} passes pi"
            message = f"the reward jumps by {size:.3g} (median) {where}, and in {others:.1%} of all other steps"
            yield RuleFinding("RL618", message, {"element": name, "value": size, "expected": "no jump"})
            return


def _find_passes(steps: Transitions) -> dict[str, NDArray[np.bool_]]:
    """Return for each observed angle in which steps it passes from pi to -pi or back, by name. Shape (n,) each."""
    angles = {name: (steps.before[:, i], steps.after[:, i]) for i, name in enumerate(steps.names)}
    for i, j in find_unit_pairs(steps.before):
        names = f"({steps.names[i]}, {steps.names[j]})"
        angles[f"the angle of {names}"] = (_angle(steps.before, i, j), _angle(steps.after, i, j))
        angles[f"the angle of {names} from its sine"] = (_angle(steps.before, j, i), _angle(steps.after, j, i))
    passes = {}
    for name, (before, after) in angles.items():
        change = np.abs(after - before)
        is_pass = np.abs(change - 2 * np.pi) < NEAR_TURN
        if is_pass.sum() >= FEWEST_JUMPS and (is_pass | (change < SMALL_TURN)).all():
            passes[name] = is_pass
    return passes


def find_unit_pairs(rows: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Return pairs of elements that are a cosine and a sine, or the other way. Shape of rows: (n, elements)."""
    sums = [(i, j, rows[:, i] ** 2 + rows[:, j] ** 2) for i in range(rows.shape[1]) for j in range(i)]
    return [(j, i) for i, j, total in sums if np.abs(total[:100] - 1).max() < UNIT and np.abs(total - 1).max() < UNIT]


def _angle(rows: NDArray[np.float64], cosine: int, sine: int) -> NDArray[np.float64]:
    return np.arctan2(rows[:, sine], rows[:, cosine])


def _find_jumps(steps: Transitions) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.float64]]:
    """Return in which steps the reward jumps, in which that can be told, and its changes. Shape (n,) each."""
    changes = np.abs(np.diff(steps.rewards, prepend=np.nan))
    is_ordinary = ~(steps.success | steps.terminated | steps.is_last)
    is_ordinary &= np.r_[False, np.diff(steps.episodes) == 0]
    changes[~is_ordinary] = np.nan
    padded = np.pad(changes, NEIGHBOURS, constant_values=np.nan)
    around = [padded[NEIGHBOURS + shift : NEIGHBOURS + shift + len(changes)] for shift in _SHIFTS]
    neighbours = np.max(around, axis=0)  # NaN where one of them is
    is_judged = np.isfinite(neighbours) & np.isfinite(changes)
    with np.errstate(invalid="ignore"):
        return is_judged & (changes > JUMP * neighbours) & (changes > 0), is_judged, changes


_SHIFTS = [shift for shift in range(-NEIGHBOURS, NEIGHBOURS + 1) if shift]
