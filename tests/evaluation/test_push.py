"""`rlctl eval --push`: the smallest push at which a policy fails."""

import math

import numpy as np
import pytest

from rlctl.environments.spec import EnvSpec
from rlctl.errors import UsageError
from rlctl.evaluation.eval_request import EvalRequest
from rlctl.evaluation.push import find_pushed, find_threshold
from rlctl.evaluation.robustness import read
from rlctl.evaluation.vary import measure_robustness
from tests.evaluation.conftest import ENVS, write_run

pytestmark = pytest.mark.pybullet


def push(run, **request):
    return measure_robustness(EvalRequest(str(run.path), episodes=4, **request), push=True).push


@pytest.mark.slow
def test_the_threshold_by_hand_and_beside_a_map(block_run):
    request = EvalRequest(str(block_run.path), episodes=4)
    vary = measure_robustness(request, ["mass=1:2:2"])
    found = push(block_run)
    # 0.1 kg stop after v^2 / (2 * 0.5 * 9.81 m/s^2) = 0.1 m if v = 0.99 m/s, so the push is 0.099 N s; it slides while
    # it is pushed, 0.1 s long, which takes 0.5 * 0.1 kg * 9.81 m/s^2 * 0.1 s = 0.049 N s more, and some 0.05 m less.
    assert (found.body, found.link, found.mass, found.measure) == ("block", None, pytest.approx(0.1), "success")
    assert 0.1 < found.threshold < 0.15
    assert found.threshold_interval[0] <= found.threshold <= found.threshold_interval[1]
    assert found.verdict.startswith("half of the episodes fail at a push of 0.1")
    assert [level.impulse for level in found.levels] == sorted(level.impulse for level in found.levels)
    assert found.levels[0].held == 1.0
    kept = read(block_run.robustness_file)
    assert kept.push == found
    assert kept.maps == vary.maps


@pytest.mark.slow
def test_without_success_an_early_end_is_a_fall(tmp_path):
    found = push(write_run(tmp_path / "run", f"{ENVS}:Lost"))
    assert found.measure == "upright"
    assert 0.1 < found.threshold < 0.15


@pytest.mark.slow
def test_cannot_tell(block_run, tmp_path):
    from rlctl.environments.spec import EnvChanges

    never = push(block_run, changes=EnvChanges({"limit": 0.0}))
    assert never.threshold is None
    assert never.verdict == "cannot tell: without a push only 0% of the episodes succeed"
    assert len(never.levels) == 1
    always = push(write_run(tmp_path / "run", f"{ENVS}:Lost"), changes=EnvChanges({"limit": math.inf}))
    assert always.verdict == "cannot tell: this task reports no success, and no episode ended early"


def test_trunks_of_robots():
    assert find_pushed(EnvSpec("quadruped")).link is None
    assert find_pushed(EnvSpec("biped")).link == "trunk"
    assert find_pushed(EnvSpec("half-cheetah")).link == "torso"


@pytest.mark.parametrize(
    ("task", "message"),
    [
        ("reach", "reach has no movable base: arm is fixed to the world"),
        ("Pendulum-v1", "Pendulum-v1 is a plain Gymnasium environment"),
    ],
)
def test_nothing_to_push(task, message):
    with pytest.raises(UsageError, match=message):
        find_pushed(EnvSpec(task))


def test_threshold_of_known_rates():
    held = np.array([[True] * 10, [True] * 8 + [False] * 2, [True] * 2 + [False] * 8])
    threshold, (low, high) = find_threshold([0.0, 1.0, 2.0], held)
    # From 0.8 at 1 to 0.2 at 2: half way.
    assert threshold == pytest.approx(1.5)
    assert 0.5 < low < 1.5 < high <= 2.0
    assert find_threshold([0.0, 1.0], held[:2]) == (None, None)
    assert find_threshold([0.0, 1.0], held[1:][::-1]) == (None, None)
