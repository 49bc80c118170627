"""What `rlctl serve --rerun` records of a client is diagnosed as any other log."""

import json

import numpy as np
import pytest

from rlctl.cli import run
from rlctl.errors import ArtifactError
from rlctl.policy.shipped import find_shipped_policy
from rlctl_robot.diagnose.recording import read_recording
from rlctl_robot.serve.records import RerunLog
from tests.benchmarks.broken_logs import Robot
from tests.robot.serve.serving import RunningServer

SWAPPED = [0, 1, 2, 4, 3, 5, 6]


def write_recording(file, clients):
    """Write rows of (episode, action, observation `q`) of each client, a second apart."""
    log = RerunLog(file)
    for number, rows in clients.items():
        for second, (episode, action, q) in enumerate(rows):
            for entity, values in (("action", action), ("episode", episode), ("infer_ms", 0.1), ("observation/q", q)):
                if values is not None:
                    log.add(f"client_{number}/{entity}", values, float(second))
    log.close()
    return file


@pytest.mark.slow
def test_rows_client_by_client(tmp_path):
    rows = {3: [(1, [0.1], [1.0, 2.0]), (1, [0.2], None), (2, [0.3], [3.0, 4.0])], 12: [(0, [0.4], [5.0, 6.0])]}
    table = read_recording(write_recording(tmp_path / "served.rrd", rows))
    assert table.windows == (2, 1)
    # The answer to a request without a valid observation is no row.
    assert {name: column.tolist() for name, column in table.columns.items()} == {
        "time": [0.0, 2.0, 0.0],
        "episode": [1.0, 2.0, 0.0],
        "action_0": [0.1, 0.3, 0.4],
        "q_0": [1.0, 3.0, 5.0],
        "q_1": [2.0, 4.0, 6.0],
    }


def test_rows_in_which_the_server_changed_the_action_are_told(tmp_path):
    log = RerunLog(tmp_path / "served.rrd")
    for second, limited in enumerate([0.0, 1.0, 0.0]):
        for entity, values in (("action", [0.1]), ("episode", 0), ("limited", limited), ("observation/q", [1.0])):
            log.add(f"client_1/{entity}", values, float(second))
    log.close()
    table = read_recording(tmp_path / "served.rrd")
    assert table.limited.tolist() == [0.0, 1.0, 0.0]
    assert table.columns.keys() == {"time", "episode", "action_0", "q_0"}


def test_what_is_no_recording(tmp_path):
    (tmp_path / "text.rrd").write_text("time,action\n")
    with pytest.raises(ArtifactError, match=r"text\.rrd: damaged, or no Rerun recording"):
        read_recording(tmp_path / "text.rrd")
    with pytest.raises(ArtifactError, match=r"other\.rrd: no actions with observations in it"):
        read_recording(write_recording(tmp_path / "other.rrd", {1: [(0, [0.1], None)]}))
    with pytest.raises(ArtifactError, match=r"nan\.rrd, row 1, column q_0: nan is not a finite number"):
        read_recording(write_recording(tmp_path / "nan.rrd", {1: [(0, [0.1], [0.0]), (0, [0.1], [np.nan])]}))


def record_through_server(file, order):
    """Play `reach` for 400 steps with a policy server; the client orders the joints' velocities."""
    robot = Robot("reach")
    velocities = np.arange(robot.info.env.spaces()[0].shape[0])[robot.slices["joint_velocities"]]
    server = RunningServer(find_shipped_policy("reach"), watchdog=False, rerun=file)
    try:
        with server.client() as client:
            done = True
            for step in range(400):
                if done:
                    observation, _ = robot.env.reset(seed=step)
                sent = np.array(observation)
                sent[velocities] = sent[velocities[order]]
                answer = client.ask({"observation": sent, "reset": done})
                action = np.asarray(answer["actions"], np.float32)[0]
                observation, _, terminated, truncated, _ = robot.env.step(action)
                done = terminated or truncated
    finally:
        server.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("order", "code", "texts"),
    [(list(range(7)), 0, []), (SWAPPED, 1, ["joint_velocities: elements 3 and 4 are swapped"])],
)
def test_a_client_of_a_policy_server(tmp_path, order, code, texts):
    record_through_server(tmp_path / "served.rrd", order)
    log, result = str(tmp_path / "served.rrd"), tmp_path / "result.json"
    assert run(["diagnose", log, "--policy", "reach", "--pretrained", "--json", str(result)]) == code
    content = json.loads(result.read_text())
    assert content["answers"]["policy_difference"] < 1e-5  # the policy received what the server recorded
    assert content["rows"] == 400
    assert [finding["text"] for finding in content["findings"]] == texts
