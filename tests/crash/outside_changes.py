"""What somebody, or something, does to a run's folder and to the clock while a training goes on."""

import datetime
import functools
import itertools
import os
import shutil
import time

from rlctl.runs.directory import RunDirectory


def begin(what, after=0, until=None):
    """Do what `what` names when the checkpoint of step `after` is saved, and undo it at the boundary of `until`."""
    if what in CLOCKS:
        CLOCKS[what]()
        return
    from rlctl.training import checkpoints

    original = checkpoints.Checkpoints.save

    @functools.wraps(original)
    def save(saver):
        step = saver._learner.steps
        if until is not None and step >= until:
            _broken.clear()
        saved = original(saver)
        if step == after:
            CHANGES[what](RunDirectory(saver.metrics.path.parent))
        return saved

    checkpoints.Checkpoints.save = save


def edited(file, change):
    file.write_bytes(change(file.read_bytes()))


def replaced_latest(run):
    link = run.path.parents[1] / "latest"
    link.unlink()
    link.mkdir()
    (link / "mine").write_text("")


_broken = []


def broken(number):
    """Let no operation on the disk succeed that changes it."""

    def begin(_):
        from rlctl.storage import files

        if not isinstance(files.os, _Unwilling):
            files.os = _Unwilling(files.os)
        _broken.append(number)

    return begin


class _Unwilling:
    def __init__(self, system):
        self._system = system

    def __getattr__(self, name):
        if _broken and name in ("open", "write", "ftruncate", "replace", "rename", "unlink", "makedirs"):
            return self._refuse
        return getattr(self._system, name)

    def _refuse(self, *_, **__):
        raise OSError(_broken[0], os.strerror(_broken[0]))


CHANGES = {
    "run removed": lambda run: shutil.rmtree(run.path),
    "all runs removed": lambda run: shutil.rmtree(run.path.parents[1]),
    "lock removed": lambda run: (run.path / ".lock").unlink(),
    "checkpoints removed": lambda run: shutil.rmtree(run.path / "checkpoints"),
    "episodes removed": lambda run: shutil.rmtree(run.episodes),
    "metrics removed": lambda run: run.metrics_file.unlink(),
    "metrics emptied": lambda run: edited(run.metrics_file, lambda content: b""),
    "metrics longer": lambda run: edited(run.metrics_file, lambda content: content + b"a note, by hand\n"),
    "metrics sorted out": lambda run: edited(run.metrics_file, lambda content: content.replace(b",", b";")),
    "evals removed": lambda run: run.evals_file.unlink(),
    "tensorboard removed": lambda run: shutil.rmtree(run.tensorboard),
    "event file removed": lambda run: [file.unlink() for file in run.tensorboard.iterdir()],
    "latest replaced": replaced_latest,
    "read-only": broken(30),  # EROFS
    "full": broken(28),  # ENOSPC
}


def jumping(*hours):
    """Let the clock jump by some hours each time that somebody looks at it; clocks that only count go on."""

    def begin():
        jumps = itertools.cycle(hours)
        now, now_ns, today = time.time, time.time_ns, datetime.datetime

        class Jumping(datetime.datetime):
            @classmethod
            def now(cls, zone=None):
                return today.now(zone) + datetime.timedelta(hours=next(jumps))

        time.time = lambda: now() + 3600 * next(jumps)
        time.time_ns = lambda: now_ns() + 3600 * 10**9 * next(jumps)
        datetime.datetime = Jumping

    return begin


CLOCKS = {"clock back": jumping(-5), "clock forth": jumping(5), "clock jumps": jumping(0, -30, 7, 500, -2)}
