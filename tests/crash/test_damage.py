"""Damage to every kind of file of a run that was killed: noticed, or harmless, and never a wrong result."""

import re

import numpy as np
import pytest

from rlctl.errors import ArtifactError
from rlctl.play.episode import load_episode
from rlctl.policy.file import PolicyFile
from rlctl.runs.directory import RunDirectory
from tests.crash.conftest import PARTS, parts
from tests.crash.contract import assert_quiet, assert_same_end
from tests.crash.damage import Damage, all_damage
from tests.crash.trials import ARGUMENTS, copied, only_run, operation_after, resume
from tests.training.comparing import rows

COUNT = 150
"""Of each of two runs."""


@pytest.fixture(scope="session")
def killed(trials, whole, tmp_path_factory):
    """A run that was killed after its third checkpoint or a later one, by name."""
    ended = {}

    def get(name):
        if name not in ended:
            at = operation_after(whole(name), {"ppo, kept": 64, "sac, kept": 40}[name])
            disk = {"fault": "kill", "at": at}
            ended[name] = trials.run(ARGUMENTS[name], tmp_path_factory.mktemp(f"killed {name}"), disk=disk)
        return only_run(ended[name].folder)

    return get


@parts
@pytest.mark.crash
@pytest.mark.parametrize("name", ["ppo, kept", "sac, kept"])
def test_damage_is_noticed_or_harmless(trials, whole, killed, folders, name, part):
    before, undamaged = only_run(whole(name).folder), killed(name)
    for damage in all_damage(undamaged.path, COUNT)[part::PARTS]:
        folder = next(folders)
        run = copied(undamaged, folder)
        damage.do(run.path)
        assert_policies_tell(run, undamaged, damage)
        assert_episodes_tell(run, undamaged, damage)
        ended = trials.run(resume(run), folder)
        assert_quiet(ended)
        noticed = names_it(ended.stderr, damage)
        if ended.code != 0:
            assert ended.code in (2, 5), (damage, ended.stderr)
            assert noticed, (damage, ended.stderr)
            continue
        assert_as_told(run, before, damage, noticed)


def names_it(stderr: str, damage: Damage) -> bool:
    """Whether a warning or an error names a file that was damaged, or the folder of its checkpoint."""
    printed = "\n".join(re.findall(r"^(?:warning|error): .*$", stderr, re.MULTILINE))
    if damage.files == ("run.json",) and "not a run of rlctl" in printed:
        return True
    return any(file in printed for file in damage.files)


def assert_as_told(run: RunDirectory, whole: RunDirectory, damage: Damage, noticed: bool) -> None:
    """Hold that a resumed run ended as an undamaged one does, but for what it has reported as damaged."""
    if not noticed or all(file.startswith("checkpoints/") for file in damage.files):
        assert_same_end(run, whole)
        return
    # What was lost is lost; the training itself goes on as it would have.
    ours, theirs = (PolicyFile.read(each.last_policy).tensors for each in (run, whole))
    assert ours.keys() == theirs.keys()
    for key, values in ours.items():
        np.testing.assert_array_equal(values, theirs[key], err_msg=str(damage))
    for table in ("metrics.csv", "evals.csv"):
        if table not in damage.files:
            assert rows(run.path / table) == rows(whole.path / table)
    PolicyFile.read(run.best_policy)


def unless_refused(read, file):
    """Return what `read` makes of a file; None if it refuses it and names it."""
    try:
        return read(file)
    except ArtifactError as error:
        if str(file) not in str(error):
            raise
        return None


def assert_policies_tell(run: RunDirectory, undamaged: RunDirectory, damage: Damage) -> None:
    """Hold that a policy is what it was, or is refused by its name."""
    if damage.way == "swap":
        return
    for file in damage.files:
        if not file.endswith(("best.safetensors", "last.safetensors", "policy.safetensors")):
            continue
        if (read := unless_refused(PolicyFile.read, run.path / file)) is None:
            continue
        before = PolicyFile.read(undamaged.path / file)
        assert read.info == before.info
        assert {name: values.tobytes() for name, values in read.tensors.items()} == {
            name: values.tobytes() for name, values in before.tensors.items()
        }


def assert_episodes_tell(run: RunDirectory, undamaged: RunDirectory, damage: Damage) -> None:
    """Hold that an episode is what it was, or is refused by its name."""
    for file in damage.files:
        if damage.way == "swap" or not file.endswith(".npz"):
            continue
        if (episode := unless_refused(load_episode, run.path / file)) is None:
            continue
        before = load_episode(undamaged.path / file)
        assert episode.info == before.info
        np.testing.assert_array_equal(episode.actions, before.actions)
        np.testing.assert_array_equal(episode.observations, before.observations)
        np.testing.assert_array_equal(episode.rewards, before.rewards)
