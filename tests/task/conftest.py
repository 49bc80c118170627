import pytest

from rlctl.task.env import TaskEnv
from rlctl.task.events import EventSettings


@pytest.fixture
def make():
    """Build the environment of a task, with changes of its events; closed at the end."""
    made = []

    def build(task, randomize=False, **changes):
        made.append(TaskEnv(task, events=EventSettings(randomize, changes)))
        return made[-1]

    yield build
    for env in made:
        env.close()
