"""Checkpoints that are not of the run in whose folder they lie."""

import shutil

import pytest

from rlctl.errors import ArtifactError
from tests.training.conftest import TINY


@pytest.fixture
def runs(train):
    """Two runs of the same task with other seeds, of which the second has been trained for longer."""
    return [train("Line", {**TINY, "seed": seed, "total_timesteps": 128 * (seed + 1)}).run for seed in (0, 1)]


@pytest.mark.slow
def test_a_checkpoint_of_another_run_is_not_used(runs, resume, capsys):
    run, other = runs
    shutil.copytree(other.checkpoint(256), run.checkpoint(256))
    result = resume(run, total_timesteps=192)
    assert result.steps == 192
    shown = capsys.readouterr().err
    assert f"{run.checkpoint(256)}: this checkpoint belongs to another run and is not used" in shown
    assert "resuming from step 128" in shown


@pytest.mark.slow
def test_without_one_of_its_own_the_run_is_refused(runs, resume):
    run, other = runs
    shutil.rmtree(run.checkpoints()[0].parent)
    shutil.copytree(other.checkpoint(256), run.checkpoint(256))
    with pytest.raises(ArtifactError, match=r"000000256: this checkpoint belongs to another run"):
        resume(run, total_timesteps=512)
