"""Who earned most, whether that is what the task calls success, and which term of the reward pays it."""

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from rlctl.checking.audit.competitors import LEARNED, OTHERS, SHIPPED, WANTED, Kind
from rlctl.checking.audit.play_world import PlayedEpisode
from rlctl.checking.rewards import discounted_steps
from rlctl.checking.term_names import is_about_steps

NEARLY = 0.9  # part of the wanted return that one who does not even try must not earn
AS_MUCH = 0.99  # part of the wanted return that one who does less than is wanted must not earn
SUCCEEDS = 0.5  # success rate from which on a play is what the task wants
MUCH = 0.1  # part of a return that a term must differ by, to be named for it
CLEARLY = 0.05  # part of a return that one must earn more than one who stands still, to be paid for what it does
FAR = 0.3  # difference of terms and length from which on two behaviours have nothing in common
STANDING_PAYS = 0.2  # part of what a term for steps pays at most, that it must not pay for standing still
AS_SIMPLE = 0.05  # part of a return: of competitors that earn as much, the simplest is named


@dataclasses.dataclass(frozen=True)
class MeanScore:
    """A competitor and its mean episode."""

    name: str
    kind: Kind
    episodes: int
    mean_return: float
    discounted: float
    success_rate: float | None
    steps: float
    terms: Mapping[str, float]  # means of the sums of the weighted terms

    @property
    def succeeds(self) -> bool:
        """Whether the task calls it a success."""
        return self.success_rate is not None and self.success_rate >= SUCCEEDS


@dataclasses.dataclass(frozen=True)
class Beaten:
    """A competitor that earns as much as what is wanted."""

    competitor: str
    wanted: str  # the play that it is compared with
    mean_return: float  # in the episodes that both have played
    wanted_return: float
    term: str  # which pays it; empty where no terms are known
    pays: bool  # False: it saves the cost of this term

    @property
    def share(self) -> float | None:
        """The part of the wanted return; None where one of them is not positive."""
        if self.mean_return <= 0 or self.wanted_return <= 0:
            return None
        return self.mean_return / self.wanted_return

    def describe(self) -> str:
        """Return a sentence: `standing still earns 94 % of following the command; alive pays it`."""
        if self.share is not None and self.share < 2.0:
            text = f"{self.competitor} earns {100 * self.share:.0f} % of {self.wanted}"
        else:
            more = "more than" if self.mean_return > self.wanted_return else "nearly as much as"
            text = f"{self.competitor} earns {more} {self.wanted} ({self._format_returns()})"
        if not self.term:
            return text
        return f"{text}; {self.term} pays it" if self.pays else f"{text}; it saves the cost of {self.term}"

    def _format_returns(self) -> str:
        """Return both returns, without the digits that do not matter next to the larger one."""
        digits = max(0, 3 - math.floor(math.log10(max(abs(self.mean_return), abs(self.wanted_return), 1e-9))))
        own, best = (f"{round(value, digits) + 0.0:.4g}" for value in (self.mean_return, self.wanted_return))
        return f"{own} against {best}"


@dataclasses.dataclass(frozen=True)
class Ranking:
    """All competitors, the best first, and those that earn as much as what is wanted."""

    rows: Sequence[MeanScore]
    wanted: str  # the play that others are compared with; empty where there is none
    why_alone: str  # why there is none
    beaten: Sequence[Beaten]  # the one to name first
    learned: str = ""  # what the policy of a run has learned, as a sentence
    next_best: str = ""  # who comes nearest to what is wanted, as part of a sentence
    paid_still: Sequence[str] = ()  # what terms for steps pay one who stands still, a sentence each


KINDS = {one.name: one.kind for one in (*WANTED, *OTHERS)} | {SHIPPED: Kind.wanted, LEARNED: Kind.learned}
MOVED = {one.name for one in OTHERS if one.is_moved}
STANDING, FOLLOWING = "standing still", "following the command"
DOING_NOTHING = [one.name for one in OTHERS if one.does_nothing]
LESSONS = {one.name: one.lesson for one in (*WANTED, *OTHERS)} | {SHIPPED: "what the shipped policy does"}


def rank(played: Sequence[PlayedEpisode], has_success: bool) -> Ranking:
    """Compare the competitors; `has_success` says whether the task says when it is a success.

    One that the engine moves takes no effort: it is compared with the best that shows what is wanted, also of those
    that are moved. Others are compared with the best that acts, if there is any.
    """
    names = list(dict.fromkeys(episode.competitor for episode in played))
    rows = {name: _summarize(name, KINDS[name], _select(played, name)) for name in names}
    ordered = sorted(rows.values(), key=lambda row: -row.mean_return)
    acting, moved = (_choose_wanted(rows, kind, has_success) for kind in (Kind.wanted, Kind.moved))
    wanted = acting or moved
    best = max((name for name in (acting, moved) if name), key=lambda name: rows[name].mean_return, default="")
    beaten: list[Beaten] = []
    for row in rows.values() if wanted else ():
        if row.kind in (Kind.idle, Kind.part) and not row.succeeds:
            found = _compare(played, row, best if row.name in MOVED else wanted)
            beaten += [] if found is None else [found]
    why = "" if wanted else _explain_absence(rows, has_success)
    others = [row for row in ordered if row.kind in (Kind.idle, Kind.part) and not row.succeeds]
    if acting and not moved:  # without effort they would seem nearer than they are
        others = [row for row in others if row.name not in MOVED]
    following = _describe_next(rows[wanted], others[0]) if wanted and others else ""
    return Ranking(
        ordered, wanted, why, _order(beaten), _describe_learned(rows, wanted), following, list(_describe_standing(rows))
    )


def _describe_standing(rows: Mapping[str, MeanScore]) -> Iterator[str]:
    """Yield for a robot that is to follow a command `feet_clearance pays standing still 80 % of the most it pays`."""
    still = rows.get(STANDING)
    if still is None or FOLLOWING not in rows:
        return
    for term, value in still.terms.items():
        paid = value / max(still.steps, 1.0)
        most, name = max((row.terms.get(term, 0.0) / max(row.steps, 1.0), row.name) for row in rows.values())
        if is_about_steps(term) and paid > STANDING_PAYS * most > 0:
            share = "the most that it pays" if name == STANDING else f"what it pays {name}"
            yield f"{term} pays standing still {100 * paid / most:.0f} % of {share}: it should pay nothing then"


def _describe_next(best: MeanScore, row: MeanScore) -> str:
    """Return `; next is standing still with 40 %`."""
    if best.mean_return > 0 and row.mean_return > 0:
        return f"; next is {row.name} with {100 * row.mean_return / best.mean_return:.0f} %"
    return f"; next is {row.name} ({row.mean_return:.4g} against {best.mean_return:.4g})"


def _select(played: Sequence[PlayedEpisode], name: str, seeds: set[int] | None = None) -> list[PlayedEpisode]:
    own = [episode for episode in played if episode.competitor == name]
    return own if seeds is None else [episode for episode in own if episode.seed in seeds]


def _summarize(name: str, kind: Kind, episodes: Sequence[PlayedEpisode]) -> MeanScore:
    successes = [episode.success for episode in episodes if episode.success is not None]
    terms = episodes[0].terms if episodes else {}
    return MeanScore(
        name=name,
        kind=kind,
        episodes=len(episodes),
        mean_return=_mean([episode.reward for episode in episodes]),
        discounted=_mean([episode.discounted for episode in episodes]),
        success_rate=_mean(successes) if successes else None,
        steps=_mean([episode.steps for episode in episodes]),
        terms={term: _mean([episode.terms.get(term, 0.0) for episode in episodes]) for term in terms},
    )


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else 0.0


def _choose_wanted(rows: Mapping[str, MeanScore], kind: Kind, has_success: bool) -> str:
    """Return the play of most return, of a kind, that shows what is wanted; empty if there is none."""
    candidates = [row for row in rows.values() if row.kind is kind and (row.succeeds or not has_success)]
    return max(candidates, key=lambda row: row.mean_return).name if candidates else ""


def _explain_absence(rows: Mapping[str, MeanScore], has_success: bool) -> str:
    tried = [row.name for row in rows.values() if row.kind in (Kind.wanted, Kind.moved)]
    if tried:
        return f"the task does not call it a success: {', '.join(tried)}"
    if not has_success:
        return "the task says neither when it is a success nor what is commanded, and ships no policy"
    why = "no robot or object could be placed so that the task calls it a success, and it ships no policy"
    return f"{why}{_describe_lost_income(rows)}"


def _describe_lost_income(rows: Mapping[str, MeanScore]) -> str:
    """Return that one who never succeeds earns more than each that does; empty where that is not so."""
    successful = [row for row in rows.values() if row.succeeds]
    others = [row for row in rows.values() if row.success_rate == 0.0]
    if not successful or not others:
        return ""
    best, other = (max(some, key=lambda row: row.mean_return) for some in (successful, others))
    earned_more = _is_much_more(other.mean_return, best.mean_return)
    if not earned_more or not _is_much_more(other.discounted, best.discounted):
        return ""
    succeeds = f"{best.name} succeeds in {best.success_rate:.0%} of its episodes and earns {best.mean_return:.4g}"
    return f"; success does not pay: {succeeds}, {other.name} never does and earns {other.mean_return:.4g}"


def _is_much_more(one: float, other: float) -> bool:
    return one - other > MUCH * max(abs(one), abs(other))


def _compare(played: Sequence[PlayedEpisode], row: MeanScore, wanted: str) -> Beaten | None:
    """Return how a competitor earns as much as what is wanted, in the episodes that both have played; None if less."""
    shared = {one.seed for one in _select(played, row.name)} & {one.seed for one in _select(played, wanted)}
    if not shared:
        return None
    own = _summarize(row.name, row.kind, _select(played, row.name, shared))
    best = _summarize(wanted, Kind.wanted, _select(played, wanted, shared))
    part = AS_MUCH if row.kind is Kind.part else NEARLY
    saved, discounted = 0.0, 0.0
    if row.name in MOVED and KINDS[wanted] is Kind.wanted:
        saved = _sum_saved_costs(own, best)
        discounted = discounted_steps(saved / max(own.steps, 1.0), own.steps)
    pairs = ((own.mean_return - saved, best.mean_return), (own.discounted - discounted, best.discounted))
    if not all(_is_as_much(earned, needed, part) for earned, needed in pairs):
        return None
    idle = next((found for name in DOING_NOTHING if (found := _select(played, name, shared))), [])
    term, pays = find_term(own, best, _summarize("", Kind.idle, idle) if idle else None)
    return Beaten(row.name, wanted, own.mean_return, best.mean_return, term, pays)


def _sum_saved_costs(own: MeanScore, best: MeanScore) -> float:
    """Return the costs that one saves next to another: whoever is held by the engine stands without any effort."""
    costs = [(value, best.terms.get(term, 0.0)) for term, value in own.terms.items() if value <= 0.0]
    return sum(max(0.0, value - other) for value, other in costs)


def _is_as_much(earned: float, needed: float, part: float) -> bool:
    return needed - earned <= (1.0 - part) * max(abs(earned), abs(needed))


def find_term(own: MeanScore, best: MeanScore, idle: MeanScore | None) -> tuple[str, bool]:
    """Return the term because of which a competitor earns as much, and whether it pays; else its cost is saved.

    It is the term that gives a competitor clearly more than what is wanted; else what it earns beyond one who does
    nothing; else what pays it most.
    """
    if not own.terms:
        return "", True
    scale = max(abs(own.mean_return), abs(best.mean_return), 1e-9)
    more = {term: value - best.terms.get(term, 0.0) for term, value in own.terms.items()}
    first = max(more, key=lambda term: more[term])
    if more[first] > MUCH * scale:
        return first, own.terms[first] > 0
    if idle is not None and own.mean_return - idle.mean_return > CLEARLY * scale:
        gained = {term: value - idle.terms.get(term, 0.0) for term, value in own.terms.items()}
        return max(gained, key=lambda term: gained[term]), True
    return max(own.terms, key=lambda term: own.terms[term]), True


def _order(beaten: Sequence[Beaten]) -> list[Beaten]:
    """Return the competitor to name first at the front: the simplest of those that earn about most."""
    if not beaten:
        return []
    most = max(one.mean_return for one in beaten)
    about = [one for one in beaten if most - one.mean_return <= AS_SIMPLE * max(abs(most), 1e-9)]
    names = list(KINDS)
    first = min(about, key=lambda one: names.index(one.competitor))
    rest = [one for one in beaten if one is not first]
    return [first, *sorted(rest, key=lambda one: -one.mean_return)]


def _describe_learned(rows: Mapping[str, MeanScore], wanted: str) -> str:
    """Return what the policy of a run has learned: the competitor whose terms its own are nearest to."""
    own = rows.get(LEARNED)
    others = [row for name, row in rows.items() if name != LEARNED]
    if own is None or not others:
        return ""
    nearest = min(others, key=lambda row: _distance(own, row))
    against = f"return {own.mean_return:.4g}"
    if wanted:
        against += f", {wanted} {rows[wanted].mean_return:.4g}"
    is_as_wanted = nearest.kind in (Kind.wanted, Kind.moved) and _distance(own, nearest) <= FAR
    if own.succeeds or is_as_wanted:
        return f"it has learned what is wanted ({against})"
    if _distance(own, nearest) > FAR:
        return f"what it has learned is like no competitor ({against})"
    return f"it has learned {LESSONS[nearest.name]} ({against}, {nearest.name} {nearest.mean_return:.4g})"


def _distance(one: MeanScore, other: MeanScore) -> float:
    """Return how different two behaviours are: by terms and length, each relative to its size."""
    names = one.terms.keys() | other.terms.keys()
    terms = sum(abs(one.terms.get(name, 0.0) - other.terms.get(name, 0.0)) for name in names)
    if not names:
        terms = abs(one.mean_return - other.mean_return)
    sizes = sum(abs(value) for row in (one, other) for value in row.terms.values())
    size = sizes or abs(one.mean_return) + abs(other.mean_return)
    length = abs(one.steps - other.steps) / max(one.steps, other.steps, 1.0)
    return terms / max(size, 1e-9) + length
