"""A policy that fails on a robot that acts late: a log says how late, and training on from there needs fewer steps."""

import numpy as np
import pytest

from rlctl.environments.spec import EnvChanges, EnvSpec
from rlctl.evaluation.eval_request import EvalRequest
from rlctl.evaluation.evaluate import measure_score
from rlctl.launching.train import run_training
from rlctl.runs.train_request import TrainRequest
from rlctl_robot.identify.excite import write_excitation
from rlctl_robot.identify.follow import describe_expected, open_world
from rlctl_robot.identify.identify import identify
from rlctl_robot.identify.log import Log, read_log, write_log
from tests.training.comparing import rows

DELAY = 4  # control steps, 67 ms; the policy was trained without any
STEPS = 38_400
FINE_TUNING = {  # over the task's recipe, as in docs/deploy.md
    "algo_kwargs": {"n_steps": 20, "n_epochs": 10},
    "eval": {"every_steps": 6_400},
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


def train(root, settings, policy=None):
    request = TrainRequest(
        "reach", settings=settings, root=root, initial_policy=policy and str(policy.path), check=False
    )
    return run_training(request).run


def measure_success(run, events):
    """Return the success of a run's best policy in 100 episodes that no training has seen."""
    request = EvalRequest(str(run.path), seed=1000, changes=EnvChanges(events=events))
    return measure_score(request).success


@pytest.mark.slow
def test_a_delay_beyond_the_range_of_the_event_is_found(tmp_path):
    found = identify(EnvSpec("reach"), write_real_log(tmp_path, 8), events=["action_delay"], n_workers=1)
    assert (found.delay, found.delay_known) == (8, True)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_policy_is_trained_on_with_the_delay_of_a_log(tmp_path):
    events = identify(EnvSpec("reach"), write_real_log(tmp_path), events=["action_delay"], n_workers=1).events()
    assert events == {"action_delay": {"steps": [DELAY, DELAY]}}
    source = train(tmp_path / "source", {"seed": 1})
    assert measure_success(source, {}) > 0.95
    assert measure_success(source, events) < 0.6
    tuned = train(tmp_path / "tuned", {**FINE_TUNING, "events": events}, policy=source)
    new = train(tmp_path / "new", {"events": events, "eval": {"every_steps": 20_000}})
    evaluations = {int(row["steps"]): float(row["success"]) for row in rows(new.evals_file)}
    assert max(evaluations.values()) > 0.9  # it can be learned
    assert max(evaluations) > 3 * STEPS
    assert measure_success(tuned, events) > 0.9
    after_as_many = min(step for step in evaluations if step >= STEPS)
    assert evaluations[after_as_many] < 0.9
