"""The C client of examples/cpp with the exported policy of reach: the same success as `rlctl eval`."""

import json
import shutil
import socket
import subprocess
import threading
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[3] / "examples" / "cpp"


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_the_c_policy_controls_the_robot_as_eval_does(rlctl, tmp_path):
    done = rlctl("export", "reach", "--pretrained", "--c", "-o", "policy.c")
    assert done.returncode == 0, done.stderr
    sources = [EXAMPLE / "robot_client.c", tmp_path / "policy.c"]
    strict = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
    client = tmp_path / "robot_client"
    subprocess.run(["cc", *strict, f"-I{EXAMPLE}", f"-I{tmp_path}", *sources, "-lm", "-o", client], check=True)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    said = []
    program = threading.Thread(
        target=lambda: said.append(subprocess.run([client, port], capture_output=True, text=True, timeout=120))
    )
    program.start()  # before the robot: it repeats its hello
    tested = rlctl("robot", "reach", "--pretrained", "--episodes", "20", "--port", port, "--json", "robot.json",
                   "--fault", "delay=0.05", "--fault", "nan=hand", "--min-success", "0.3")  # fmt: skip
    program.join()
    assert tested.returncode == 0, tested.stderr
    assert said[0].returncode == 0, said[0].stderr
    assert said[0].stdout == "7200 observations answered\n"  # 20 episodes of 120 steps, three times
    report = json.loads((tmp_path / "robot.json").read_text())
    healthy, delayed, _ = report["scores"]
    assert max(difference["largest"] for difference in healthy["differences"]) < 1e-5
    for score, settings in ((healthy, []), (delayed, ["--set", "events.action_delay.steps=[3,3]"])):
        done = rlctl("eval", "reach", "--pretrained", "--episodes", "20", "--json", "-", *settings)
        evaluated = json.loads(done.stdout)
        assert score["success_rate"] == evaluated["success_rate"]
    missed = rlctl("robot", "reach", "--timeout", "0.2", "--port", port)
    assert missed.returncode == 1
    assert missed.stderr.splitlines()[-1].startswith("error: no program has connected for 0.2 s; ")
