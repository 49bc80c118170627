"""Environments that go wrong in every way there is, in the episode of one seed; loaded by path, in workers too."""

import contextlib
import ctypes
import locale
import os
import signal
import subprocess
import sys
import threading
import time
import warnings
from pathlib import Path

import numpy as np
from gymnasium import spaces

from tests.training.envs import Line

STEP = 7


class Unprintable(Exception):
    def __str__(self):
        return f"{1 / 0}"


def unprintable():
    raise Unprintable


def local_class():
    class Local(Exception):
        pass

    raise Local("nobody can import this")


def long_text():
    raise RuntimeError("one line\nand another\n" + "x" * 1_000_000)


def raising(kind, *arguments):
    def fail():
        raise kind(*arguments)

    return fail


def endless():
    while True:
        pass


def recurse(depth=0):
    return recurse(depth + 1) + 1


def kill(number):
    return lambda: os.kill(os.getpid(), number)


# What an environment does of its own accord, and does not come back from.
DOES = {
    "raise": raising(RuntimeError, "the gripper fell off"),
    "unprintable": unprintable,
    "local class": local_class,
    "file name": raising(ValueError, "cannot open caf\udce9.stl"),
    "long text": long_text,
    "interrupt": raising(KeyboardInterrupt),
    "exit": lambda: sys.exit(0),
    "generator exit": raising(GeneratorExit),
    "recursion": recurse,
    "memory": raising(MemoryError),
    "_exit": lambda: os._exit(0),
    "segfault": lambda: ctypes.string_at(0),
    "abort": os.abort,
    "out of memory": kill(signal.SIGKILL),
    "stopped": kill(signal.SIGSTOP),
    "endless": endless,
    "sleep": lambda: time.sleep(600),
    "closes files": lambda: os.closerange(3, 100),
}

# What it returns instead of (observation, reward, terminated, truncated, info).
RETURNS = {
    "nan reward": lambda o, r, t, u, i: (o, float("nan"), t, u, i),
    "inf reward": lambda o, r, t, u, i: (o, np.float32("inf"), t, u, i),
    "no reward": lambda o, r, t, u, i: (o, None, t, u, i),
    "text reward": lambda o, r, t, u, i: (o, "1.0", t, u, i),
    "two rewards": lambda o, r, t, u, i: (o, np.ones(2), t, u, i),
    "nan observation": lambda o, r, t, u, i: (o * np.nan, r, t, u, i),
    "shape": lambda o, r, t, u, i: (np.zeros(2, np.float32), r, t, u, i),
    "no observation": lambda o, r, t, u, i: (None, r, t, u, i),
    "objects": lambda o, r, t, u, i: (np.array([{}]), r, t, u, i),
    "nothing": lambda *_: None,
    "old gym": lambda o, r, t, u, i: (o, r, t or u, i),
    "no info": lambda o, r, t, u, i: (o, r, t, u, None),
    "text flag": lambda o, r, t, u, i: (o, r, "False", u, i),
    "text term": lambda o, r, t, u, i: (o, r, t, u, {"reward_terms": {"speed": "fast"}}),
    "term list": lambda o, r, t, u, i: (o, r, t, u, {"reward_terms": [1.0]}),
    "text success": lambda o, r, t, u, i: (o, r, True, u, {"is_success": "yes"}),
    "nan success": lambda o, r, t, u, i: (o, r, True, u, {"is_success": float("nan")}),
}


class Faulty(Line):
    """Does or returns what `fault` names at step 7 of the episode with `faulty_seed`, or `at_reset`."""

    def __init__(self, fault="raise", faulty_seed=7, at_reset=False):
        super().__init__()
        self.fault = "" if "MENDED" in os.environ else fault
        self.faulty_seed, self.at_reset = faulty_seed, at_reset

    def reset(self, *, seed=None, options=None):
        self.faulty = seed == self.faulty_seed
        if self.faulty and self.at_reset and self.fault:
            DOES[self.fault]()
        return super().reset(seed=seed)

    def step(self, action):
        returned = super().step(action)
        if not self.faulty or self.at_reset or self.steps != STEP:
            return returned
        if self.fault in DOES:
            DOES[self.fault]()
        return RETURNS[self.fault](*returned) if self.fault in RETURNS else returned


class FaultyDict(Faulty):
    """The same, observed as a dictionary."""

    def __init__(self, **parameters):
        super().__init__(**parameters)
        self.observation_space = spaces.Dict({"x": self.observation_space})

    def _observation(self):
        return {"x": super()._observation()}


class FaultyDiscrete(Faulty):
    """The same with two actions."""

    def __init__(self, **parameters):
        super().__init__(**parameters)
        self.action_space = spaces.Discrete(2)

    def step(self, action):
        return super().step([2.0 * action - 1.0])


class FaultyStages(Faulty):
    """The same, to be learnt in stages: only the last has the fault."""

    def __init__(self, last=False, **parameters):
        super().__init__(**parameters)
        self.fault = self.fault if last else ""


class Category(Line):
    """Observes one of three categories, and a fourth."""

    def __init__(self):
        super().__init__()
        self.observation_space = spaces.Discrete(3)

    def _observation(self):
        return 3 if self.steps == STEP else 1


class FailsWhenEvaluated(Line):
    """Fails, as `fault` names, in those evaluations that `which` lists; `seed` is of an episode of all of them."""

    def __init__(self, log, which, seed, fault="raise"):
        super().__init__()
        self.log, self.which, self.seed, self.fault = Path(log), which, seed, fault

    def reset(self, *, seed=None, options=None):
        self.faulty = False
        if seed == self.seed:
            with self.log.open("a") as file:
                file.write(".")
            self.faulty = self.log.stat().st_size in self.which and "MENDED" not in os.environ
        return super().reset(seed=seed)

    def step(self, action):
        returned = super().step(action)
        if self.faulty and self.steps == STEP:
            DOES[self.fault]()
        return returned


class Outside(Line):
    """Observes float64, and at the fifth step something that its space has not."""

    def _observation(self):
        return np.array([12.5 if self.steps == 5 else self.x])


def print_much():
    for number in range(20_000):
        print(number, "x" * 80)
    print("y" * 1_000_000)


def print_rubbish():
    rubbish = bytes(range(256)) * 4
    os.write(1, rubbish)
    os.write(2, b"\x1b[2J" + rubbish)


def many_warnings():
    for number in range(2000):
        warnings.warn(f"warning {number}", stacklevel=1)


def wait_for_ever():
    for _ in range(3):
        threading.Thread(target=time.sleep, args=(600,)).start()


def elsewhere():
    os.chdir("/")
    os.umask(0o777)
    sys.path[:] = []
    sys.stdout.close()


def close_stdout():
    with contextlib.suppress(OSError):  # it is closed
        os.close(1)


def handlers():
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: None)


# What is no reason to end a training.
MISBEHAVIOUR = {
    "prints much": print_much,
    "prints rubbish": print_rubbish,
    "warns much": many_warnings,
    "starts threads": wait_for_ever,
    "starts a process": lambda: subprocess.Popen(["sleep", "300.0625"]),
    "sets signal handlers": handlers,
    "changes the locale": lambda: locale.setlocale(locale.LC_ALL, "C"),
    "changes numpy's errors": lambda: np.seterr(all="raise"),
    "goes elsewhere": elsewhere,
    "closes stdout": close_stdout,
}


class Misbehaving(Line):
    """The same as `Line`, which also misbehaves: in all ways, or in that of one name; its values come in odd types."""

    def __init__(self, misbehaviour=None):
        super().__init__()
        self.misbehaviour = list(MISBEHAVIOUR) if misbehaviour is None else [misbehaviour]

    def reset(self, *, seed=None, options=None):
        while self.misbehaviour:
            MISBEHAVIOUR[self.misbehaviour.pop(0)]()
        return super().reset(seed=seed)

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        odd = {"is_success": np.bool_(info["is_success"]), "metrics": {1, 2}, "distance": "far", 3: {np.nan}}
        terms = {"nan": np.nan, "one": np.array([1.0]), ("a", "b"): np.float32(2.0)}
        odd["reward_terms"] = terms
        return observation, np.array([reward]), np.bool_(terminated), np.array([truncated]), odd

    def close(self):
        raise RuntimeError("closed twice")
