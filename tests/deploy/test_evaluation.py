"""What limits cost a policy in simulation, and a policy played through its server."""

import json

import pytest

from rlctl.errors import RecipeError, UsageError
from rlctl.eval.evaluate import EvalRequest, Gates, run_evaluation
from rlctl.eval.report import as_json, count_interventions
from rlctl.eval.self_test import run_self_test
from rlctl.run.shipped import PRETRAINED
from tests.deploy.serving import RunningServer

STEP = "command: step\nscale: 0.03\nmeasured: {position: joint_positions}\n"


@pytest.fixture(scope="module")
def reach_server(tmp_path_factory):
    from rlctl.run.lookup import find_policy

    server = RunningServer(find_policy("reach", PRETRAINED).file, watchdog=False)
    yield server
    server.close()


def evaluate(tmp_path, text, **options):
    (tmp_path / "limits.yaml").write_text(text)
    request = EvalRequest(
        "reach", checkpoint=PRETRAINED, episodes=2, n_envs=1, limits=tmp_path / "limits.yaml", **options
    )
    return run_evaluation(request, Gates())


def test_what_limits_cost(tmp_path):
    result = evaluate(tmp_path, STEP + "limits: {all: {speed: 0.02}}")  # [rad/s]: it gets nowhere
    assert result.unlimited is not None
    assert result.unlimited.returns.mean > result.returns.mean + 10
    assert (result.unlimited.success_rate, result.success_rate) == (1.0, 0.0)
    counts = count_interventions(result)
    assert {name.partition(".")[2] for name in counts} == {"speed"}
    content = as_json(result)["limits"]
    assert content["success_rate_without"] == 1.0
    assert content["interventions"] == counts


def test_limits_that_never_step_in_cost_nothing(tmp_path):
    result = evaluate(tmp_path, STEP + "limits: {all: {speed: 100, position: [-9, 9]}}")
    assert result.unlimited is not None
    assert result.returns == result.unlimited.returns
    assert not count_interventions(result)


def test_limits_that_the_task_cannot_have(tmp_path):
    with pytest.raises(RecipeError, match=r"no observation 'joints'\. .*joint_positions"):
        evaluate(tmp_path, "sensors: {joints: {range: [0, 1]}}")


def test_through_a_server_it_is_the_same(reach_server):
    direct = run_evaluation(EvalRequest("reach", checkpoint=PRETRAINED, episodes=2, n_envs=1), Gates())
    served = run_evaluation(
        EvalRequest("reach", baseline=f"ws://{reach_server.address}", episodes=2, n_envs=1), Gates()
    )
    assert [each.result.total_reward for each in served.episodes] == [
        each.result.total_reward for each in direct.episodes
    ]
    assert len(served.episodes[0].result.report["round_trips_s"]) == served.episodes[0].result.length


def test_a_server_that_does_not_run_its_policy_is_said_to(reach_server, rlctl):
    reach_server.post("/stop")
    try:
        done = rlctl("eval", "reach", "--policy", f"ws://{reach_server.address}", "--episodes", 1)
    finally:
        reach_server.post("/resume")
    assert "the server was holding or stopped in 120 of 120 answers: not the policy's own" in done.stdout


def test_a_server_that_is_not_there_or_of_another_task(reach_server):
    with pytest.raises(UsageError, match="no policy server answers"):
        run_evaluation(EvalRequest("reach", baseline="ws://127.0.0.1:1"), Gates())
    with pytest.raises(UsageError, match="is for other spaces than this task has"):
        run_evaluation(EvalRequest("Pendulum-v1", baseline=f"ws://{reach_server.address}", episodes=1), Gates())


def test_self_test(tmp_path):
    from rlctl.deploy.serve import ServerSettings, make_server
    from rlctl.run.lookup import find_policy

    server = make_server(find_policy("reach", PRETRAINED).file, ServerSettings(port=0, watchdog=False))
    result = run_self_test(server, EvalRequest("reach", checkpoint=PRETRAINED, episodes=2, n_envs=1))
    assert result.served.returns == result.direct.returns
    assert result.requests == sum(each.result.length for each in result.served.episodes)
    assert result.round_trip_p50_s > 0
    assert [each for each in result.list_problems() if "success" in each or "holding" in each] == []


@pytest.mark.slow
def test_self_test_of_an_exported_policy(rlctl, tmp_path):
    assert rlctl("export", "reach", "--pretrained", "--onnx", "-o", "policy.onnx").returncode == 0
    done = rlctl("serve", "policy.onnx", "--self-test", "--episodes", 10, "--json", "-", timeout=300)
    content = json.loads(done.stdout)
    assert content["served"]["success_rate"] == content["direct"]["success_rate"] == 1.0
    assert (done.returncode == 0) == (content["problems"] == [])
