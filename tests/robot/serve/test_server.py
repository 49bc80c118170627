"""The policy server: its protocol, orders, limits, watchdog, and another policy without a gap."""

import hashlib
import json
import threading
import time

import msgpack
import numpy as np
import pytest

from rlctl.errors import ArtifactError, PolicyError, UsageError
from rlctl.play.remote import PolicyClient
from rlctl.policy.numpy_actor import NumpyActor
from rlctl_robot.serve.serve import make_server
from rlctl_robot.serve.serve_request import ServeRequest
from tests.robot.serve.serving import (
    FLAT,
    OBSERVATION,
    RunningServer,
    describe_env,
    write_policy,
    write_recurrent_policy,
)


@pytest.fixture
def serve(tmp_path):
    servers = []

    def start(file=None, limits=None, watchdog=False, **settings):
        if limits is not None:
            (tmp_path / "limits.yaml").write_text(limits)
            settings["limits"] = tmp_path / "limits.yaml"
        file = file or write_policy(tmp_path / "policy.safetensors")
        servers.append(RunningServer(file, watchdog=watchdog, **settings))
        return servers[-1]

    yield start
    for server in servers:
        server.close()


def test_the_protocol(serve):
    server = serve()
    with server.client() as client:
        assert client.metadata["observation"] == {"positions": [2], "goal": [3]}
        assert client.metadata["control_dt"] == 0.1
        answer = client.ask({"observation": FLAT})
        assert answer["actions"].tolist() == [[6.0, 1.0]]  # 1 + 2 + 3 and the first
        assert answer["state"] == "running"
        assert answer["server_timing"].keys() == {"infer_ms"}
        other_order = {"goal": [1, 2, 3], "positions": np.zeros(2)}
        answer = client.ask(other_order)
        assert answer["actions"].tolist() == [[6.0, 1.0]]
        assert answer["server_timing"].keys() == {"infer_ms", "prev_total_ms"}
        assert client.ask({"observation": OBSERVATION})["actions"].tolist() == [[6.0, 1.0]]


@pytest.mark.parametrize(
    ("request_", "error"),
    [
        ({"positions": [0, 0]}, "observation names missing: goal"),
        ({**OBSERVATION, "gaol": 1}, "observation names unknown: gaol (Did you mean 'goal'?)"),
        ({**OBSERVATION, "observation": FLAT}, "observation names unknown: observation"),
        ({"observation": FLAT[:3]}, "observation 'observation' has shape (3,), the policy takes (5,)"),
        ({**OBSERVATION, "goal": "near"}, "observation 'goal' is not an array of numbers"),
        ({**OBSERVATION, "goal": [[1], [2, 3]]}, "observation 'goal' is not an array of numbers"),
        ({**OBSERVATION, "age_s": "old"}, "age_s is old, not a number of seconds"),
        ({**OBSERVATION, "age_s": 1e300}, "age_s is 1e+300, not a number of seconds"),
        ({**OBSERVATION, "reset": np.array([True, False])}, "reset is array([ True, False]), not true or false"),
        (["positions"], "a request is a map"),
    ],
)
def test_what_is_not_an_observation_gets_the_safe_action(serve, request_, error):
    with serve(limits="safe_action: [0.5, -0.5]").client() as client:
        answer = client.ask(request_)
        assert error in answer["error"]
        assert answer["actions"].tolist() == [[0.5, -0.5]]
        assert answer["state"] == "holding"
        assert client.ask(OBSERVATION)["state"] == "running"


def pack_array(dtype="<f8", shape=(1,)):
    array = {b"__ndarray__": True, b"data": b"\0" * 8, b"dtype": dtype, b"shape": shape}
    return msgpack.packb({"a": array})


@pytest.mark.parametrize(
    ("content", "error"),
    [
        (b"\xc1", "not msgpack"),
        (b"", "not msgpack"),
        (b"\x82\xa1a\x01\xa1a\x02", "key a is given twice"),
        (pack_array("|O"), "unsupported array dtype |O"),
        (pack_array("|V8"), "unsupported array dtype |V8"),
        (pack_array("<c8"), "unsupported array dtype <c8"),
        (pack_array(shape=[2**60]), "the data of an array does not have shape "),
        (pack_array(shape=[[1]]), "the data of an array does not have shape [[1]] and dtype float64"),
        (pack_array(shape=None), "the data of an array does not have shape None"),
    ],
)
def test_what_is_not_a_message_gets_a_text_frame(serve, content, error):
    with serve().client() as client:
        with pytest.raises(PolicyError) as problem:
            client.send(content)
        assert error in str(problem.value)
        assert client.ask(OBSERVATION)["actions"].tolist() == [[6.0, 1.0]]


def test_json_for_curl(serve):
    server = serve()
    status, text = server.post("/act", OBSERVATION)
    assert (status, json.loads(text)["actions"]) == (200, [[6.0, 1.0]])
    status, text = server.post("/act", b'{"goal": [1, 2, 3], "goal": [1, 2, 3]}')
    assert (status, json.loads(text)["error"]) == (400, "key goal is given twice")
    status, text = server.post("/act", {"goal": [1, 2, float("nan")], "positions": [0, 0]})
    assert (status, json.loads(text)["state"], json.loads(text)["reason"]) == (200, "holding", "goal[2] not finite")
    assert server.post("/act", b"{")[0] == 400
    assert server.post("/act", b" " * 1_000_000)[0] == 413
    assert server.get("/healthz") == (200, "OK\n")
    assert json.loads(server.get("/metadata")[1])["task"] == "test"


def test_metrics(serve):
    server = serve(limits="limits: {all: {action: [-2, 2]}}")
    with server.client() as client:
        for _ in range(3):
            client.ask(OBSERVATION)
        text = server.get("/metrics")[1]
        live = json.loads(server.get("/live")[1])
    samples = dict(line.rsplit(" ", 1) for line in text.splitlines() if not line.startswith("#"))
    assert samples["rlctl_request_seconds_count"] == "3"
    assert samples['rlctl_interventions_total{name="action[0].action"}'] == "3"
    assert samples['rlctl_state{state="running"}'] == "1"
    assert float(samples["rlctl_action_spread"]) == pytest.approx(np.exp(-1.0))
    assert float(samples["rlctl_process_resident_memory_bytes"]) > 1e7
    assert live["clients"][0]["action"] == [2.0, 1.0]
    assert "<canvas" in server.get("/")[1]


def test_a_key(serve, tmp_path, monkeypatch):
    (tmp_path / "key").write_text("secret\n")
    server = serve(key_file=tmp_path / "key")
    assert server.get("/healthz")[0] == 200
    assert server.get("/metadata")[0] == 401
    assert server.post("/stop", headers={"Authorization": "Api-Key wrong"})[0] == 401
    assert server.get("/metadata", headers={"Authorization": "Api-Key secret"})[0] == 200
    with pytest.raises(UsageError, match="no policy server answers"):
        PolicyClient(f"ws://{server.address}")
    monkeypatch.setenv("RLCTL_API_KEY", "secret")
    with server.client() as client:
        assert client.ask(OBSERVATION)["state"] == "running"


def test_an_unknown_path_is_refused_and_orders_are_no_suggestions(serve):
    server = serve()
    status, text = server.post("/resme")
    assert (status, json.loads(text)["error"]) == (404, "POST /resme: Not Found.")
    assert server.get("/stop")[0] == 405


def test_pages_of_other_sites_are_refused(serve):
    server = serve()
    assert server.post("/stop", headers={"Origin": "http://evil.example"})[0] == 403
    assert server.get("/metadata", headers={"Host": "evil.example"})[0] == 403
    assert server.post("/stop", headers={"Origin": f"http://{server.address}"})[0] == 200


def test_others_reach_a_server_with_a_key_only(tmp_path):
    file = write_policy(tmp_path / "policy.safetensors")
    with pytest.raises(UsageError, match="set a key"):
        make_server(file, ServeRequest(host="0.0.0.0"))
    with pytest.raises(ArtifactError, match="no such file"):
        make_server(file, ServeRequest(host="0.0.0.0", key_file=tmp_path / "none"))


def test_a_port_in_use(serve):
    first = serve()
    server = make_server(first.server.policy.file, ServeRequest(port=first.port))
    import asyncio

    from rlctl_robot.serve.serve import run_server

    with pytest.raises(UsageError, match=f"--port {first.port}: .* in use; --port 0 takes any free port"):
        asyncio.run(asyncio.to_thread(run_server, server, print))


def test_the_watchdog(serve, tmp_path):
    file = write_policy(tmp_path / "quick.safetensors", env=describe_env(control_dt=0.02))
    server = serve(file, watchdog=True, log=tmp_path / "log.jsonl")
    with server.client() as client:
        assert client.ask(OBSERVATION)["state"] == "running"
        time.sleep(0.2)  # ten periods
        answer = client.ask(OBSERVATION)
        assert answer["state"] == "stopped"
        assert "watchdog: no observation for" in answer["reason"]
        assert answer["actions"].tolist() == [[0.0, 0.0]]
        assert client.ask({**OBSERVATION, "reset": True})["state"] == "running"
        time.sleep(0.2)  # silent after a request that began an episode
        assert client.ask(OBSERVATION)["state"] == "stopped"
        server.post("/stop")  # now a person has stopped it
        assert client.ask({**OBSERVATION, "reset": True})["reason"] == "stop ordered"
    lines = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert ("state", "stopped") in [(line["kind"], line.get("name")) for line in lines]
    assert lines[0]["kind"] == "started"
    assert lines[0]["sha256"] == hashlib.sha256(file.read_bytes()).hexdigest()


def test_orders_are_for_all_clients_also_later_ones(serve):
    server = serve(
        limits="{command: position, measured: {position: positions}, home: [0.5, 0.5], limits: {all: {speed: 1}}}"
    )
    with server.client() as one:
        assert one.ask(OBSERVATION)["actions"] == pytest.approx(np.array([[0.2, 0.3]]))  # 1 rad/s from 0.1 and 0.2
        assert json.loads(server.post("/stop")[1])["order"] == "stop"
        assert one.ask({**OBSERVATION, "reset": True})["reason"] == "stop ordered"
        with server.client() as two:
            assert two.ask(OBSERVATION)["state"] == "stopped"
            server.post("/home")
            for _ in range(6):
                answer = two.ask(OBSERVATION)
            assert answer["actions"] == pytest.approx(np.array([[0.5, 0.5]]))
            assert answer["state"] == "holding"
            server.post("/resume")
            assert {one.ask(OBSERVATION)["state"], two.ask(OBSERVATION)["state"]} == {"running"}


def test_actions_by_hand(serve):
    server = serve()
    assert json.loads(server.post("/home")[1])["error"].startswith("the limits define no home")
    with server.client() as client:
        client.ask(OBSERVATION)
        status, text = server.post("/override", {"action": [1, -1]})
        assert (status, json.loads(text)) == (200, {"overridden": True})
        assert client.ask({**OBSERVATION, "reset": True})["actions"].tolist() == [[1.0, -1.0]]
        with server.client() as later:
            assert later.ask(OBSERVATION)["actions"].tolist() == [[1.0, -1.0]]
        bounded = json.loads(server.post("/override", {"action": [1000, -1]})[1])
        assert bounded == {"overridden": True, "limited_to": [client.ask(OBSERVATION)["actions"][0, 0], -1.0]}
        for wrong in ({"action": [1]}, {"act": 1}, {"action": "up"}, [1, 2], {"action": [1e400, 0]}):
            assert server.post("/override", wrong)[0] == 400
        assert server.post("/override", {"action": None})[0] == 200
        assert client.ask(OBSERVATION)["actions"].tolist() == [[6.0, 1.0]]


def test_another_policy_without_a_gap(serve, tmp_path):
    server = serve()
    other = write_policy(tmp_path / "other.safetensors", factor=-1.0)
    seen, end = [], threading.Event()

    def act():
        with server.client() as client:
            while not end.is_set():
                seen.append(client.ask(OBSERVATION)["actions"].tolist()[0])

    thread = threading.Thread(target=act)
    thread.start()
    try:
        other_names = describe_env(sizes={"goal": 3, "positions": 2})
        refused = [
            server.post("/policy", b"{}"),
            server.post("/policy", other.read_bytes()[:-1]),
            server.post("/policy", write_policy(tmp_path / "x.safetensors", env=other_names).read_bytes()),
        ]
        for name in ("%00.safetensors", "%F0%9F%A4%96" * 90 + ".safetensors"):
            refused.append(server.post(f"/policy?name={name}", other.read_bytes()[:-1]))
        before = len(seen)
        status, text = server.post("/policy?name=other.safetensors", other.read_bytes())
        while len(seen) < before + 20:
            time.sleep(0.01)
    finally:
        end.set()
        thread.join()
    assert [code for code, _ in refused] == [422] * 5
    for name in ("x.safetensors", "x.onnx"):
        status_of_junk, answer = server.post(f"/policy?name={name}", b"junk")
        assert status_of_junk == 422
        assert json.loads(answer)["error"].startswith(f"{name}: ")
    assert (
        "its observations are in the order goal, positions, the served policy's in"
        in json.loads(refused[2][1])["error"]
    )
    assert (status, json.loads(text)["policy"]) == (200, "other.safetensors")
    changes = [index for index in range(1, len(seen)) if seen[index] != seen[index - 1]]
    assert len(changes) == 1  # never a mixture, and never back
    assert (seen[0], seen[-1]) == ([6.0, 1.0], [-6.0, -1.0])


def test_each_connection_is_an_episode(serve, tmp_path):
    server = serve(write_recurrent_policy(tmp_path / "recurrent.safetensors"))
    with server.client() as one, server.client() as two:
        first = [one.ask(OBSERVATION)["actions"].tolist() for _ in range(3)]
        assert first[0] != first[1] != first[2]
        assert [two.ask(OBSERVATION)["actions"].tolist() for _ in range(3)] == first
        assert one.ask({**OBSERVATION, "reset": True})["actions"].tolist() == first[0]


def test_a_file_that_is_not_a_policy(tmp_path):
    (tmp_path / "policy.onnx").write_bytes(b"onnx")
    with pytest.raises(ArtifactError, match="damaged, or not an ONNX file"):
        make_server(tmp_path / "policy.onnx", ServeRequest())


def test_a_key_file_that_is_no_text(tmp_path):
    (tmp_path / "key").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ArtifactError, match="not a key: it is no text"):
        make_server(write_policy(tmp_path / "policy.safetensors"), ServeRequest(key_file=tmp_path / "key"))


def test_an_order_is_no_suggestion(serve):
    server = serve()
    assert "Did you mean" not in server.post("/nope")[1]


def test_the_robot_holds_whatever_the_policy_raises(serve, monkeypatch):
    server = serve()

    def fail(self, observations, rows):
        raise RuntimeError("out of memory")

    with server.client() as client:
        client.ask({"observation": FLAT})
        monkeypatch.setattr(NumpyActor, "act", fail)
        answer = client.ask({"observation": FLAT})
    assert answer["error"] == "the policy cannot act: out of memory"
