"""The public client of openpi's policy server acts through ours, in an interpreter of its own."""

import json
import subprocess
import venv

import pytest

from tests.robot.serve.serving import RunningServer, write_policy

CLIENT = """
import json, sys
import numpy as np
from openpi_client.websocket_client_policy import WebsocketClientPolicy

client = WebsocketClientPolicy(host="127.0.0.1", port=int(sys.argv[1]), api_key=sys.argv[2])
observation = {"positions": np.array([0.1, 0.2]), "goal": np.array([1, 2, 3])}
answers = [client.infer(observation) for _ in range(3)]
try:
    client.infer({"positions": np.array([1j])})
    refused = ""
except (RuntimeError, ValueError) as error:
    refused = str(error)
print(json.dumps({
    "metadata": client.get_server_metadata()["observation"],
    "actions": [answer["actions"].tolist() for answer in answers],
    "timing": sorted(answers[-1]["server_timing"]),
    "refused": refused,
}))
"""


@pytest.mark.slow
def test_it_acts_through_our_server(tmp_path):
    venv.create(tmp_path / "venv", with_pip=True)
    python = tmp_path / "venv" / "bin" / "python"
    installed = subprocess.run(
        [python, "-m", "pip", "install", "-q", "openpi-client==0.1.2", "typing-extensions"],
        capture_output=True,
        text=True,
    )
    if installed.returncode != 0:
        pytest.skip(f"openpi-client cannot be installed here: {installed.stderr.splitlines()[-1:]}")
    (tmp_path / "key").write_text("secret")
    file = write_policy(tmp_path / "policy.safetensors")
    server = RunningServer(file, watchdog=False, key_file=tmp_path / "key")
    try:
        done = subprocess.run(
            [python, "-c", CLIENT, str(server.port), "secret"], capture_output=True, text=True, timeout=250
        )
    finally:
        server.close()
    assert done.returncode == 0, done.stderr
    content = json.loads(done.stdout)
    assert content["metadata"] == {"positions": [2], "goal": [3]}
    assert content["actions"] == [[[6.0, 1.0]]] * 3
    assert content["timing"] == ["infer_ms", "prev_total_ms"]
    assert content["refused"].startswith("Unsupported dtype")
