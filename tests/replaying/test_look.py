"""`rlctl replay TASK --policy ...`: a task before any training."""

import subprocess
import sys
import textwrap

import pytest

from rlctl.environments.spec import EnvSpec
from rlctl.errors import PolicyError, UsageError
from rlctl.play.episode import load_episode
from rlctl.replaying.look import Motion, WorldSummary
from rlctl.replaying.look_table import list_findings
from rlctl.replaying.replay import run_replay
from rlctl.replaying.replay_request import ReplayRequest
from rlctl.replaying.sources import TaskSource
from rlctl.replaying.window import open_window, show_episodes
from tests.replaying.conftest import ENVS, as_json
from tests.replaying.reading import column
from tests.runs.test_listing import on_terminal

TUMBLE = f"{ENVS}:Tumble"


@pytest.fixture
def functions(write_module):
    source = """
        def act(observation): return [1.0]
        def ramp(observation, step): return [step / 100]
        def breaks(observation, step): return [1.0] if step < 3 else [1.0, 2.0]
    """
    return write_module("functions.py", source)


@pytest.mark.slow
@pytest.mark.pybullet
def test_it_records_and_reports_without_a_run(replay, tmp_path):
    done = replay(TUMBLE, "--policy", "zero")
    assert done.returncode == 0, done.stderr
    heading, names, *lines = done.stdout.splitlines()
    assert heading == f"{TUMBLE}: zero, randomised by mass, grip"
    assert names.split() == ["body", "kg", "base", "joints", "height", "m", "lowest", "highest", "end", "tilt", "deg"]
    assert lines[0] == "ground      0  fixed"
    assert lines[1].startswith("cube      0.1  free              0.400   0.0")
    assert lines[2].startswith("car     5.892  free        6     0.100 ")
    assert "\nbody  link               touches  from step  mm deep\n" in done.stdout
    assert "\ncube drops from 0.400 to 0.0" in done.stdout
    assert lines[-2:] == [
        "open with: rerun Tumble-zero.rrd",
        "without a display, in a browser: rerun --serve-web Tumble-zero.rrd",
    ]
    assert {file.name for file in tmp_path.iterdir()} == {"Tumble-zero.rrd", "Tumble-zero.npz"}


@pytest.mark.slow
@pytest.mark.pybullet
def test_a_narrow_terminal_has_fewer_columns(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shown = on_terminal("replay", TUMBLE, "--policy", "zero", columns=60).splitlines()
    tables = [line for line in shown if line.startswith(("body", "cube  ", "car  "))]
    assert "max speed" not in "".join(tables)
    assert max(map(len, tables)) <= 60


@pytest.mark.slow
@pytest.mark.pybullet
def test_the_recording_has_the_actions_of_the_function(functions, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (episode,) = run_replay(ReplayRequest(TUMBLE, baseline="functions.py:ramp")).episodes
    actions = column(episode.recording, "/action")[1]
    assert episode.recording.name == "Tumble-ramp.rrd"
    assert actions[:3, 0] == pytest.approx([0.0, 0.01, 0.02])
    assert load_episode(episode.episode).info.policy == "functions.py:ramp"
    assert run_replay(ReplayRequest(None, verify=episode.episode)).verification.difference is None


@pytest.mark.slow
@pytest.mark.pybullet
def test_a_look_replaces_the_last_one_of_the_same_policy(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    request = ReplayRequest(TUMBLE, baseline="random", episodes=2)
    names = [episode.recording.name for episode in run_replay(request).episodes]
    assert names == ["Tumble-random.rrd", "Tumble-random-2.rrd"]
    assert [episode.recording.name for episode in run_replay(request).episodes] == names
    first, second = run_replay(ReplayRequest(TUMBLE, baseline="random", episodes=2, output=tmp_path / "out")).episodes
    assert [first.recording.name, second.recording.name] == ["000000.rrd", "000001.rrd"]


@pytest.mark.slow
@pytest.mark.pybullet
def test_as_json_it_has_what_the_tables_have(replay):
    world = as_json(replay(TUMBLE, "--policy", "zero", "--json", "-"))["world"]
    assert [body["name"] for body in world["bodies"]] == ["ground", "cube", "car"]
    assert world["bodies"][2]["joints"][0].keys() >= {"name", "unit", "low", "high", "start", "max_force", "max_speed"}
    cube = next(motion for motion in world["motions"] if motion["body"] == "cube")
    assert cube["start"] == pytest.approx(0.4)
    assert cube["dropped_at"] > 5
    assert {"body": "cube", "other": "ground"}.items() <= next(
        c for c in world["contacts"] if c["body"] == "cube"
    ).items()


@pytest.mark.slow
def test_settings_and_choices_apply(tmp_path):
    request = ReplayRequest("reach", baseline="zero", settings=["task.tolerance=2"], output=tmp_path / "a.rrd")
    (episode,) = run_replay(request).episodes
    assert episode.success is True
    worst = run_replay(ReplayRequest("reach", baseline="random", episodes=3, worst=1, output=tmp_path / "b.rrd"))
    assert worst.choice == "the worst of 3 episodes, of which 0 succeeded (seed 0)"


@pytest.mark.slow
@pytest.mark.pybullet
def test_a_film(tmp_path):
    result = run_replay(ReplayRequest(TUMBLE, baseline="zero", video=tmp_path / "look.gif"))
    assert result.film.file.is_file()
    assert [body.name for body in result.world.bodies] == ["ground", "cube", "car"]


@pytest.mark.pybullet
def test_a_window_shows_it_and_the_world_is_summarised():
    source = TaskSource(ReplayRequest(TUMBLE, baseline="zero"), "zero")
    env = source.spec.make()  # there is no display, and a window is drawn by the environment itself
    show_episodes(env, source.spec, source.seeds, lambda seed: source.begin(env, seed), watch=source.watch)
    env.close()
    assert source.report([]).world.bodies[1].name == "cube"


@pytest.mark.pybullet
def test_without_a_display_a_window_is_an_error_of_one_line(replay):
    for task in (TUMBLE, f"{ENVS}:Pixels"):
        done = replay(task, "--policy", "zero", "--gui")
        assert done.returncode == 2
        (line,) = done.stderr.splitlines()
        assert "DISPLAY is not set; leave out --gui" in line


def test_an_environment_without_a_window(monkeypatch):
    monkeypatch.setenv("DISPLAY", ":99")
    with pytest.raises(UsageError, match=r"^--gui: no window: .*:Blind takes no render_mode; leave out --gui"):
        open_window(EnvSpec(f"{ENVS}:Blind"))


def test_an_environment_that_is_not_simulated(tmp_path, capsys):
    result = run_replay(ReplayRequest(f"{ENVS}:Pixels", baseline="random", output=tmp_path / "a.rrd"))
    assert result.world is None
    assert "bodies and joints are unknown: it simulates with neither PyBullet nor MuJoCo" in capsys.readouterr().err


def test_an_episode_without_an_end_is_cut(tmp_path, capsys, write_module):
    file = write_module(
        "endless.py",
        """
        import gymnasium, numpy as np
        class Endless(gymnasium.Env):
            action_space = observation_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
            def reset(self, *, seed=None, options=None): return np.zeros(1, np.float32), {}
            def step(self, action): return np.zeros(1, np.float32), 0.0, False, False, {}
        """,
    )
    request = ReplayRequest(f"{file}:Endless", baseline="zero", output=tmp_path / "a.rrd")
    assert run_replay(request).episodes[0].length == 1000
    assert "cut after 1,000 steps, because no time limit is known" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.pybullet
def test_an_error_of_the_function_is_one_line_with_the_step(replay, functions):
    done = replay(TUMBLE, "--policy", f"{functions}:breaks")
    assert done.returncode == PolicyError.exit_code
    assert done.stderr == (
        "error: policy functions.py:breaks, step 3: it returned shape (2,), expected (1,): [1.0, 2.0]; "
        "the action space is Box(-1.0, 1.0, (1,), float32)\n"
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"source": None}, "--policy zero: give the task to play: rlctl replay reach --policy zero"),
        ({"source": "latest"}, "--policy zero plays a task, and latest is a run: leave out --policy, or name its task"),
        ({"source": "a.npz"}, "--policy zero plays a task, and a.npz is a file: leave out --policy, or name its task"),
        ({"checkpoint": "last"}, "--policy zero plays a task, not a run: leave out --checkpoint and --pretrained"),
        ({"task": "ant"}, "--policy zero plays a task, not a run: leave out --task"),
        ({"source": None, "verify": "a.npz"}, "--verify replays only a.npz: leave out --policy zero"),
    ],
)
def test_what_does_not_go_with_it(changes, message):
    with pytest.raises(UsageError) as caught:
        run_replay(ReplayRequest(**({"source": "reach", "baseline": "zero"} | changes)))
    assert str(caught.value).startswith(message)


@pytest.mark.slow
def test_the_folder_of_a_run_is_not_a_task(run):
    with pytest.raises(UsageError, match="is a run: leave out --policy, or name its task: rlctl replay TASK"):
        run_replay(ReplayRequest(str(run.run.path), baseline="zero"))


def test_a_task_without_a_run_is_shown_how_to_look(replay):
    done = replay("robot.py:Robot")
    assert "To see it before a training: rlctl replay robot.py:Robot --policy zero" in done.stderr


@pytest.mark.slow
def test_it_imports_neither_torch_nor_scipy(tmp_path):
    code = """
        import sys
        from rlctl.cli import run
        code = run(["replay", "reach", "--policy", "zero"])
        loaded = [name for name in ("torch", "stable_baselines3", "scipy") if name in sys.modules]
        print(code, loaded, file=sys.stderr)
    """
    command = [sys.executable, "-c", textwrap.dedent(code)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.stderr == "0 []\n"


@pytest.mark.parametrize(("tilt", "line"), [(2.0, "nothing falls"), (43.0, "robot tilts by 43")])
def test_what_tilts_far_is_not_said_to_stand(tilt, line):
    motion = Motion("robot", 0.2, 0.18, 0.2, 0.18, tilt, None, None, None)
    (_, last) = list_findings(WorldSummary(0, [], [], [motion], 0.02))
    assert last.endswith(line)
