"""An environment that gets stuck, for good, where a file `stuck` says so."""

import re
import time
from pathlib import Path

from tests.training.envs import Line

FILE = Path(__file__)


class Stuck(Line):
    """Stands still in its second episode's fourth step; every worker that does appends to `stuck.log`."""

    episodes = 0

    def reset(self, *, seed=None, options=None):
        self.episodes += 1
        return super().reset(seed=seed, options=options)

    def step(self, action):
        if self.episodes == 2 and self.steps == 3 and Path("stuck").exists():
            how = Path("stuck").read_text()
            with Path("stuck.log").open("a") as file:
                file.write(f"{how}\n")
            if how == "asleep":
                time.sleep(1e6)
            if how == "busy":
                while True:
                    pass
            re.match("(a+)+$", "a" * 100 + "b")  # holds Python's lock for ever, in practice
        return super().step(action)
