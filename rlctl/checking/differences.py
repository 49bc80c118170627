"""Whether two recordings of an episode are equal, and how to report that they are not."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np

from rlctl.checking.kept_state import MUJOCO, KeptState, describe_kept
from rlctl.checking.records import CheckedEpisode, Records, Series
from rlctl.checking.rule import NotJudged, Rule, RuleFinding, Severity, list_names
from rlctl.environments.success import SUCCESS

COMPARED_STEPS = 200  # How far comparisons go
LATE = 20  # a later difference is a residue, not the episode's start [steps]
LAST_BITS = 1e-12  # largest difference that the order of additions explains
NEARLY = 1e-5  # relative to the value or to 1: a smaller first difference is a numerical residue


@dataclasses.dataclass(frozen=True)
class FirstDifference:
    """Where two recordings begin to differ."""

    step: int  # 0 is the observation of reset
    element: str  # what differs most there: an element, the reward, a flag, or the length
    first: float
    second: float
    place: tuple[int, int] | None  # of an element: of its array, and its flat index in it
    size: float  # The largest difference at that step, relative to the larger value or to 1
    largest: float  # The same over all steps that were compared
    seed: int

    @property
    def is_small(self) -> bool:
        """Whether the two differ by a numerical residue only."""
        return self.size <= NEARLY

    def text(self) -> str:
        """Return it as a message."""
        size = f" (a residue of {self.size:.0e}, later up to {self.largest:.0e})" if self.is_small else ""
        at = "at reset" if self.step == 0 else f"at step {self.step}"
        return f"first difference {at}: {self.element} is {self.first:.9g}, then {self.second:.9g}{size}"

    def evidence(self) -> dict[str, Any]:
        """Return it as a finding's evidence."""
        place = {"seed": self.seed, "step": self.step, "element": self.element}
        sizes = {"relative_difference": self.size, "largest_relative_difference": self.largest}
        return {**place, "value": self.second, "expected": self.first, **sizes}


def compare(records: Records, first: str, second: str) -> FirstDifference | None:
    """Compare two recordings of an episode; raises `NotJudged` where one is missing, or raised before they differ."""
    if not records.require_built().accepts_seed:
        raise NotJudged("reset takes no seed (RL202)")
    a, b = records.require_role(first), records.require_role(second)
    difference = find_difference(records, a, b)
    if difference is None and "raised" in (a.ended, b.ended):
        raise NotJudged("the episode failed (RL201, RL207)")
    if difference is None and not any(series.values.size for series in a.observations.values()):
        raise NotJudged("no observation could be compared")
    return difference


def require_independent(records: Records) -> None:
    """Raise `NotJudged` if an episode depends on the one before it."""
    if compare(records, "alone", "reused") is not None or compare(records, "alone", "dirty") is not None:
        raise NotJudged("an episode already depends on the previous one (RL301 to RL303)")


def report(
    rule: Rule, records: Records, found: FirstDifference, what: str, cause: str = "", fix: str = "", mild: bool = False
) -> RuleFinding:
    """Return the finding that two recordings differ; an info if they are registered to, and no cause is known."""
    severity = Severity.WARNING if found.is_small or mild else None
    if (records.require_built().nondeterministic and not cause) or found.largest < LAST_BITS:
        severity = Severity.INFO
    return RuleFinding(rule, f"{what}: {found.text()}{cause}", found.evidence(), severity, fix)


def _find_cause(records: Records, difference: FirstDifference) -> tuple[str, str]:
    fresh = records.role("fresh process")
    if not fresh or find_difference(records, records.require_role("alone"), fresh[0]) is not None:
        return "", ""  # a new process differs too: chance
    if find_difference(records, records.require_role("reused"), records.require_role("dirty")) is None:
        fix = "Let every reset do what the first one does: restore a saved state before anything reads it."
        return "; the first episode of an instance differs from all later ones", fix
    kept: list[KeptState] = records.facts.get("kept", [])
    place = difference.place if difference.step == 0 else None
    names, fix = describe_kept(kept, place, difference.element)
    return f"; a new process repeats it, so reset keeps state{names}", fix


def compare_itself(rule: Rule, records: Records, what: str, *, at_reset: bool) -> Iterator[RuleFinding]:
    """Yield that an episode differs from its repetition, at reset or later; `what` was done."""
    difference = compare(records, "alone", "reused")
    if difference is not None and (difference.step == 0) is at_reset:
        yield report(rule, records, difference, what, *_find_cause(records, difference))


def compare_other(rule: Rule, records: Records, first: str, second: str, what: str) -> Iterator[RuleFinding]:
    """Yield that two recordings of an episode differ, if it does not differ from its repetition; `what` was done."""
    if (difference := compare(records, first, second)) is not None:
        if compare(records, "alone", "reused") is not None:
            raise NotJudged("the same instance already differs from itself (RL301, RL302)")
        cause = _name_fields(records) if second == "dirty" else ""
        yield report(rule, records, difference, what, cause, mild=second == "dirty" and difference.step > LATE)


def _name_fields(records: Records) -> str:
    """Say which fields of MuJoCo a reset keeps; of PyBullet, what differs after a reset may be its contacts' doing."""
    kept = [one.name for one in records.facts.get("kept", []) if one.engine == MUJOCO]
    return f"; reset keeps {list_names(kept)} of MuJoCo" if kept else ""


def find_difference(records: Records, one: CheckedEpisode, two: CheckedEpisode) -> FirstDifference | None:
    """Compare two recordings bit for bit as far as both go; NaN equals NaN."""
    others = _list_series(two)
    pairs = [(key, series, others[key]) for key, series in _list_series(one).items() if key in others]
    differences = [difference for pair in pairs if (difference := _compare(records, *pair, one.seed))]
    if one.has_ended and two.has_ended and one.steps != two.steps:
        end = min(one.steps, two.steps)
        differences.append(FirstDifference(end, "length", one.steps, two.steps, None, 1.0, 1.0, one.seed))
    if not differences:
        return None
    earliest = min(differences, key=lambda difference: (difference.step, -difference.size))
    return dataclasses.replace(earliest, largest=max(difference.largest for difference in differences))


def _list_series(episode: CheckedEpisode) -> dict[int | str, Series]:
    after = np.arange(1, episode.steps + 1)
    numbers = {"reward": episode.rewards, "terminated": episode.terminated, "truncated": episode.truncated}
    series: dict[int | str, Series] = {index: episode.observations[index] for index in sorted(episode.observations)}
    series |= {name: Series(after, values) for name, values in numbers.items()}
    return series | {name: values for name, values in episode.infos.items() if name == SUCCESS}


def _compare(records: Records, key: int | str, one: Series, two: Series, seed: int) -> FirstDifference | None:
    rows = min(len(one.values), len(two.values))
    a, b = one.rows[:rows], two.rows[:rows]
    unequal = (a != b) & ~(np.isnan(a) & np.isnan(b))
    if not unequal.any():
        return None
    row = int(unequal.any(axis=1).argmax())
    with np.errstate(invalid="ignore", over="ignore"):
        relative = np.where(unequal, np.abs(a - b), 0.0) / np.maximum(np.maximum(np.abs(a), np.abs(b)), 1.0)
    relative = np.nan_to_num(relative, nan=np.inf, posinf=np.inf)
    flat = int(np.where(unequal[row], relative[row], -1.0).argmax())
    name = key if isinstance(key, str) else records.require_built().element(key, flat)
    return FirstDifference(
        step=int(one.steps[row]),
        element=name,
        first=float(a[row, flat]),
        second=float(b[row, flat]),
        place=None if isinstance(key, str) else (key, flat),
        size=float(relative[row, flat]),
        largest=float(relative.max()),
        seed=seed,
    )
