"""`rlctl replay --video` and `--gui`: films without a display, and windows."""

import contextlib
import dataclasses
import gc
import time
import weakref

import numpy as np
import pytest
from PIL import Image

from rlctl.environments.spec import EnvSpec
from rlctl.errors import UsageError
from rlctl.play.episode import save_episode
from rlctl.replaying.camera import find_distance
from rlctl.replaying.pictures import _WRITERS, film_episodes, read_size
from rlctl.replaying.recorder import count_steps
from rlctl.replaying.replay import run_replay
from rlctl.replaying.replay_request import ReplayRequest
from rlctl.replaying.report import ReplayResult, show
from rlctl.replaying.views import make_filmable
from rlctl.replaying.window import show_episodes
from rlctl.task.pybullet.library import pybullet
from tests.replaying.conftest import play


@pytest.fixture(scope="module")
def short_episode(reached, tmp_path_factory):
    """The first nine steps of an episode of reach."""
    path = tmp_path_factory.mktemp("short") / "1.npz"
    episode = reached.episode
    steps = {"actions": episode.actions[:9], "rewards": episode.rewards[:9], "terms": episode.terms[:9]}
    save_episode(path, dataclasses.replace(episode, observations=episode.observations[:10], **steps))
    return path


@pytest.mark.slow
@pytest.mark.pybullet
def test_gif_of_a_robot_and_its_goal(short_episode, tmp_path):
    film = run_replay(ReplayRequest(str(short_episode), video=tmp_path / "reach.gif")).film
    assert (film.width, film.height, film.rate) == (400, 300, pytest.approx(20))
    with Image.open(film.file) as image:
        # 60 steps a second, 20 pictures: those of the steps 0, 3, 6 and 9, which is the end. Equal ones there are one.
        assert film.pictures == image.n_frames >= 4
        picture = np.array(image.convert("RGB")).astype(int)
    red, green, blue = picture[..., 0], picture[..., 1], picture[..., 2]
    assert ((green > 100) & (red < 60) & (blue < 120)).sum() > 20  # the goal
    assert ((red > 180) & (green < 130) & (blue < 60)).sum() > 200  # the arm's joints


@pytest.mark.slow
@pytest.mark.pybullet
def test_mp4_plays(short_episode, tmp_path):
    av = pytest.importorskip("av")
    film = run_replay(ReplayRequest(str(short_episode), video=tmp_path / "reach.mp4")).film
    with av.open(str(film.file)) as container:
        assert container.streams.video[0].codec_context.name == "h264"
        assert container.streams.video[0].average_rate == 30
        pictures = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    # 60 steps a second, 30 pictures: those of the steps 0, 2, .., 8 and the end, and half a second of it.
    assert len(pictures) == film.pictures == 6 + 15
    assert pictures[0].shape == (480, 640, 3)
    assert np.ptp(pictures[0]) > 100


def test_the_number_of_pictures_is_that_of_the_file(tmp_path):
    av = pytest.importorskip("av")
    counts = []
    for suffix in (".gif", ".mp4"):
        film = _WRITERS[suffix](tmp_path / f"film{suffix}", 10.0)
        for value in (0, 90, 200, 200, 200):
            film.add(np.full((64, 64, 3), value, np.uint8))
        film.close()
        counts.append(film.count)
    with Image.open(tmp_path / "film.gif") as image:
        in_gif = image.n_frames
    with av.open(str(tmp_path / "film.mp4")) as container:
        in_mp4 = len(list(container.decode(video=0)))
    assert counts == [in_gif, in_mp4] == [3, 5]  # a GIF has equal pictures in a row once


def test_pictures_of_a_plain_environment(tmp_path):
    rollout, _ = play("Pixels")
    save_episode(tmp_path / "one.npz", rollout.episode)
    film = run_replay(ReplayRequest(str(tmp_path / "one.npz"), video=tmp_path / "film.gif")).film
    assert (film.pictures, film.width, film.height, film.rate) == (11, 60, 40, pytest.approx(20))


def test_an_environment_without_pictures(tmp_path):
    rollout, _ = play("Blind")
    save_episode(tmp_path / "one.npz", rollout.episode)
    with pytest.raises(UsageError, match=r"^--video: no pictures: .*Blind takes no render_mode$"):
        run_replay(ReplayRequest(str(tmp_path / "one.npz"), video=tmp_path / "film.gif"))
    assert not (tmp_path / "film.gif").exists()


def test_episodes_take_their_time():
    spec = EnvSpec("reach")
    env = spec.make()
    arrived = []

    def begin(seed):
        arrived.append(time.monotonic())
        return lambda observation, step: env.action_space.sample() if step < 12 else None

    (rollout,) = show_episodes(env, spec, [1], begin)
    env.close()
    assert rollout.length == 12
    # 12 steps of 1/60 s.
    assert time.monotonic() - arrived[0] >= 0.2


@pytest.mark.pybullet
def test_closing_the_window_ends_it_well():
    spec = EnvSpec("reach")
    env = spec.make()

    def choose(observation, step):
        if step == 3:
            pybullet.disconnect(physicsClientId=env.unwrapped.sim.client)
        return env.action_space.sample()

    assert show_episodes(env, spec, [1, 2], lambda seed: choose) == []
    env.close()


def test_a_window_that_was_closed_at_once_is_no_error(tmp_path):
    show(ReplayResult("reach", "best.safetensors", []), str(tmp_path / "result.json"))
    assert '"episodes": []' in (tmp_path / "result.json").read_text()


def test_a_small_robot_fills_the_picture_as_a_large_one_does():
    low, high = np.array([-0.1, -0.1, 0.0]), np.array([0.2, 0.1, 0.3])
    small, large = (find_distance(scale * low, scale * high, (400, 300)) for scale in (1.0, 3.0))
    assert large == pytest.approx(3 * small)
    assert 0.4 < small < 0.8  # 0.45 m from corner to corner, seen at 45 degrees
    assert find_distance(low, high, (150, 300)) > small  # a narrow picture


@pytest.mark.pybullet
def test_a_film_and_recordings_in_one_call(short_episode, tmp_path):
    files = {"video": tmp_path / "film.gif", "output": tmp_path / "one.rrd"}
    result = run_replay(ReplayRequest(str(short_episode), size="96x64", **files))
    assert (result.film.width, result.film.height) == (96, 64)
    assert [episode.recording for episode in result.episodes] == [tmp_path / "one.rrd"]
    assert files["output"].stat().st_size > 1000
    assert files["video"].is_file()


@pytest.mark.slow
@pytest.mark.pybullet
def test_a_filmed_and_recorded_episode_of_a_policy_repeats(tmp_path):
    request = ReplayRequest("reach", baseline="zero", video=tmp_path / "film.gif", output=tmp_path, size="64x64")
    (episode,) = run_replay(request).episodes
    assert run_replay(ReplayRequest(verify=episode.episode)).verification.difference is None


@pytest.mark.slow
@pytest.mark.pybullet
def test_a_film_of_the_beginning_of_an_episode(tmp_path):
    request = ReplayRequest("reach", baseline="zero", video=tmp_path / "film.gif", size="64x64", seconds=0.5)
    result = run_replay(request)
    # A picture every 0.05 s, that of the reset among them; the episode goes on.
    assert result.film.pictures == round(0.5 * result.film.rate) + 1
    assert result.episodes[0].length > 0.5 * result.film.rate


def test_the_length_of_a_film_needs_a_film(tmp_path):
    with pytest.raises(UsageError, match=r"--seconds is for films: add --video FILE.mp4$"):
        run_replay(ReplayRequest("reach", seconds=1.0))
    with pytest.raises(UsageError, match=r"--seconds is for films: add --video FILE.mp4, or --at SECONDS"):
        run_replay(ReplayRequest("reach", seconds=1.0, baseline="zero", video=tmp_path / "one.png"))


@pytest.mark.pybullet
def test_a_rollout_is_forgotten_before_the_next_episode(tmp_path):
    """The scenes of many episodes would fill the memory until the film is done."""
    spec = EnvSpec("reach")
    earlier = []

    def choose(observation, step):
        return np.zeros(7, np.float32) if step < 2 else None

    def keep(number, rollout):
        gc.collect()
        assert [reference() for reference in earlier] == [None] * number
        earlier.append(weakref.ref(rollout))
        return number

    with contextlib.closing(make_filmable(spec)) as env:
        kept, _ = film_episodes(
            tmp_path / "film.gif",
            env,
            spec,
            [1, 2],
            lambda seed: choose,
            policy="zero",
            keep=keep,
            size=(64, 64),
            draw=print,
        )
    assert kept == [0, 1]


@pytest.mark.parametrize("size", ["640", "640x", "640x481", "10x10", "9000x64", "axb", "640x480x3"])
def test_a_size_that_is_none(size):
    with pytest.raises(UsageError, match=r"^--size .*: give WIDTHxHEIGHT, even numbers of pixels from 64 to 3840"):
        read_size(size)


def test_a_size_needs_a_film_of_a_camera(short_episode, tmp_path):
    with pytest.raises(UsageError, match="--size is for films"):
        run_replay(ReplayRequest(str(short_episode), size="640x480"))
    rollout, _ = play("Pixels")
    save_episode(tmp_path / "one.npz", rollout.episode)
    with pytest.raises(UsageError, match="--size: this environment draws its own pictures of 60x40"):
        run_replay(ReplayRequest(str(tmp_path / "one.npz"), video=tmp_path / "film.gif", size="640x480"))


def test_steps_of_episodes_that_end_early_count_as_whole_ones():
    shown = []
    watch = count_steps(shown.append, 10)
    for step in (0, 1, 2, 0, 1):
        watch(step)
    assert shown == [0, 1, 2, 10, 11]


def test_one_picture_of_an_episode(short_episode, tmp_path):
    film = run_replay(ReplayRequest(str(short_episode), video=tmp_path / "still.png", size="320x240", at=0.0)).film
    assert (film.pictures, film.width, film.height) == (1, 320, 240)
    assert (tmp_path / "still.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(UsageError, match=r"^--at 900: the episode ends after"):
        run_replay(ReplayRequest(str(short_episode), video=tmp_path / "late.png", at=900.0))
    assert not (tmp_path / "late.png").exists()
    with pytest.raises(UsageError, match=r"^--at is for one picture: add --video FILE\.png$"):
        run_replay(ReplayRequest(str(short_episode), video=tmp_path / "film.gif", at=1.0))
