"""The phases of a training, each by a function that is called in it: where a trial sends itself signals."""

import itertools
import os

import rlctl.rollout.workers
import rlctl.run.files
import rlctl.train.evaluation
import rlctl.train.loop
import rlctl.train.request
import rlctl.train.status
import rlctl.train.vec_env

PHASES = {
    "workers start": (rlctl.rollout.workers.Workers, "_start", 1),
    "workers build": (rlctl.rollout.workers.Workers, "_wait_until_built", 1),
    "run folder": (rlctl.train.status, "write_start", 1),
    "first rollout": (rlctl.train.vec_env.WorkerVecEnv, "step_wait", 2),
    "boundary": (rlctl.train.loop.TrainingLoop, "boundary", 1),
    "evaluation": (rlctl.train.evaluation._Watched, "act", 3),
    "checkpoint": (rlctl.run.files, "_take_place", 1),
    "second checkpoint": (rlctl.run.files, "_take_place", 2),
    "final evaluation": (rlctl.train.evaluation._Watched, "act", 13),
    "the end": (rlctl.train.loop.TrainingLoop, "finish", 1),
    "last checkpoint": (rlctl.run.files, "_take_place", 3),
    "done": (rlctl.train.status, "write_end", 1),
}
"""Phase -> the function that is in it, and which call of it."""


def send(number, phase, group=False, again=False):
    """Send a signal at the start of a phase, to this process or to all of its group, and once more with `again`."""
    owner, name, call = PHASES[phase]
    original, counter = getattr(owner, name), itertools.count(1)

    def called(*arguments, **options):
        if next(counter) == call:
            for _ in range(2 if again else 1):
                os.killpg(0, number) if group else os.kill(os.getpid(), number)
        return original(*arguments, **options)

    setattr(owner, name, called)
