"""RL628: standing still is paid as stepping."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.experiment import judges_records
from rlctl.checking.experiments.attributes import EPISODES, AttributeLog
from rlctl.checking.records import Records
from rlctl.checking.rule import NotApplicable, NotJudged, Rule, RuleFinding, Severity
from rlctl.checking.step_times import find_rates
from rlctl.checking.term_names import is_about_landings, is_about_steps, is_paid

RULE = Rule(
    "RL628",
    "standing still is paid as stepping",
    Severity.WARNING,
    meaning="""
        A reward term for the clearance of feet, their height or their time in the air pays also while nothing moves: a
        foot on the ground earns it, or the term has a value where it should be zero, such as exp(0). Standing still
        then earns it in every step, and the robot need not walk. The check gave the zero action until the robot stood
        or lay still, in several episodes.
    """,
    fix="""
        Pay the clearance only of feet that move, such as height error times the foot's horizontal speed, and the time
        in the air when a foot comes down; pay nothing where no foot is in the air.
    """,
)

LOOKED = 10  # last steps of an episode
STILL = 0.04  # part of the speeds in other episodes
SLOW = 0.05  # speeds that are as good as none [rad/s], [m/s]
MUCH = 0.2  # part of what the term pays at most
MOST_PAID = 0.95  # quantile of what it pays


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
    for name, values in terms.items():
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
