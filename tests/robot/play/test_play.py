"""`rlctl play` without a browser: what a person does on the page happens in the simulation."""

import json
import urllib.error
import urllib.request
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from rlctl.engine import MUJOCO
from rlctl.errors import TaskError, UsageError
from rlctl.play.episode import load_episode
from rlctl.replaying.drawable import make_drawable
from rlctl.replaying.replay_request import ReplayRequest
from rlctl.replaying.sources import PolicySource, load_located
from rlctl_robot.play.controls import Controls
from rlctl_robot.play.page_server import PageServer
from rlctl_robot.play.play import Game
from tests.evaluation.conftest import write_run
from tests.robot.play.pages import play


@pytest.mark.slow
def test_a_walker_follows_commands_pushes_and_the_clock():
    with play("walk") as (page, results):
        first = page.wait_for(lambda frame: frame["time"] > 0.1)
        assert first["commands"] == {"lin_vel_x": 0.0, "lin_vel_y": 0.0, "ang_vel_z": 0.0}
        assert page.about["commands"]["lin_vel_x"] == {"low": -0.5, "high": 1.0, "unit": "m/s", "centers": True}
        assert page.about["robot"] == "Unitree A1"
        assert len(first["poses"]) % 7 == 0
        assert max(part["link"] for part in page.about["parts"]) < len(first["poses"]) / 7
        page.send(commands={"lin_vel_x": 0.8, "ang_vel_z": 99.0})
        walking = page.wait_for(lambda frame: frame["commands"]["lin_vel_x"] == 0.8)
        assert walking["commands"]["ang_vel_z"] == 0.8  # its highest
        further = page.wait_for(lambda frame: frame["time"] > walking["time"] + 0.8)
        assert np.hypot(*np.subtract(further["center"], walking["center"])[:2]) > 0.2
        page.send(paused=True)
        paused = page.wait_for(lambda frame: frame["paused"])
        assert page.wait_for(lambda frame: True)["time"] == paused["time"]
        page.send(paused=False, speed=0.1, friction=0.2, push=[0.0, 1.0])
        slow = page.wait_for(lambda frame: frame["speed"] == 0.1)
        assert not slow["paused"]
        seed = page.about["seed"]
        page.send(reset=True)
        page.wait_for(lambda frame: frame["time"] < paused["time"])
        assert page.about["seed"] != seed
        page.wait_for(lambda frame: frame["commands"]["lin_vel_x"] == 0.8)  # velocities stay
    assert results[0].episodes == 2


@pytest.mark.slow
def test_a_clip_is_played_to_its_end_and_begins_again_and_a_push_acts_while_it_runs():
    with play("quadruped-bow") as (page, results):
        page.send(speed=2.0)
        for passed in (2.0, 4.0):  # a wait has a limit, and other programs may run
            page.wait_for(lambda frame, passed=passed: frame["time"] > passed)
        ended = page.wait_for(lambda frame: frame["state"] == "ended")
        assert ended["time"] == pytest.approx(5.4)  # a robot begins with the clip, in any episode
        again = page.wait_for(lambda frame: not frame["state"])
        assert again["time"] == 0.0
        page.send(push=[0.0, 1.0])
        pushed = page.wait_for(lambda frame: frame["center"][1] > again["center"][1] + 0.02)
        assert pushed["time"] < 1.0
    assert results[0].episodes == 2


def test_a_goal_is_moved_and_recorded(tmp_path):
    with play("reach", sim=MUJOCO, output=tmp_path) as (page, results):
        page.wait_for(lambda frame: True)
        page.send(record=True)
        page.wait_for(lambda frame: frame["recording"])
        page.send(commands={"goal_x": 0.5, "goal_y": -0.3, "goal_z": 5.0}, push=[1.0, 0.0])
        moved = page.wait_for(lambda frame: frame["commands"]["goal_y"] == -0.3)
        assert moved["markers"]["goal"] == [0.5, -0.3, 0.6]
        page.wait_for(lambda frame: frame["time"] > moved["time"] + 0.3)
        page.send(record=False)
        written = page.wait_for(lambda frame: frame["written"])
        assert written["commands"]["goal_y"] != -0.3  # a new episode has a new goal
    recording = tmp_path / "000000.rrd"
    assert results[0].recordings == [recording]
    episode = load_episode(recording.with_suffix(".npz"))
    assert episode.info.steered
    assert episode.info.policy.endswith(", steered by a person")
    hand, to_goal = episode.observations[-1, 14:17], episode.observations[-1, 17:]
    assert hand + to_goal == pytest.approx([0.5, -0.3, 0.6], abs=1e-6)
    with pytest.raises(
        UsageError, match=r"^.*000000.npz: a person steered this episode, so its seed and actions do not"
    ):
        load_located(recording.with_suffix(".npz"))


def test_what_was_recorded_before_an_error_is_written(tmp_path):
    run = write_run(tmp_path / "run", f"{Path(__file__).with_name('envs.py')}:Breaks")
    source = PolicySource(ReplayRequest(str(run.path), sim=MUJOCO, output=tmp_path / "films"))
    controls = Controls(record=True)
    server = PageServer(0, controls)
    server.start()
    with closing(make_drawable(source.spec)) as env, pytest.raises(TaskError, match="it broke"):
        Game(env, source.spec, source, controls, server).play(0)
    server.close()
    episode = load_episode(tmp_path / "films/000000.npz")
    assert len(episode.rewards) == 10
    assert (tmp_path / "films/000000.rrd").stat().st_size > 0


@pytest.mark.parametrize(
    ("message", "problem"),
    [
        ('{"speed": 100}', "speed: Input should be less than or equal to 2"),
        ('{"commands": {"lin_vel_x": NaN}}', "commands.lin_vel_x: Input should be a finite number"),
        ('{"comands": {}}', "comands: Extra inputs are not permitted"),
        (
            '{"commands": {"lin_vel_q": 1}}',
            "commands: no command 'lin_vel_q'. Did you mean 'lin_vel_x'? There is: lin_vel_x.",
        ),
        ("[", "Invalid JSON: EOF while parsing a list at line 1 column 1"),
    ],
)
def test_what_the_page_cannot_ask_for(message, problem):
    server = PageServer(0, Controls())
    server.describe({"commands": {"lin_vel_x": {}}})
    assert server._read(message) == problem


def test_other_sites_cannot_steer():
    server = PageServer(0, Controls())
    address = server.start()

    def get(**headers):
        request = urllib.request.Request(address, headers=headers)
        try:
            with urllib.request.urlopen(request, timeout=10) as answer:
                return answer.status, answer.read().decode()
        except urllib.error.HTTPError as error:
            return error.code, json.loads(error.read())["error"]

    assert get()[1].startswith("<!doctype html>")
    assert get(Host="elsewhere.example") == (403, "this server answers to localhost only")
    assert get(Origin="http://elsewhere.example") == (403, "requests from other sites are refused")
    port = int(address.rstrip("/").rpartition(":")[2])
    with pytest.raises(UsageError, match=rf"^--port {port}: .*; --port 0 takes any free port$"):
        PageServer(port, Controls()).start()
    server.close()
