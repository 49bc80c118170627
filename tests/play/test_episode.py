"""Recorded episodes: written, read, and refused when they cannot be what they should."""

import dataclasses
import json
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from rlctl.environments.named_task import EPISODE
from rlctl.environments.spec import EnvSpec
from rlctl.errors import ArtifactError
from rlctl.play.episode import EpisodeInfo, RecordedEpisode, load_episode, save_episode, save_next_episode
from rlctl.storage import files

INFO = EpisodeInfo(
    spec=EnvSpec("reach", {"tolerance": 0.02}, randomize=True, events={"mass": {"factor": [0.9, 1.1]}}, frame_stack=2),
    seed=2**31 - 1,
    success=False,
    total_reward=-1.0 / 3.0,
    term_names=["distance"],
)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "episodes" / "000000.npz"


def episode(observations):
    rng = np.random.default_rng(0)
    return RecordedEpisode(
        rng.normal(size=(3, 2)).astype(np.float32), observations, rng.normal(size=3), rng.normal(size=(3, 1)), INFO
    )


@pytest.mark.parametrize(
    "observations",
    [
        np.arange(8, dtype=np.float32).reshape(4, 2),
        {"camera": np.ones((4, 2, 2, 3), np.uint8), "arm/joints": np.zeros((4, 7), np.float32)},
    ],
    ids=["flat", "dict"],
)
def test_round_trip(path, observations):
    written = episode(observations)
    save_episode(path, written)
    read = load_episode(path)
    assert read.info == INFO
    for name in ("actions", "rewards", "terms"):
        assert getattr(read, name).tobytes() == getattr(written, name).tobytes()
        assert getattr(read, name).dtype == getattr(written, name).dtype
    if isinstance(observations, dict):
        assert read.observations.keys() == observations.keys()
        assert all((read.observations[key] == value).all() for key, value in observations.items())
    else:
        np.testing.assert_array_equal(read.observations, observations)


def test_the_file_does_not_say_who_names_its_task(path):
    save_episode(path, episode(np.zeros((4, 2))))
    assert "named_by" not in str(files.read_npz(path)["info"])
    rewrite(path, json.dumps({**json.loads(INFO.model_dump_json()), "spec": {"task": "reach", "named_by": ""}}))
    assert load_episode(path).info.spec.named_by == EPISODE


def rewrite(path, info):
    save_episode(path, episode(np.zeros((4, 2))))
    arrays = files.read_npz(path)
    files.write_npz(path, {**arrays, "info": np.array(info)})


def test_a_newer_format(path):
    rewrite(path, json.dumps({"format": 99, "who": "knows"}))
    with pytest.raises(
        ArtifactError, match=r"000000.npz: episode format 99 is newer than this rlctl .* can read \(2\)"
    ):
        load_episode(path)


@pytest.mark.parametrize(
    "info", ["{", "[]", "{}", json.dumps({"spec": {"task": "reach"}, "seed": "x", "total_reward": 0})]
)
def test_a_damaged_description(path, info):
    rewrite(path, info)
    with pytest.raises(ArtifactError, match=r"000000.npz: damaged: "):
        load_episode(path)


def test_what_is_no_episode(path):
    files.write_npz(path, {"weights": np.zeros(3)})
    with pytest.raises(ArtifactError, match=r"000000.npz: not an episode of rlctl: it has no info, actions, "):
        load_episode(path)
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(ArtifactError, match=r"000000.npz: damaged, or not an .npz file"):
        load_episode(path)
    path.unlink()
    with pytest.raises(ArtifactError, match=r"000000.npz: no such file$"):
        load_episode(path)


def test_of_an_episode_that_failed_there_are_the_actions_alone(path):
    failed = INFO.model_copy(update={"failure": "RuntimeError", "term_names": []})
    nothing = np.zeros(0)
    actions = np.ones((3, 2), np.float32)
    save_episode(path, RecordedEpisode(actions, nothing, nothing, nothing.reshape(0, 0), failed))
    np.testing.assert_array_equal(load_episode(path).actions, actions)
    whole = failed.model_copy(update={"failure": ""})
    save_episode(path, RecordedEpisode(actions, nothing, nothing, nothing.reshape(0, 0), whole))
    with pytest.raises(ArtifactError, match=r"actions: float32 of shape \(3, 2\), not numbers of shape \(0, 2\)"):
        load_episode(path)


@pytest.mark.parametrize(
    ("policy", "step"),
    [("training step 300", 300), ("training", None), ("best.safetensors, ppo, step 300", None), ("", None)],
)
def test_an_episode_knows_the_evaluation_that_played_it(policy, step):
    assert INFO.model_copy(update={"policy": policy}).evaluated_at == step


def test_episodes_are_numbered_on(tmp_path):
    for name in ("000002.npz", "000010.npz", "best.npz", "000011.rrd"):
        (tmp_path / name).write_bytes(b"")
    recorded = episode(np.zeros((4, 2)))
    file = save_next_episode(tmp_path, recorded)
    assert file == tmp_path / "000012.npz"  # 11 has a recording, which would be replaced
    assert load_episode(file).info == INFO


def test_episodes_that_are_saved_at_once_get_numbers_of_their_own(tmp_path):
    count, recorded = 8, episode(np.zeros((4, 2)))
    barrier = threading.Barrier(count)

    def save(_):
        barrier.wait()
        return [save_next_episode(tmp_path, recorded) for _ in range(5)]

    with ThreadPoolExecutor(count) as threads:
        saved = [file for files_of_one in threads.map(save, range(count)) for file in files_of_one]
    assert sorted(file.name for file in saved) == [f"{number:06d}.npz" for number in range(5 * count)]


def test_a_number_is_free_again_if_its_episode_cannot_be_saved(tmp_path):
    recorded = dataclasses.replace(episode(np.zeros((4, 2))), terms=np.array([object()]))
    with pytest.raises(ValueError, match="Object arrays"):
        save_next_episode(tmp_path, recorded)
    assert list(tmp_path.iterdir()) == []
