import dataclasses
import json

import numpy as np
import pytest

from rlctl.errors import ArtifactError
from rlctl.play.episode import RecordedEpisode, load_episode, save_episode
from rlctl.replaying.reproduce import find_difference, verify_episode
from tests.replaying.conftest import as_json, play

pytestmark = pytest.mark.pybullet


@pytest.fixture
def episode(reached) -> RecordedEpisode:
    return reached.episode


@pytest.fixture
def tampered(episode, tmp_path):
    """Write an episode with some of its arrays or its description changed."""

    def write(info: dict | None = None, **arrays):
        path = tmp_path / "000003.npz"
        changed = episode.info.model_copy(update=info or {})
        save_episode(path, dataclasses.replace(episode, info=changed, **arrays))
        return path

    return write


def test_recorded_episode_is_the_same_again(replay, episode_file):
    done = replay("--verify", episode_file)
    assert done.returncode == 0, done.stderr
    assert "reach, seed 5, 120 steps" in done.stdout
    assert "identical, bit for bit" in done.stdout
    assert list(episode_file.parent.glob("*.rrd")) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Tumble", "Pixels"])
def test_episodes_of_other_environments_are_the_same_again(name, tmp_path):
    rollout, _ = play(name)
    path = tmp_path / "000000.npz"
    save_episode(path, rollout.episode)
    _, verification = verify_episode(load_episode(path), path)
    assert verification.difference is None
    assert verification.other_versions == {}


def test_training_episodes_are_the_same_again(run):
    # Played by a worker among other episodes, verified alone and in a fresh world.
    files = sorted(run.run.episodes.glob("*.npz"))
    assert files
    for path in files:
        assert verify_episode(load_episode(path), path)[1].difference is None


@pytest.mark.slow
def test_smallest_change_is_found_and_named(replay, tampered, episode):
    observations = episode.observations.copy()
    observations[17, 16] = np.nextafter(observations[17, 16], np.float32(1.0))  # the hand's height, by its last bit
    path = tampered(observations=observations)
    done = replay("--verify", path)
    assert done.returncode == 1
    assert "not identical" in done.stdout
    now, recorded = episode.observations[17, 16].item(), observations[17, 16].item()
    assert done.stderr == (
        f"error: {path}: not identical, step 17 of 120: observation hand[2] is {now!r}, recorded {recorded!r} "
        f"(off by {abs(now - recorded):.3g}); 1 of 121 steps differ\n"
    )


def test_difference_as_json(replay, tampered, episode):
    rewards = episode.rewards.copy()
    rewards[40:] += 0.5
    done = replay("--verify", tampered(rewards=rewards), "--json", "-")
    assert done.returncode == 1
    verification = json.loads(done.stdout)["verification"]
    assert verification["identical"] is False
    # rewards[40] is that of step 41; 120 - 40 = 80 steps have another one.
    assert verification["difference"]["step"] == 41
    assert verification["difference"]["what"] == "reward"
    assert verification["difference"]["size"] == pytest.approx(0.5)
    assert verification["difference"]["steps"] == 80


def test_other_actions_lead_elsewhere(tampered, episode):
    actions = episode.actions.copy()
    actions[9] = -actions[9]
    path = tampered(actions=actions)
    _, verification = verify_episode(load_episode(path), path)
    assert verification.difference.step == 10
    assert verification.difference.what.startswith("observation joint_positions[")


def test_reward_term_is_compared_where_all_else_is_equal(tampered, episode):
    terms = episode.terms.copy()
    terms[4, 2] = 7.0
    path = tampered(terms=terms)
    difference = verify_episode(load_episode(path), path)[1].difference
    assert (difference.step, difference.what, difference.recorded) == (5, "term action", "7.0")


def test_end_of_an_episode_is_compared(reached, episode):
    cut = dataclasses.replace(
        episode,
        actions=episode.actions[:50],
        observations=episode.observations[:51],
        rewards=episode.rewards[:50],
        terms=episode.terms[:50],
    )
    assert str(find_difference(cut, reached)) == ("step 50 of 50: length is 120, recorded 50 (off by 70)")
    flipped = dataclasses.replace(episode, info=episode.info.model_copy(update={"success": False}))
    assert find_difference(flipped, reached).what == "success"


def test_episode_that_stops_before_its_end_says_so(tampered, episode):
    path = tampered(
        actions=episode.actions[:50],
        observations=episode.observations[:51],
        rewards=episode.rewards[:50],
        terms=episode.terms[:50],
    )
    difference = verify_episode(load_episode(path), path)[1].difference
    assert str(difference) == "step 50 of 50: end of the episode is later, recorded here"


def test_types_and_sizes_are_compared(reached, episode):
    wider = dataclasses.replace(episode, observations=episode.observations.astype(np.float64))
    difference = str(find_difference(wider, reached))
    assert "type of observation joint_positions is 20 x float32, recorded 20 x float64" in difference
    fewer = dataclasses.replace(episode, observations=episode.observations[:, :5])
    difference = str(find_difference(fewer, reached))
    assert "type of observation joint_positions is 20 x float32, recorded 5 x float32" in difference


def test_environment_that_is_not_reproducible(tmp_path):
    rollout, _ = play("Chance")
    path = tmp_path / "000000.npz"
    save_episode(path, rollout.episode)
    difference = verify_episode(load_episode(path), path)[1].difference
    assert difference.step == 6
    assert difference.what == "observation point[0]"
    assert difference.steps == 5


@pytest.mark.slow
def test_other_versions_are_named(replay, tampered, episode):
    path = tampered(info={"versions": {**episode.info.versions, "numpy": "1.0", "gone": "3", "torch": "1.0"}})
    done = replay("--verify", path)
    assert done.returncode == 0
    assert f"recorded with numpy 1.0, now {np.__version__}" in done.stdout
    assert "recorded with gone 3, now not installed" in done.stdout
    assert "torch" not in done.stdout  # the actions are recorded: no policy acts


def test_actions_for_another_space(tampered, episode):
    path = tampered(actions=episode.actions[:, :3])
    with pytest.raises(
        ArtifactError, match=r"000003\.npz: its actions have shape \(3,\), but those of reach have \(7,\)"
    ):
        verify_episode(load_episode(path), path)


@pytest.mark.slow
def test_as_json_when_identical(replay, episode_file):
    content = as_json(replay("--verify", episode_file, "--json", "-"))
    assert content["verification"]["identical"] is True
    assert content["episodes"][0]["length"] == 120
    assert content["open"] is None
