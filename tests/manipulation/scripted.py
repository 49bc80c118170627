"""Episodes played by a script that reads the task itself."""

import numpy as np

from rlctl.task.env import TaskEnv
from rlctl.task.events import EventSettings


def play(env, seed, script, steps):
    """Return all observations and rewards, shape (T + 1, size + 1), and the last info; `script` maps task to action."""
    rows, info = [np.append(env.reset(seed=seed)[0], 0.0)], {}
    for _ in range(steps):
        observation, reward, _, _, info = env.step(script(env.task))
        rows.append(np.append(observation, reward))
    return np.array(rows), info


def assert_episodes_repeat(task, script, steps, randomize):
    """Compare, bit for bit, episodes of a world in which others were played before with those of a fresh one."""
    dirty, fresh = (TaskEnv(task(), events=EventSettings(randomize)) for _ in range(2))
    play(dirty, 100, script, steps)
    for seed in range(2):
        np.testing.assert_array_equal(play(dirty, seed, script, steps)[0], play(fresh, seed, script, steps)[0])
    dirty.close()
    fresh.close()
