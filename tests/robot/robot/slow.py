"""A task whose simulation is slower than the clock; loaded by path."""

import time
from dataclasses import dataclass

from tests.task.tasks import Slider


@dataclass
class SlowSlider(Slider):
    """Takes 0.12 s for each step of 0.1 s."""

    def act(self, action):
        """Take long."""
        time.sleep(0.12)
        super().act(action)
