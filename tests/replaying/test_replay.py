import dataclasses
import json
import shutil

import numpy as np
import pytest

from rlctl.errors import ArtifactError
from rlctl.play.episode import load_episode, save_episode
from rlctl.replaying.replay import run_replay
from rlctl.replaying.replay_request import ReplayRequest
from rlctl.replaying.report import as_json
from rlctl.replaying.reproduce import record_episode
from tests.replaying.conftest import ENVS, play
from tests.replaying.reading import column, layout, properties


def test_rollouts_go_into_the_run_and_are_numbered_on(run):
    before = max((int(file.stem) for file in run.run.episodes.glob("*.npz")), default=-1) + 1
    result = run_replay(ReplayRequest(str(run.run.path), episodes=2))
    names = [f"{number:06d}" for number in (before, before + 1)]
    assert [episode.recording.stem for episode in result.episodes] == names
    first, second = result.episodes
    assert first.seed != second.seed
    assert first.recording.parent == run.run.episodes
    # The list of recordings is open (3: expanded).
    assert layout(second.recording, "PanelBlueprint:state", "/blueprint_panel") == [3]
    recorded = load_episode(first.episode)
    assert recorded.info.seed == first.seed == properties(first.recording)["seed"]
    assert recorded.info.policy == properties(first.recording)["policy"] == "best.safetensors, ppo, step 64"
    np.testing.assert_array_equal(column(first.recording, "/action")[1], recorded.actions)
    assert recorded.info.versions.keys() >= {"rlctl", "pybullet", "torch"}


def test_nothing_is_recorded_through_a_link(run, tmp_path):
    (tmp_path / "precious").mkdir()
    shutil.copytree(run.run.path, tmp_path / "run", ignore=shutil.ignore_patterns("episodes"))
    (tmp_path / "run" / "episodes").symlink_to(tmp_path / "precious")
    with pytest.raises(ArtifactError, match="episodes: a symbolic link out of the run's folder; remove it"):
        run_replay(ReplayRequest(str(tmp_path / "run"), episodes=1))
    assert not [*(tmp_path / "precious").iterdir()]


@pytest.mark.slow
def test_episodes_that_are_there_are_kept(run, tmp_path):
    (tmp_path / "000004.npz").write_bytes(b"of a training, which records few of its episodes")
    (episode,) = run_replay(ReplayRequest(str(run.run.path), output=tmp_path)).episodes
    assert episode.episode == tmp_path / "000005.npz"
    assert (tmp_path / "000004.npz").read_bytes().startswith(b"of a training")


def test_rollout_is_reproduced_bit_for_bit(run, tmp_path):
    (episode,) = run_replay(ReplayRequest(str(run.run.path), seed=3, output=tmp_path)).episodes
    result = run_replay(ReplayRequest(None, verify=episode.episode))
    assert result.verification.difference is None
    result.check()


@pytest.mark.slow
def test_same_seed_same_episodes_and_more_of_them_start_the_same(run, tmp_path):
    def returns(episodes: int, seed: int):
        request = ReplayRequest(str(run.run.path), episodes=episodes, seed=seed, output=tmp_path / "out")
        return [episode.total_reward for episode in run_replay(request).episodes]

    assert returns(2, 0)[:1] == returns(1, 0) != returns(1, 1)


def test_training_records_beside_its_episodes(run):
    (recording,) = run.recordings
    episode = load_episode(recording.with_suffix(".npz"))
    np.testing.assert_array_equal(column(recording, "/action")[1], episode.actions)


@pytest.mark.slow
def test_task_and_parameters_can_be_others(run, tmp_path):
    request = ReplayRequest(str(run.run.path), settings=["task.tolerance=0.9"], output=tmp_path)
    (episode,) = run_replay(request).episodes
    assert episode.success is True
    assert load_episode(episode.episode).info.spec.parameters == {"tolerance": 0.9}
    # A single recording needs no list (1: hidden).
    assert layout(episode.recording, "PanelBlueprint:state", "/blueprint_panel") == [1]


@pytest.mark.slow
def test_command_line_from_a_run_to_the_command_that_opens_it(replay, run, tmp_path):
    done = replay(run.run.path, "-o", "a b.rrd")
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0] == f"reach: {run.run.best_policy} (ppo, step 64), not randomised"
    assert lines[1].startswith("a b.rrd: seed ")
    assert lines[2:] == [
        "open with: rerun 'a b.rrd'",
        "without a display, in a browser: rerun --serve-web 'a b.rrd'",
    ]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a b.npz", "a b.rrd"]


@pytest.mark.slow
def test_result_as_json(run, tmp_path):
    content = as_json(run_replay(ReplayRequest(str(run.run.best_policy), episodes=2, output=tmp_path)))
    files = [tmp_path / name for name in ("000000.rrd", "000001.rrd")]
    assert [episode["file"] for episode in content["episodes"]] == files
    assert content["episodes"][0].keys() == {
        "file",
        "episode",
        "seed",
        "length",
        "return",
        "success",
        "randomized",
        "events",
    }
    assert content["open"] == f"rerun {files[0]} {files[1]}"
    assert content["versions"].keys() >= {"rlctl", "pybullet"}


@pytest.mark.slow
def test_policy_without_a_run_records_into_the_current_folder(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(run.run.best_policy, "policy.safetensors")
    names = [str(run_replay(ReplayRequest("policy.safetensors")).episodes[0].recording) for _ in range(2)]
    assert names == ["episodes/000000.rrd", "episodes/000001.rrd"]


@pytest.mark.slow
@pytest.mark.pybullet
def test_recorded_episode_is_recorded_beside_itself(replay, episode_file, tmp_path):
    own = shutil.copy(episode_file, tmp_path)
    done = replay("000007.npz")
    assert done.returncode == 0, done.stderr
    assert "open with: rerun 000007.rrd" in done.stdout
    np.testing.assert_array_equal(
        column(tmp_path / "000007.rrd", "/reward/total")[1].ravel(), load_episode(own).rewards
    )


def test_episode_that_differs_is_reported_and_written(tmp_path):
    rollout, _ = play("Chance")
    warnings, path = [], tmp_path / "chance.rrd"
    record_episode(rollout.episode, path, title="chance", warn=warnings.append)
    assert path.is_file()
    (warning,) = warnings
    assert warning.startswith("warning: chance: the replayed episode differs from the recorded one; step 6 of 10: ")
    assert warning.endswith("5 of 11 steps differ")


@pytest.mark.slow
def test_episode_of_a_plain_environment_from_the_command_line(replay, tmp_path):
    rollout, _ = play("Pixels", fault="render")
    save_episode(tmp_path / "one.npz", rollout.episode)
    done = replay("one.npz", "-o", "recordings")
    assert done.returncode == 0
    assert done.stderr == "no camera pictures: render() raised OSError: no OpenGL\n"
    assert (tmp_path / "recordings" / "one.rrd").is_file()


@pytest.mark.slow
def test_what_an_environment_prints_stays_out_of_the_result(replay, tmp_path):
    rollout, _ = play("Pixels", fault="talk")
    save_episode(tmp_path / "one.npz", rollout.episode)
    done = replay("one.npz", "--json", "-")
    assert json.loads(done.stdout)["episodes"][0]["file"] == "one.rrd"
    assert done.stderr == "a plugin talks\n(10 times: a plugin talks)\n"


@pytest.mark.slow_except(first=3)
@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["x.rrd"], 2, "error: x.rrd is a recording already; open it with: rerun x.rrd\n"),
        (["x.npz"], 5, "error: x.npz: no such file\n"),
        (["--verify", "x.npz"], 5, "error: x.npz: no such file\n"),
        (["x.safetensors"], 5, "error: x.safetensors: no such file\n"),
        (["x.npz", "--gui", "-o", "y.rrd"], 2, "error: --gui and --output exclude each other: leave out --output\n"),
        (
            ["x.npz", "--set", "task.tolerance=1"],
            2,
            "error: x.npz is a recorded episode and is replayed unchanged: leave out --set\n",
        ),
        (
            ["--verify", "x.npz", "-o", "y.rrd"],
            2,
            "error: --verify and --output exclude each other: leave out --output\n",
        ),
        (
            ["--episodes", "2", "-o", "y.rrd"],
            2,
            "error: --output y.rrd: a recording has one episode; give a folder for 2\n",
        ),
    ],
)
def test_bad_requests(replay, arguments, code, message):
    done = replay(*arguments)
    assert (done.returncode, done.stderr) == (code, message)


def test_damaged_episode(replay, tmp_path):
    (tmp_path / "x.npz").write_bytes(b"not an episode")
    done = replay("x.npz")
    assert done.returncode == 5
    assert done.stderr.startswith("error: x.npz: damaged, or not an .npz file: ")


@pytest.mark.pybullet
def test_policy_for_another_task(run, tmp_path):
    request = ReplayRequest(str(run.run.best_policy), task=f"{ENVS}:Tumble", output=tmp_path)
    with pytest.raises(
        ArtifactError, match=r"this policy is not for this task: its observation space is Box.* \(20,\)"
    ):
        run_replay(request)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_environment_that_fails(replay, tmp_path):
    rollout, _ = play("Pixels")
    spec = dataclasses.replace(rollout.episode.info.spec, parameters={"fault": "step"})
    info = rollout.episode.info.model_copy(update={"spec": spec})
    save_episode(tmp_path / "x.npz", dataclasses.replace(rollout.episode, info=info))
    done = replay("x.npz")
    assert done.returncode == 3
    assert f"error: task '{ENVS}:Pixels': RuntimeError: lost a wheel\nin the episode with seed 3, step 4" in done.stderr
    assert not (tmp_path / "x.rrd").exists()


@pytest.mark.slow_except(first=1)
@pytest.mark.pybullet
@pytest.mark.parametrize(
    ("display", "reason"),
    [("", "DISPLAY is not set"), (":87", "no X server answers at :87")],
)
def test_window_without_a_display(replay, episode_file, display, reason):
    done = replay(episode_file, "--gui", display=display)
    assert done.returncode == 2
    assert done.stderr == (
        f"error: PyBullet's window needs a display, and {reason}; leave out --gui (in Python: render_mode)\n"
    )


def test_no_run_yet(replay, tmp_path):
    done = replay()
    assert done.returncode == 5
    assert done.stderr.startswith(f"error: no run yet under {tmp_path / 'runs'}")
