"""A policy that fails on a robot that acts late: a log says how late, and training on from there needs fewer steps."""

import numpy as np
import pytest

from rlctl.deploy.identify.excite import write_excitation
from rlctl.deploy.identify.follow import describe_expected, open_world
from rlctl.deploy.identify.identify import identify
from rlctl.deploy.identify.log import Log, read_log, write_log
from rlctl.env_spec import EnvSpec
from rlctl.train.request import TrainRequest, run_training
from tests.train.comparing import rows

DELAY = 5  # control steps, 83 ms; the policy was trained without any
STEPS = 30_720
RECIPE = {  # of both trainings, and of docs/deploy.md
    "algo_kwargs": {"learning_rate": 1.2e-3, "n_steps": 20},
    "eval": {"every_steps": 10_240, "episodes": 50},
    "total_timesteps": STEPS,
}


def write_real_log(folder, delay=DELAY):
    """Write what the arm does where every action comes `delay` steps late."""
    excited = write_excitation(EnvSpec("reach"), folder / "excite.csv", seconds=4.0, seed=0)
    env = open_world(EnvSpec("reach"))
    try:
        expected = describe_expected(env, "reach")
        actions = read_log(excited.path, expected).actions
        env.reset(seed=0)
        arm, measured = env.sim.body("arm"), []
        for late in np.concatenate([np.zeros((delay, 7)), actions[:-delay]]):
            measured.append([arm.joint_positions.copy(), arm.joint_velocities.copy()])
            env.task.act(late.astype(np.float32))
            env.sim.step()
    finally:
        env.close()
    write_log(folder / "real.csv", Log(expected.driven, actions, *np.array(measured).transpose(1, 0, 2)), expected)
    return folder / "real.csv"


def train(root, events, policy=None):
    """Return success and return by step of a training where `events` act."""
    settings = {**RECIPE, "events": events, "seed": 1}
    run = run_training(TrainRequest("reach", settings=settings, root=root, initial_policy=policy)).run
    return {int(row["steps"]): (float(row["success"]), float(row["return"])) for row in rows(run.evals_file)}


@pytest.mark.slow
def test_a_delay_beyond_the_range_of_the_event_is_found(tmp_path):
    found = identify(EnvSpec("reach"), write_real_log(tmp_path, 8), events=["action_delay"], n_workers=1)
    assert (found.delay, found.delay_known) == (8, True)


@pytest.mark.slow
def test_a_policy_is_trained_on_with_the_delay_of_a_log(tmp_path):
    events = identify(EnvSpec("reach"), write_real_log(tmp_path), events=["action_delay"], n_workers=1).events()
    assert events == {"action_delay": {"steps": [DELAY, DELAY]}}
    tuned = train(tmp_path / "tuned", events, policy="reach")
    new = train(tmp_path / "new", events)
    success, begun = tuned[0]
    assert success < 0.6
    # Success alone is noisy: the hand swings about the goal, near the tolerance. Seeds end between 50 and 90 %.
    assert max(each for _, each in tuned.values()) > begun + 5
    assert max(each for _, each in new.values()) < begun
    assert max(each for each, _ in tuned.values()) > max(each for each, _ in new.values()) + 0.2
