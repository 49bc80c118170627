"""A replay buffer in files: what checkpoints name is there."""

import shutil

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer

from rlctl.storage import files
from rlctl.training.checkpoint_file import ReplayParts

BOX = spaces.Box(-1.0, 1.0, (2,), np.float32)


def fill(buffer, steps):
    for number in range(steps):
        value = np.full((1, 2), number, np.float32)
        buffer.add(value, value, value, np.zeros(1), np.zeros(1), [{}])


def test_what_is_removed_while_training_is_written_again(tmp_path):
    buffer = ReplayBuffer(50, BOX, BOX, device="cpu")
    parts = ReplayParts(tmp_path / "replay", buffer)
    parts.folder.mkdir()
    fill(buffer, 20)
    parts.save(20)
    shutil.rmtree(parts.folder)
    parts.folder.mkdir()
    fill(buffer, 5)
    named = parts.save(25)
    for part in named:
        files.check_digest(parts.folder / part.name, part.sha256)
    read = ReplayParts(parts.folder, ReplayBuffer(50, BOX, BOX, device="cpu"))
    read.load(named, 25)
    np.testing.assert_array_equal(read.buffer.observations[:25], buffer.observations[:25])
