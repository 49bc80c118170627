"""How many mistakes in a mapping `rlctl diagnose` names, and how often it calls a sound log broken."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from rlctl_robot.diagnose.correction import Correction
from rlctl_robot.diagnose.diagnose import Doctor, MappingFinding
from rlctl_robot.diagnose.signals import LoggedSignals
from tests.benchmarks.broken_logs import BrokenLog, Draws, Robot, Wrong
from tests.benchmarks.row import Row

COUNT = int(os.environ.get("DIAGNOSE_COUNT", "40"))  # logs of each kind
SINGLES, PAIRS = 36 / 40, 25 / 40  # to be named
SEED = int(os.environ.get("DIAGNOSE_SEED", "20000"))  # the default was not used while the search was built
CLOSE = 0.1  # relative error of a value that was corrected with fitted numbers


def is_named(wrong: Wrong, finding: MappingFinding, size: int) -> bool:
    """Whether a finding says exactly what is wrong: its correction gives the right values again."""
    one = finding.correction
    if wrong.stuck:
        elements = wrong.stuck if len(wrong.stuck) < size or size == 1 else ()
        text = f"element {elements[0]} is frozen" if elements else "all elements are frozen"
        return finding.kind == "frozen" and finding.term == wrong.term and text in finding.text
    if one is None or one.term != wrong.term or one.delay != wrong.late:
        return False
    return _gives_right_values(wrong, one, size)


def _gives_right_values(wrong: Wrong, one: Correction, size: int) -> bool:
    right = np.random.default_rng(0).uniform(0.5, 2.0, (6, size))
    value = right[:, list(wrong.order)] if wrong.order else right
    value = value * np.array(wrong.factor) if wrong.factor else value
    value = value + np.array(wrong.offset) if wrong.offset else value
    on_robot = wrong.term == "actions" and not wrong.in_log
    expected, got = (value, one.change(right)) if on_robot else (right, one.change(value))
    return bool(np.allclose(got, expected, rtol=CLOSE, atol=0.02))


def record(robot: Robot, wrongs: Sequence[Wrong], rng: Any) -> BrokenLog:
    """Return a log of 3 s to a minute, of the nominal or a randomised robot, with more or less noise."""
    seconds, noise = float(rng.choice([3, 10, 30, 60])), float(rng.choice([0.0, 0.02, 0.05]))
    return robot.log(wrongs, seconds, int(rng.integers(2**31)), randomized=bool(rng.integers(2)), noise=noise)


class Trials:
    """Diagnoses logs of one task."""

    def __init__(self, task: str) -> None:
        self.robot = Robot(task)
        self.doctor = Doctor(self.robot.policy_file, self.robot.spec)
        self.draws = Draws(self.robot, self.doctor.likelihood.reference.allowed_delay)
        self.times: list[float] = []

    def diagnose(self, wrongs: Sequence[Wrong], rng: Any) -> list[MappingFinding]:
        """Record a log with mistakes and return the findings."""
        log = record(self.robot, wrongs, rng)
        began = time.process_time()
        found = self.doctor.diagnose(LoggedSignals(log.observations, log.actions, log.lengths, log.sizes))[0]
        self.times.append(time.process_time() - began)
        return found

    def size(self, wrong: Wrong) -> int:
        """Elements of the term of a mistake."""
        if wrong.term == "observation":
            return sum(self.robot.sizes.values())
        return self.robot.sizes.get(wrong.term, len(self.robot.low))

    def single(self, rng: Any) -> bool:
        """Whether one mistake is named first."""
        wrong = self.draws.draw(rng)
        found = self.diagnose([wrong], rng)
        right = bool(found) and is_named(wrong, found[0], self.size(wrong))
        return _note("single", right, [wrong], found)

    def pair(self, rng: Any) -> bool:
        """Whether both of two mistakes are named."""
        first = self.draws.draw(rng)
        second = self.draws.draw(rng, not_of=first.term)
        found = self.diagnose([first, second], rng)
        right = all(any(is_named(one, some, self.size(one)) for some in found) for one in (first, second))
        return _note("pair", right, [first, second], found)

    def sound(self, rng: Any) -> bool:
        """Whether a sound log has no finding."""
        found = self.diagnose([], rng)
        return _note("sound", not found, [], found)


def _note(what: str, right: bool, wrongs: Sequence[Wrong], found: Sequence[MappingFinding]) -> bool:
    if not right or os.environ.get("VERBOSE"):
        mistakes = " + ".join(str(wrong)[:100] for wrong in wrongs)
        texts = " | ".join(f"{one.evidence:.0f} {one.text[:100]}" for one in found)
        print(
            f"{what} {'named' if right else 'MISSED'}: {mistakes} -> {texts or 'nothing'}", file=sys.stderr, flush=True
        )
    return right


def _row(task: str, repeat: int) -> Row:
    trials, sound, single, pair = Trials(task), 0, 0, 0
    for number in range(COUNT):
        sound += trials.sound(np.random.default_rng(SEED + number))
        single += trials.single(np.random.default_rng(SEED + 1000 + number))
        pair += trials.pair(np.random.default_rng(SEED + 2000 + number))
    return Row(
        f"diagnose {task}",
        f"{single} of {COUNT} single, {pair} of {COUNT} pairs",
        f"{COUNT - sound} of {COUNT} sound logs with a finding",
        f"{np.median(trials.times):.2g} s, at most {max(trials.times):.2g} s",
        f">= {SINGLES:.0%}, >= {PAIRS:.0%}, 0",
        single >= SINGLES * COUNT and pair >= PAIRS * COUNT and sound == COUNT,
        "logs of 3 to 60 s; mistakes in the closed loop or in the log alone; processor time of a diagnosis",
    )


reach = partial(_row, "reach")
quadruped = partial(_row, "quadruped")
gear_arm = partial(_row, "gear-arm")
walk = partial(_row, "walk")
