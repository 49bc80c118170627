"""What the code of a step says about its flags."""

import inspect
from pathlib import Path

from rlctl.checking.step_source import read_flags


class Counts:
    steps, limit = 0, 10

    def step(self, action):
        self.steps += 1
        done = bool(action > 2 or self.steps >= self.limit)
        return 0.0, 0.0, done, False, {}


class Truncates(Counts):
    def step(self, action):
        self.steps += 1
        return 0.0, 0.0, action > 2, self.steps >= self.limit, {}


class Compares(Counts):
    def step(self, action):
        self.steps += 1
        return 0.0, 0.0, action >= self.limit, False, {}


def test_a_counter_is_named_with_its_line():
    flags = read_flags(Counts())
    lines, first = inspect.getsourcelines(Counts.step)
    line = first + next(i for i, text in enumerate(lines) if ">=" in text)
    file, number = flags["counter_place"]
    assert (flags["truncation"], flags["counter"]) == ("never", "self.steps >= self.limit")
    assert (Path(file).name, number) == (Path(__file__).name, line)


def test_what_is_no_counter():
    assert read_flags(Truncates()) == {"truncation": "computed"}
    assert read_flags(Compares()) == {"truncation": "never"}
    assert read_flags(object()) == {}
