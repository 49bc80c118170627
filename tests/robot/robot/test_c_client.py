"""The C client of examples/cpp with the exported controller of reach: the same success as `rlctl eval`."""

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
def test_the_c_controller_controls_the_robot_as_eval_does(rlctl, tmp_path):
    (tmp_path / "limits.yaml").write_text("max_age_periods: 4\n")  # no bounds: the delay of 3 periods is not too old
    done = rlctl(
        *("export", "reach", "--pretrained", "--controller", "--c", "--limits", "limits.yaml", "-o", "controller.c")
    )
    assert done.returncode == 0, done.stderr
    sources = [EXAMPLE / "robot_client.c", tmp_path / "controller.c"]
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
    tested = rlctl("robot", "reach", "--pretrained", "--controller", "--episodes", "20", "--port", port,
                   "--json", "robot.json", "--fault", "delay=0.05", "--fault", "nan=hand",
                   "--min-success", "0.3")  # fmt: skip
    program.join()
    assert tested.returncode == 0, tested.stderr
    assert said[0].returncode == 0, said[0].stderr
    assert said[0].stdout == "7200 measurements answered\n"  # 20 episodes of 120 steps, three times
    report = json.loads((tmp_path / "robot.json").read_text())
    healthy, delayed, _ = report["scores"]
    for score in (healthy, delayed):  # by rounding to float32 [rad]
        assert max(difference["largest"] for difference in score["differences"]) < 1e-6
    done = rlctl("eval", "reach", "--pretrained", "--episodes", "20", "--json", "-")
    assert healthy["success_rate"] == json.loads(done.stdout)["success_rate"]
    # A late target is no late step: the joint goes to the same place.
    assert delayed["held"] == 20 * 3
    missed = rlctl("robot", "reach", "--timeout", "0.2", "--port", port)
    assert missed.returncode == 1
    assert missed.stderr.splitlines()[-1].startswith("error: no program has connected for 0.2 s; ")
