"""The phases of a training, each by a function that is called in it: where a trial sends itself signals."""

import itertools
import os
import signal

import psutil

import rlctl.play.workers
import rlctl.storage.files
import rlctl.training.evaluator
import rlctl.training.loop
import rlctl.training.rollouts
import rlctl.training.status
from rlctl.processes import child_process

PHASES = {
    "workers start": (child_process, "start_process", 1),
    "workers build": (rlctl.play.workers.Workers, "info", 1),
    "run folder": (rlctl.training.status, "write_start", 1),
    "first rollout": (rlctl.training.rollouts.WorkerVecEnv, "finish", 1),
    "boundary": (rlctl.training.loop.TrainingLoop, "boundary", 2),
    "evaluation": (rlctl.training.evaluator.EvaluationEpisodes, "play", 1),
    "first checkpoint": (rlctl.storage.files, "os.rename", 1),
    "checkpoint": (rlctl.storage.files, "os.rename", 2),
    "evaluated checkpoint": (rlctl.storage.files, "os.rename", 4),
    "final evaluation": (rlctl.training.evaluator.EvaluationEpisodes, "play", 2),
    "the end": (rlctl.training.loop.TrainingLoop, "boundary", 4),
    "last checkpoint": (rlctl.storage.files, "os.rename", 6),
    "done": (rlctl.training.status, "write_end", 1),
}
"""Phase -> the function that is in it, and which call of it.

Each checkpoint is renamed into its place; after all but the first, the one before is renamed aside, to be removed.
"""


def first_of_two(number):
    """Return another signal than `number`: equal ones within a second are one."""
    return signal.SIGTERM if number == signal.SIGINT else signal.SIGINT


def send(number, phase, everybody=False, again=False):
    """Send a signal at the start of a phase, to this process or to all below it too; with `again` after another one.

    To all is what a service manager does, as the machine or the job of a cluster ends.
    """
    owner, path, call = PHASES[phase]
    *parts, name = path.split(".")
    for part in parts:
        owner = getattr(owner, part)
    original, counter = getattr(owner, name), itertools.count(1)

    def called(*arguments, **options):
        if next(counter) == call:
            for sent in [first_of_two(number), number] if again else [number]:
                for each in psutil.Process().children(recursive=True) if everybody else ():
                    each.send_signal(sent)
                os.kill(os.getpid(), sent)
        return original.fget(*arguments) if isinstance(original, property) else original(*arguments, **options)

    setattr(owner, name, property(called) if isinstance(original, property) else called)
