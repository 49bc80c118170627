"""Identification of tasks that remember: the arm of `rlctl tasks new`, whose actions are steps of its last targets."""

import contextlib
import dataclasses

import numpy as np
import pytest

from rlctl.engine import MUJOCO
from rlctl.environments.spec import EnvSpec
from rlctl.errors import AnswerIsNo
from rlctl.task.events import EventSettings
from rlctl.tasks import new
from rlctl_robot.identify.excite import write_excitation
from rlctl_robot.identify.follow import Follower, describe_expected, find_unknowns, open_world
from rlctl_robot.identify.identify import IdentifiedValue, _estimate_values, identify
from rlctl_robot.identify.log import Log, read_log, write_log
from rlctl_robot.identify.search import Fit, _compute_cost, _find_fit, search
from rlctl_robot.identify.targets import read_targets

SPEC = EnvSpec("log-arm/log_arm/task.py:LogArm", sim=MUJOCO)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the starter plugin, and a trajectory for it."""
    folder = tmp_path_factory.mktemp("starter")
    with contextlib.chdir(folder):
        new.create("log-arm")
        write_excitation(SPEC, folder / "excite.csv", seconds=3.0, seed=0)
    return folder


@pytest.fixture
def env(folder, monkeypatch):
    monkeypatch.chdir(folder)
    with contextlib.closing(open_world(SPEC)) as env:
        yield env


@pytest.fixture
def log(env, folder):
    return read_log(folder / "excite.csv", describe_expected(env, SPEC.task))


def play(env, log: Log, mass: float) -> Log:
    """Return what an arm of another mass does, which begins elsewhere than the task does with seed 0."""
    env.set_events(EventSettings(False, {"mass": {"factor": mass}}))
    env.reset(seed=5)
    rows, targets = [], []
    for action in log.actions:
        rows.append([env.task.arm.joint_positions, env.task.arm.joint_velocities])
        targets.append(read_targets(env))
        env.task.act(action.astype(np.float32))
        env.sim.step()
    noise = np.random.default_rng(0).normal(size=(len(rows), 2, 2)) * [[[0.001], [0.02]]]  # [rad], [rad/s]
    positions, velocities = (np.array(rows) + noise).transpose(1, 0, 2)
    return Log(log.joints, log.actions, positions, velocities, np.array(targets))


def fit(env, log: Log) -> tuple[IdentifiedValue, Fit]:
    """Search in this process, which is quicker than to start workers."""
    unknowns = find_unknowns(env.task.events, [], SPEC.task)
    follower = Follower(env, log, unknowns)

    def ask(questions):
        return [_find_fit(follower, each) if each.evaluations else _compute_cost(follower, each) for each in questions]

    fits = search(ask, unknowns, 1.0 / follower.spread, 0, lambda _: None)
    best = min(fits.values(), key=lambda fit: fit.cost)
    return _estimate_values(unknowns, best)[0], best


@pytest.mark.slow
@pytest.mark.parametrize("mass", [pytest.param(1.0, marks=pytest.mark.slow), 1.4])
def test_the_mass_is_found_wherever_the_robot_starts(mass, env, log):
    found, best = fit(env, play(env, log, mass))
    assert found.value == pytest.approx(mass, rel=0.03)
    assert found.low <= mass <= found.high
    assert best.errors[:2].max() < 2 * 0.001


@pytest.mark.slow
def test_the_trajectory_of_the_task_itself_has_its_own_values(env, folder):
    found = identify(SPEC, folder / "excite.csv", n_workers=1)
    (mass,) = found.values
    assert mass.value == pytest.approx(1.0, rel=1e-3)
    assert mass.low <= 1.0 <= mass.high
    assert found.position_error[1] < 1e-6


@pytest.mark.slow
def test_targets_begin_where_the_robot_is_if_the_log_has_none(env, folder, log):
    path, expected = folder / "no_targets.csv", describe_expected(env, SPEC.task)
    write_log(path, dataclasses.replace(log, targets=None), expected)
    assert "target" not in path.read_text()
    found, _ = fit(env, read_log(path, expected))
    assert found.value == pytest.approx(1.0, rel=1e-3)


@pytest.mark.slow
def test_a_log_that_the_task_does_not_explain_gives_no_values(env, folder, log):
    turned = Log(log.joints, -log.actions, log.positions, log.velocities)
    write_log(folder / "turned.csv", turned, describe_expected(env, SPEC.task))
    with pytest.raises(AnswerIsNo, match=r"turned\.csv: the task does not explain this log"):
        identify(SPEC, folder / "turned.csv", n_workers=1)
