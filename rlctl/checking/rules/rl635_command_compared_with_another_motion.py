"""RL635: command compared with another motion."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from rlctl.checking.command_sweeps import Array, CommandSweep
from rlctl.checking.drawn_goals import DrawnPlace
from rlctl.checking.experiments.commands import MOTION_WORDS, CommandTrials, judges_commands
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.paid_commands import CommandReader
from rlctl.checking.records import FIRST_SEED, ChildMessage
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.term_names import split_name

RULE = Rule(
    "RL635",
    "command compared with another motion",
    Severity.WARNING,
    meaning="""
        The check played the same steps with many values of the command. The value that pays most is, step by step, a
        motion of the base that such a command does not mean: the rate about a level axis, while no number of the
        command is compared with the rate about the vertical; the speed to the side, while the second number is
        compared with the speed ahead; the rate in degrees for a command in radians; or the rate with the other sign
        than the observation has it. Or the source compares a number of a velocity along one axis with what is named
        after another, such as yaw_error = command[1] - gyro[0]. Moving as commanded is not paid.
    """,
    fix="""
        Compare each number of the command with its own quantity: forward speed with velocity[0], speed to the side
        with velocity[1], turn rate with angular_velocity[2], all in the frame of the robot and in SI units.
    """,
)

MATCH = 0.02  # part of the standard deviation of the best commands by which a motion may miss them
UNLIKE = 0.1  # part by which others miss them at least
FEWEST = 6  # steps with a best command
LEAST = 1e-4  # standard deviation of a motion [m/s], [rad/s]
LEVEL, UPRIGHT = 0.5, 0.8  # sine of the most and the least angle of an axis to the horizontal
DEGREES = 180 / np.pi
EXACT = 0.01  # relative error of a factor
TURN = 2 * np.pi  # [rad/s]; commands in radians are smaller, commands in degrees larger
ROUNDED = 3e-3  # part of the range of a command by which the best one may be missed
OBSERVED = 0.9  # correlation of an observed number, perhaps with noise


class _Motions(NamedTuple):
    """How the base moves at the moments of a sweep that have a best command."""

    best: Array  # Shape (n,)
    turn: Array  # Shape (n, 3, 3)
    velocity: Array  # In the frame of the base. Shape (n, 3)
    rates: Array  # The same
    yaw_rate: Array  # About the vertical. Shape (n,)
    observed: Array  # Shape (n, elements)
    error: float  # of the best commands


@judges_commands(RULE)
def _find_other_motions(trials: CommandTrials) -> Iterator[ChildMessage]:
    swept = {place: trials.sweep(place) for place in trials.paid}
    motions = {place: found for place, sweep in swept.items() if (found := _read(sweep)) is not None}
    for place, sweep in swept.items():
        if sweep is None:
            continue
        what = ""
        if place in motions:
            others = [other for one, other in motions.items() if one != place]
            what = _find_level_rate(motions[place], others) or _find_turned_rate(motions[place], sweep)
            what = what or _find_swapped(place, motions)
        what = what or _find_turned_element(sweep, trials.names)
        if what:
            message = f"the value of {trials.name(place)} that pays most is {what}, in"
            message += (
                f" {int(np.isfinite(sweep.best).sum())} of {len(sweep.moments)} steps that were played again with"
            )
            message += " other values"
            yield RuleFinding(RULE, message, {"element": trials.name(place), "seed": FIRST_SEED})


def _read(sweep: CommandSweep | None) -> _Motions | None:
    if sweep is None:
        return None
    moments = [moment for moment in sweep.moments if np.isfinite(moment.best)]
    bases = [moment.base for moment in moments if moment.base is not None]
    if len(bases) < max(FEWEST, len(moments)) or len({moment.observed.shape for moment in moments}) != 1:
        return None
    turn = np.array([base.turn for base in bases])
    velocity, rates = (
        np.einsum("nij,ni->nj", turn, np.array([getattr(base, name) for base in bases]))
        for name in ("velocity", "rates")
    )
    best, observed = (np.array([getattr(moment, name) for moment in moments]) for name in ("best", "observed"))
    error = ROUNDED * float(np.ptp(sweep.drawn))
    return _Motions(best, turn, velocity, rates, np.array([base.rates[2] for base in bases]), observed, error)


def _fit(best: Array, motion: Array) -> tuple[float, float]:
    """Return by which factor a motion is the best command, and which part of its deviation the rest is. The moment that
    it misses most is left out: not every contact is the same again."""
    if motion.std() < LEAST:
        return 0.0, np.inf
    kept = np.argsort(np.abs(best - float(best @ motion / (motion @ motion)) * motion))[:-1]
    best, motion = best[kept], motion[kept]
    factor = float(best @ motion / (motion @ motion))
    return factor, float((best - factor * motion).std() / max(best.std(), LEAST))


def _is(best: Array, motion: Array) -> bool:
    return _fit(best, motion)[1] < MATCH


def _list_yaw_rates(found: _Motions) -> list[Array]:
    """Return the rate about the vertical, and that about an axis of the base which is nearly vertical."""
    upright = [axis for axis in range(3) if np.abs(found.turn[:, 2, axis]).min() > UPRIGHT]
    return [found.yaw_rate, *(found.rates[:, axis] for axis in upright)]


def _find_level_rate(found: _Motions, others: Sequence[_Motions]) -> str:
    """Say which level axis a command turns about, where no command turns about the vertical."""
    compared = (found, *others)
    if any(_fit(one.best, rate)[1] < UNLIKE for one in compared for rate in _list_yaw_rates(one)):
        return ""
    for axis in range(3):
        if np.abs(found.turn[:, 2, axis]).max() < LEVEL and _is(found.best, found.rates[:, axis]):
            return (
                f"the rate about the level {'xyz'[axis]} axis of the base, and nothing is compared with its turn rate"
            )
    return ""


def _find_turned_rate(found: _Motions, sweep: CommandSweep) -> str:
    """Say how a command is the turn rate in another unit, or with another sign than it is observed."""
    rates = [rate for rate in _list_yaw_rates(found) if _is(found.best, rate)]
    if not rates:
        return ""
    factor, largest = _fit(found.best, rates[0])[0], float(np.abs(sweep.drawn).max())
    if abs(abs(factor) / DEGREES - 1) < EXACT and largest < TURN:
        return f"its turn rate in degrees per second, and resets draw at most {largest:.3g}"
    if abs(abs(factor) * DEGREES - 1) < EXACT and largest > TURN:
        return f"its turn rate in radians per second, and resets draw up to {largest:.3g}"
    if abs(factor + 1) < EXACT and _observes(found, found.yaw_rate) and not _observes(found, -found.yaw_rate):
        return "its turn rate with the other sign, and the observation has it with this one"
    return ""


def _observes(found: _Motions, motion: Array) -> bool:
    elements = found.observed[:, found.observed.std(axis=0) > LEAST]
    return any(np.corrcoef(column, motion)[0, 1] > OBSERVED for column in elements.T)


def _find_turned_element(sweep: CommandSweep, names: Sequence[str]) -> str:
    """Say that a command is an observed velocity with the other sign."""
    moments = [moment for moment in sweep.moments if np.isfinite(moment.best)]
    if len(moments) < FEWEST or {moment.observed.shape for moment in moments} != {(len(names),)}:
        return ""
    best = np.array([moment.best for moment in moments])
    fits = [_fit(best, column) for column in np.array([moment.observed for moment in moments]).T]
    if any(factor > 0 and missed < UNLIKE for factor, missed in fits):
        return ""
    for name, (factor, missed) in zip(names, fits, strict=True):
        if missed < MATCH and abs(factor + 1) < EXACT and set(split_name(name)) & MOTION_WORDS:
            return f"{name} with the other sign"
    return ""


def _find_swapped(place: DrawnPlace, motions: dict[DrawnPlace, _Motions]) -> str:
    """Say that a number of a command is the speed to the side where a later one of the same is the speed ahead."""
    found = motions[place]
    for other, ahead in motions.items():
        is_later = other.name == place.name and other.elements[0] > place.elements[0]
        is_aside = bool(np.sort(np.abs(found.best - found.velocity[:, 1]))[-2] <= found.error)
        if is_later and is_aside and _is(ahead.best, ahead.velocity[:, 0]) and _differs(found, found.velocity[:, 0]):
            return f"the speed to the side (y of the base), and that of {other.name}[{other.elements[0]}] the one ahead"
    return ""


def _differs(found: _Motions, motion: Array) -> bool:
    return bool(np.abs(found.best - motion).max() > 10 * found.error)


@judges_expressions(RULE, decides=False)
def _find_other_axis(notes: NotedEpisodes) -> Iterator[ChildMessage]:
    """Yield the first number of a velocity along another axis than the names say."""
    for summand, named, text, axis in notes.share(CommandReader).find_other_axes():
        message = (
            f"reward term {summand.name!r} compares {text} with what is called {named!r}, which is about axis {axis}"
        )
        yield RuleFinding(RULE, message, {"element": summand.name}, where=notes.reward.locate(summand.place))
        return
