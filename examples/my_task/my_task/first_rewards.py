"""`rlctl first-rewards TASK`: a command of a plugin."""

from typing import Annotated

from rlctl.arguments import command
from rlctl.options import Json, Option, TaskName


@command
def first_rewards(
    task: TaskName,
    episodes: Annotated[int, Option("How many episodes to begin.", min=1, max=1000)] = 5,
    json: Json = None,
) -> None:
    """Print the reward of the first step of several episodes, in which the robot does nothing."""
    import numpy as np  # here, so that `rlctl --help` and completion stay fast

    import rlctl
    from rlctl import output

    env = rlctl.make(task)
    try:
        found = []
        for seed in range(episodes):
            env.reset(seed=seed)
            action = np.zeros(env.action_space.shape, env.action_space.dtype)
            found.append(float(env.step(action)[1]))
    finally:
        env.close()
    if output.present({"task": task, "rewards": found}, json):
        return
    for seed, reward in enumerate(found):
        output.out().print(f"seed {seed}: {reward:.4g}")
