"""`rlctl serve` as a process: its start, signals, and what is wrong with its arguments."""

import json
import os
import re
import signal
import subprocess
import sys
import time
import urllib.request

import pytest

from rlctl.errors import RlctlError
from rlctl_robot.serve.serve import make_server
from rlctl_robot.serve.serve_request import ServeRequest
from tests.robot.serve.serving import write_policy


@pytest.fixture
def served(tmp_path):
    file = write_policy(tmp_path / "policy.safetensors")
    process = subprocess.Popen(
        [sys.executable, "-m", "rlctl", "serve", file, "--port", "0", "--log", "log.jsonl"],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    line = process.stdout.readline()
    yield process, file, line.rpartition("http://")[2].strip()
    process.kill()
    process.communicate()


def read_metadata(address):
    with urllib.request.urlopen(f"http://{address}metadata", timeout=120) as answer:
        return json.load(answer)


@pytest.mark.slow
def test_signals(served):
    process, file, address = served
    assert read_metadata(address)["training_steps"] == 0
    content = file.read_bytes()
    file.write_bytes(content[:-1])
    process.send_signal(signal.SIGHUP)
    assert "no --limits FILE" in process.stderr.readline()
    assert "the policy was not changed" in process.stderr.readline()
    file.write_bytes(content)
    process.send_signal(signal.SIGHUP)
    assert "reloaded" in process.stderr.readline()
    assert read_metadata(address)["policy"] == "policy.safetensors"
    process.send_signal(signal.SIGTERM)
    assert process.wait(120) == 0
    last = process.stderr.read().splitlines()[-1]
    assert re.fullmatch(r"served 0 answers in \d+ s: 0 connections, 0 interventions of limits and faults", last)
    assert "policy refused" in (file.parent / "log.jsonl").read_text()


@pytest.mark.parametrize(
    ("settings", "code", "error"),
    [
        ({"host": "0.0.0.0"}, 2, "set a key"),
        ({"limits": "limits.yaml"}, 2, "or one of: action[0], action[1]."),
        ({"log": "policy.safetensors/log"}, 5, "the log cannot be written"),
    ],
)
def test_errors(tmp_path, monkeypatch, settings, code, error):
    monkeypatch.delenv("RLCTL_API_KEY", raising=False)
    file = write_policy(tmp_path / "policy.safetensors")
    (tmp_path / "limits.yaml").write_text("limits: {elbo: {action: [0, 1]}}")
    paths = {key: value if key == "host" else tmp_path / value for key, value in settings.items()}
    with pytest.raises(RlctlError) as problem:
        make_server(file, ServeRequest(**paths))
    assert problem.value.exit_code == code
    assert error in str(problem.value)


@pytest.mark.slow_except(first=1)
@pytest.mark.parametrize("options", [[], ["--self-test"]])
def test_without_the_extra(rlctl, tmp_path, options):
    write_policy(tmp_path / "policy.safetensors")
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "aiohttp.py").write_text("raise ModuleNotFoundError(name='aiohttp')")
    done = rlctl("serve", "policy.safetensors", *options, path=tmp_path / "site")
    assert done.returncode == 2
    assert "rlctl serve needs aiohttp: pip install 'rlctl[serve]'\n" in done.stderr


@pytest.mark.slow
def test_starts_without_what_takes_long_to_import(tmp_path):
    file = write_policy(tmp_path / "policy.safetensors")
    code = (
        "import pathlib, sys\n"
        "from rlctl_robot.serve.serve_request import ServeRequest\n"
        "from rlctl_robot.serve.serve import make_server\n"
        "from rlctl_robot.serve.routes import Routes\n"
        "from rlctl_robot.serve.routes import Connections\n"
        f"Routes(make_server(pathlib.Path({str(file)!r}), ServeRequest()), Connections(100)).make_app()\n"
        "print(*sorted({name.partition('.')[0] for name in sys.modules}))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert "aiohttp" in loaded
    assert not loaded & {"torch", "stable_baselines3", "scipy", "pybullet", "onnxruntime", "rerun", "typer"}


@pytest.mark.slow
def test_the_page(served, tmp_path):
    """The live page in headless Chromium shows the state and the curves' legends."""
    import shutil

    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no Chromium here")
    _, _, address = served
    body = json.dumps({"observation": [0.1, 0.2, 1, 2, 3]}).encode()
    urllib.request.urlopen(urllib.request.Request(f"http://{address}act", body), timeout=120).close()
    time.sleep(0.5)  # longer than the watchdog waits
    done = subprocess.run(
        [browser, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'browser'}",
         "--virtual-time-budget=2000", "--dump-dom", f"http://{address}"],
        capture_output=True, text=True, timeout=120, env=os.environ,
    )  # fmt: skip
    assert "stopped" in done.stdout
    assert "watchdog: no observation" in done.stdout
    assert "action[0] 6.00" in done.stdout
