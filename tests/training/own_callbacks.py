"""Callbacks as a user writes them, good and bad."""

import os
import signal
import threading
import time

import numpy as np

import rlctl


class Adaptive(rlctl.Callback):
    """Changes the learning rate by what it has counted, and keeps state of several kinds."""

    def __init__(self, rate=1e-3, stop_after=None):
        self.rate, self.stop_after = rate, stop_after
        self.lengths, self.sums = [], {"reward": np.zeros(2)}
        self._moments = []

    def on_start(self, training):
        self._moments.append(("start", training.steps))
        self.rate = 0.5 * self.rate  # a resume restores the rate afterwards
        training.set_parameter("learning_rate", self.rate)
        training.log("evaluated", None)

    def on_segment(self, training):
        self.lengths += [episode.length for episode in training.episodes]
        self.sums["reward"] += training.segment.reward.sum()
        self.rate *= 0.9 if len(self.lengths) % 2 else 0.8
        training.set_parameter("learning_rate", self.rate)
        training.log("lengths", sum(self.lengths))
        if self.stop_after and training.steps >= self.stop_after:
            training.stop("enough")

    def on_evaluation(self, training):
        training.log("evaluated", training.evaluation["return"])

    def on_checkpoint(self, training):
        assert training.folder.is_dir()
        assert next(training.policy.parameters()).numel()

    def on_end(self, training):
        (training.folder / "end.txt").write_text(repr(self.lengths))


class Unsaved(rlctl.Callback):
    def on_start(self, training):
        self.window = {1, 2}


class Raises(rlctl.Callback):
    def __init__(self, moment="on_segment", step=64):
        setattr(self, moment, self._fail)
        self._step = step

    def _fail(self, training):
        if training.steps >= self._step:
            raise KeyError("bonus")


class NeverReturns(rlctl.Callback):
    def on_segment(self, training):
        threading.Timer(0.2, os.kill, [os.getpid(), signal.SIGINT]).start()
        while training.steps >= 64:
            time.sleep(0.01)


class WrongParameter(rlctl.Callback):
    def on_start(self, training):
        training.set_parameter("gamma", 0.5)


def make_nothing():
    return None
