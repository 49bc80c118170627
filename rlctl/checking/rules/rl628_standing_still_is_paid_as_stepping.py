"""RL628: standing still is paid as stepping."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.experiment import judges_records
from rlctl.checking.experiments.attributes import EPISODES, AttributeLog, Numbers
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.experiments.worlds import WatchedWorlds, judges_worlds
from rlctl.checking.feet import find_feet, read_touches
from rlctl.checking.first_contacts import find_endless_landings
from rlctl.checking.records import Records
from rlctl.checking.rule import NotApplicable, NotJudged, Rule, RuleFinding, Severity
from rlctl.checking.step_times import find_rates
from rlctl.checking.term_names import is_about_landings, is_about_steps, is_paid
from rlctl.checking.world_logs import LoggedWorld

RULE = Rule(
    "RL628",
    "standing still is paid as stepping",
    Severity.WARNING,
    meaning="""
        A reward term for the clearance of feet, their height or their time in the air pays also while nothing moves: a
        foot on the ground earns it, or the term has a value where it should be zero, such as exp(0). Standing still
        then earns it in every step, and the robot need not walk. The check gave the zero action until the robot stood
        or lay still, in several episodes. A term of any name is found that pays each landing otherwise, and for each
        foot that stays on the ground the same: each step of contact counts as a landing. So is a condition in the
        source such as contact & (self.air_time > 0), where the time is counted on before.
    """,
    fix="""
        Pay the clearance only of feet that move, such as height error times the foot's horizontal speed, and the time
        in the air when a foot comes down; pay nothing where no foot is in the air. Find out whether a foot has just
        come down before its time in the air is counted on.
    """,
)

LOOKED = 10  # last steps of an episode
STILL = 0.04  # part of the speeds in other episodes
SLOW = 0.05  # speeds that are as good as none [rad/s], [m/s]
MUCH = 0.2  # part of what the term pays at most
MOST_PAID = 0.95  # quantile of what it pays
FEWEST_STAYS, FEWEST_LANDINGS = 30, 6  # steps
ALIKE, ALIKE_FLIGHTS = 0.75, 0.9  # parts of the steps in which feet stay, or none touches, that pay each the same
EXACT = 1e-6  # relative error of what is paid
FEWEST_VALUES = 3  # different ones, of what landings pay


@judges_expressions(RULE, decides=False)
def _find_landings(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    for one in find_endless_landings(noted):
        message = f"{one.text} holds in all {one.stays} steps in which a contact goes on, since {one.key} has been"
        message += f" counted on to {one.time:.3g} before: each step on the ground counts as a landing"
        yield RuleFinding(RULE, message, {"element": one.key, "value": one.time}, where=one.where)


@judges_records(RULE, "attributes")
def _find_paid_standing(records: Records) -> Iterator[RuleFinding]:
    log: AttributeLog = records.require_fact("attributes")
    terms = {name: values for name, values in log.infos.items() if is_paid(name) and is_about_steps(name)}
    if not terms:
        raise NotApplicable("no reward term in info is called after the clearance of feet or their time in the air")
    still = _find_still(log)
    episodes = [number for number in range(len(EPISODES)) if EPISODES[number] == "zero"]
    looks = [np.flatnonzero((log.episodes == number) & still) for number in episodes]
    looks = [rows for rows in looks if len(rows) == LOOKED]
    if len(looks) < len(episodes):
        raise NotJudged("the robot does not come to rest with the zero action")
    known = {finding.evidence.get("term") for finding in records.findings if finding.rule == RULE.id}
    for name, values in terms.items():
        if name in known:
            continue
        paid = np.array([values[rows].mean() for rows in looks])
        most = float(np.nanquantile(values, MOST_PAID))
        shown = f"{paid.mean():.3g} in each step while nothing moves"
        if paid.min() > MUCH * most > 0:
            message = f"{name} pays {shown}, {paid.mean() / most:.0%} of the {most:.3g} that it pays at most"
        elif is_about_landings(name) and paid.max() < MUCH * float(np.nanquantile(values, 1 - MOST_PAID)) < 0:
            message = f"{name} is {shown}: feet that stay on the ground count as feet that come down in each step"
        else:
            continue
        message += f", in {len(looks)} of {len(looks)} episodes with the zero action"
        yield RuleFinding(RULE, message, {"term": name, "value": float(paid.mean()), "expected": 0.0})


def _find_still(log: AttributeLog) -> NDArray[np.bool_]:
    """Return the last looks of episodes with the zero action at which nothing moves. Shape (looks,)."""
    speeds = log.speeds
    if not speeds.shape[1]:
        speeds = log.values[:, sorted({rate for _, rate, _ in find_rates(log, log.values)})]
    if not speeds.shape[1]:
        raise NotJudged("no velocity is known")
    acting = np.isin(log.episodes, [number for number, kind in enumerate(EPISODES) if kind != "zero"])
    usual = np.sqrt(np.mean(np.square(speeds[acting]), axis=0))
    is_slow = (np.abs(speeds) <= np.maximum(STILL * usual, SLOW)).all(axis=1)
    last = np.zeros(len(speeds), np.bool_)
    for number in set(log.episodes.tolist()):
        last[np.flatnonzero(log.episodes == number)[-LOOKED:]] = True
    return np.asarray(is_slow & last & ~acting)


@judges_worlds(RULE)
def _find_paid_contacts(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    """Yield terms that pay the same for each foot that stays on the ground, and something else for landings."""
    for world in watched.worlds:
        before, after = _read_feet(world)
        names = dict.fromkeys(name for log in world.logs for told in log.told for name in told if is_paid(name))
        for name in names:
            told = [[told.get(name, np.nan) for told in log.told[1:]] for log in world.logs if len(log.told) > 1]
            values = np.concatenate([np.zeros(0), *told])
            known = np.isfinite(values)
            each = _find_paid_each(values[known], before[known], after[known]) if len(before) == len(values) else None
            if each is not None:
                message = (
                    f"{name} is {each:.3g} for each foot that stays on the ground, in every step, as if it had just"
                )
                message += " come down; landings are paid by something else besides"
                yield RuleFinding(RULE, message, {"term": name, "value": each, "expected": 0.0})


def _read_feet(world: LoggedWorld) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which links of robots touch other bodies before and after each step. Shape (steps, links) each."""
    feet = find_feet(world)
    rows = [np.zeros((1, len(feet)), np.bool_), *(read_touches(log, feet) for log in world.logs)]
    return np.concatenate([row[:-1] for row in rows]), np.concatenate([row[1:] for row in rows])


def _find_paid_each(values: Numbers, before: NDArray[np.bool_], after: NDArray[np.bool_]) -> float | None:
    """Return what each foot on the ground pays in a step; None where it pays nothing, or not always the same, and where
    landings pay no more than that."""
    count, is_same, lands = after.sum(axis=1), (before == after).all(axis=1), (after & ~before).any(axis=1)
    stays, flies = is_same & (count > 0), is_same & (count == 0)
    if stays.sum() < FEWEST_STAYS or lands.sum() < FEWEST_LANDINGS:
        return None
    # Feet that bounce touch in one substep and not in the next, so that some steps pay landings that are not seen.
    each = float(np.median(values[stays] / count[stays]))
    rest = values - each * count
    is_alike = np.abs(rest) <= EXACT * max(1.0, abs(each))
    others = np.unique(np.round(rest[lands & ~is_alike], 6))
    if each == 0.0 or is_alike[stays].mean() < ALIKE or len(others) < FEWEST_VALUES:
        return None
    return each if not flies.any() or is_alike[flies].mean() >= ALIKE_FLIGHTS else None
