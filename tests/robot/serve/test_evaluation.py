"""What limits cost a policy in simulation, and a policy played through its server."""

import asyncio
import contextlib
import gc
import json
import threading

import numpy as np
import pytest
from aiohttp import web
from gymnasium import spaces

from rlctl import output
from rlctl.errors import PolicyError, RecipeError, UsageError
from rlctl.evaluation.eval_request import EvalRequest
from rlctl.evaluation.evaluate import run_evaluation
from rlctl.evaluation.report import as_json, count_interventions, show
from rlctl.play import remote_messages as messages
from rlctl.play.remote import PolicyClient, RemoteActor
from rlctl.policy.actor import Rows
from rlctl.policy.shipped import PRETRAINED
from rlctl_robot.serve.self_test import run_self_test
from tests.robot.serve.serving import RunningServer

STEP = "command: step\nscale: 0.03\nmeasured: {position: joint_positions}\n"


@pytest.fixture(scope="module")
def reach_server(tmp_path_factory):
    from rlctl.runs.lookup import find_policy

    server = RunningServer(find_policy("reach", PRETRAINED).file, watchdog=False)
    yield server
    server.close()


def evaluate(tmp_path, text, **options):
    (tmp_path / "limits.yaml").write_text(text)
    request = EvalRequest(
        "reach", checkpoint=PRETRAINED, episodes=2, n_envs=1, limits=tmp_path / "limits.yaml", **options
    )
    return run_evaluation(request)


@pytest.mark.slow
@pytest.mark.pybullet
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


@pytest.mark.slow
@pytest.mark.pybullet
def test_a_wrong_scale_is_noticed_by_how_far_the_joints_move(tmp_path):
    def print_with(text):
        with output.out().capture() as captured:
            show(evaluate(tmp_path, text + "limits: {all: {speed: 100}}"), None)
        return captured.get()

    assert " times as far as commanded: check scale in the limits" in print_with(STEP.replace("0.03", "0.001"))
    assert "as far as commanded" not in print_with(STEP)


@pytest.mark.slow
@pytest.mark.pybullet
def test_limits_that_never_step_in_cost_nothing(tmp_path):
    result = evaluate(tmp_path, STEP + "limits: {all: {speed: 100, position: [-9, 9]}}")
    assert result.unlimited is not None
    assert result.returns == result.unlimited.returns
    assert not count_interventions(result)


@pytest.mark.pybullet
def test_limits_that_the_task_cannot_have(tmp_path):
    with pytest.raises(RecipeError, match=r"no observation 'joints'\. .*joint_positions"):
        evaluate(tmp_path, "sensors: {joints: {range: [0, 1]}}")


@pytest.mark.slow
@pytest.mark.pybullet
def test_through_a_server_it_is_the_same(reach_server):
    direct = run_evaluation(EvalRequest("reach", checkpoint=PRETRAINED, episodes=2, n_envs=1))
    served = run_evaluation(EvalRequest("reach", baseline=f"ws://{reach_server.address}", episodes=2, n_envs=1))
    assert [episode.result.total_reward for episode in served.played] == [
        episode.result.total_reward for episode in direct.played
    ]
    assert len(served.played[0].result.report["round_trips_s"]) == served.played[0].result.length


@pytest.mark.slow
def test_a_server_that_does_not_run_its_policy_is_said_to(reach_server, rlctl):
    reach_server.post("/stop")
    try:
        done = rlctl("eval", "reach", "--policy", f"ws://{reach_server.address}", "--episodes", 1)
    finally:
        reach_server.post("/resume")
    assert "for 120 of 120 answers the server held or stopped instead of running the policy" in done.stdout


@pytest.mark.slow
def test_a_server_that_is_not_there_or_of_another_task(reach_server, capfd):
    with pytest.raises(UsageError, match="no policy server answers"):
        run_evaluation(EvalRequest("reach", baseline="ws://127.0.0.1:1"))
    with pytest.raises(UsageError, match="has other observation or action spaces than this task"):
        run_evaluation(EvalRequest("Pendulum-v1", baseline=f"ws://{reach_server.address}", episodes=1))
    assert "Unclosed" not in capfd.readouterr().err


@pytest.mark.parametrize("actions", [None, 0.5, [], [["left", "right"]], [[0.1], [0.1, 0.2]], [[0.1, 0.2, 0.3]]])
def test_a_server_that_is_not_ours_and_gives_no_action(actions):
    with serve_answer({"env": {}, "control_dt": "10 ms"}, {"actions": actions}) as url:
        actor, row = RemoteActor(url, spaces.Box(-1, 1, (3,)), spaces.Box(-1, 1, (2,))), Rows.one()
        actor.begin(row)
        with pytest.raises(PolicyError, match=r"actions are .*, expected a list of one action, shape \(2,\)$"):
            actor.act(np.zeros((1, 3)), row)
        actor.close()


@contextlib.contextmanager
def serve_answer(metadata, answer):
    """A policy server that gives each request the same answer."""

    async def serve(request):
        connection = web.WebSocketResponse()
        await connection.prepare(request)
        await connection.send_bytes(messages.pack(metadata))
        async for _ in connection:
            await connection.send_bytes(messages.pack(answer))
        return connection

    async def start():
        app = web.Application()
        app.router.add_get("/", serve)
        runner = web.AppRunner(app)
        await runner.setup()
        await web.TCPSite(runner, "127.0.0.1", 0).start()
        return runner

    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    runner = asyncio.run_coroutine_threadsafe(start(), loop).result()
    yield f"ws://127.0.0.1:{runner.addresses[0][1]}"
    asyncio.run_coroutine_threadsafe(runner.cleanup(), loop).result()
    loop.call_soon_threadsafe(loop.stop)
    thread.join()
    loop.close()


@pytest.mark.slow
@pytest.mark.pybullet
def test_self_test(tmp_path):
    from rlctl.runs.lookup import find_policy
    from rlctl_robot.serve.serve import make_server
    from rlctl_robot.serve.serve_request import ServeRequest

    server = make_server(find_policy("reach", PRETRAINED).file, ServeRequest(port=0, watchdog=False))
    result = run_self_test(server, EvalRequest("reach", checkpoint=PRETRAINED, episodes=2, n_envs=1))
    assert result.served.returns == result.direct.returns
    assert result.requests == sum(episode.result.length for episode in result.served.played)
    assert result.round_trip_p50_s > 0
    assert [episode for episode in result.list_problems() if "success" in episode or "holding" in episode] == []


@pytest.mark.slow
def test_self_test_of_an_exported_policy(rlctl, tmp_path):
    assert rlctl("export", "reach", "--pretrained", "--onnx", "-o", "policy.onnx").returncode == 0
    done = rlctl("serve", "policy.onnx", "--self-test", "--episodes", 10, "--json", "-", timeout=300)
    content = json.loads(done.stdout)
    assert content["served"]["success_rate"] == content["direct"]["success_rate"] == 1.0
    assert (done.returncode == 0) == (content["problems"] == [])


def test_a_server_that_greets_with_something_else(caplog):
    with serve_answer(["hello"], {}) as url, pytest.raises(PolicyError, match="the server sent a list, expected a map"):
        PolicyClient(url)
    gc.collect()
    assert "Unclosed" not in caplog.text
