"""Row blocks of minibatches: their number, and equal bits with any number of processes."""

import os
import signal
import time

import numpy as np
import pytest

from rlctl.training.updates.blocks import OFF_POLICY_BLOCKS, Blocks, count_blocks, select_block
from rlctl.training.updates.ppo_gradients import PpoGradients, PpoSettings
from rlctl.training.updates.q_gradients import DqnGradients, QSettings, Td3Gradients
from rlctl.training.updates.sac_gradients import SacGradients, SacSettings, TqcGradients

pytestmark = pytest.mark.usefixtures("no_child_left")

PPO = PpoSettings(
    rows=500,
    actor=(9, 32, 3),
    critic=(9, 32, 1),
    actor_uses_tanh=True,
    critic_uses_tanh=True,
    log_std=(3,),
    sde_epsilon=None,
    ent_coef=0.01,
    vf_coef=0.5,
)
SAC = SacSettings(
    rows=129,
    actions=3,
    actor=(9, 32, 6),
    actor_uses_tanh=False,
    critic=(12, 32, 1),
    critic_uses_tanh=False,
    critics=2,
    log_std=None,
    epsilon=1e-6,
    mean_limit=None,
)
TQC = SacSettings(
    rows=129,
    actions=3,
    actor=(9, 32, 3),
    actor_uses_tanh=True,
    critic=(12, 32, 25),
    critic_uses_tanh=False,
    critics=2,
    log_std=(32, 3),
    epsilon=1e-6,
    mean_limit=2.0,
    dropped=4,
)
TD3 = QSettings(
    rows=129, features=9, actions=3, critic=(12, 32, 1), critics=2, critic_uses_tanh=False, actor=(9, 32, 3)
)
DQN = QSettings(rows=129, features=9, actions=1, critic=(9, 32, 4), critics=1, critic_uses_tanh=True)


@pytest.mark.parametrize(
    ("rows", "weights", "most", "expected"),
    [
        (1536, 46_000, 8, 8),  # 71 million multiplications
        (320, 13_000, 8, 4),  # 4.2 million, and a block needs one million
        (128, 68_000, OFF_POLICY_BLOCKS, 4),  # 128 / 32 rows
        (64, 1_000_000, 8, 2),
        (256, 3_000, 8, 1),  # 0.8 million
        (10, 1_000_000, 8, 1),
    ],
)
def test_small_minibatches_are_not_split(rows, weights, most, expected):
    assert count_blocks(rows, weights, most) == expected


def test_blocks_are_all_rows_of_a_minibatch_once():
    blocks = [select_block(block, 3, 20, 11) for block in range(3)]
    assert [row for block in blocks for row in range(100)[block]] == list(range(20, 31))


def compute(kind, settings, cores):
    """Return all arrays after every phase for a minibatch of random numbers in four blocks."""
    blocks, count = Blocks(kind, settings, 16, cores=cores), 4
    arrays, rng = blocks.arrays, np.random.default_rng(0)
    for name, array in arrays.items():
        if array.dtype == np.float32 and not name.startswith("gradient"):
            array[...] = rng.normal(0, 0.3, array.shape)
    if kind is PpoGradients:
        arrays["order"][:], arrays["clip_ranges"][:] = rng.permutation(settings.rows), (0.2, np.inf)
        arrays["minibatch"][:], phases, tasks = (7, 301, count), [0], 2 * count
    elif isinstance(settings, SacSettings):
        arrays["numbers"][:], phases, tasks = (0.1, 1, count), [0, 1], count
    else:
        arrays["count"][...], phases, tasks = count, [0, 1] if settings.actor else [0], count
        arrays["actions"][...] = 2 if kind is DqnGradients else arrays["actions"]
    own, differentiate = [], blocks.work.compute

    def compute_slowly(phase, task):  # the other processes take most tasks
        own.append(task)
        time.sleep(0.02 if cores > 1 else 0)
        differentiate(phase, task)

    blocks.work.compute = compute_slowly
    time.sleep(0.3 if cores > 1 else 0)  # they start
    for phase in phases:
        blocks.run(phase, tasks)
    assert (len(own) < tasks * len(phases)) == (cores > 1)
    blocks.add_gradients(count, slice(0, len(arrays["gradient"])))
    blocks.close()
    assert np.abs(arrays["gradient"]).sum() > 0
    return {name: array.tobytes() for name, array in arrays.items()}


def slow(*values):
    return pytest.param(*values, marks=pytest.mark.slow)


@pytest.mark.slow_except("ppo")
@pytest.mark.parametrize(
    ("kind", "settings"),
    [(PpoGradients, PPO), (SacGradients, SAC), (TqcGradients, TQC), slow(Td3Gradients, TD3), slow(DqnGradients, DQN)],
    ids=["ppo", "sac", "tqc", "td3", "dqn"],
)
def test_any_number_of_processes_computes_the_same_bits(kind, settings):
    alone = compute(kind, settings, 1)
    for cores in (2, 4, 16):
        assert compute(kind, settings, cores) == alone


class EndsInChildren(DqnGradients):
    """Is killed in every other process than the test's."""

    def compute(self, phase, task):
        if os.getpid() != int(self._arrays["noise"][0, 0]):
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(0.05)  # the other processes take the next task meanwhile
        super().compute(phase, task)


@pytest.mark.slow
def test_without_its_processes_an_update_continues(capfd):
    blocks = Blocks(EndsInChildren, DQN, 4, cores=2)
    blocks.arrays["noise"][0, 0] = os.getpid()
    blocks.arrays["count"][...] = 4
    blocks.arrays["rewards"][:] = 1
    time.sleep(0.5)
    for _ in range(2):
        blocks.arrays["gradients"][:] = 0
        blocks.run(0, 4)
        assert (np.abs(blocks.arrays["gradients"][:4]).sum(axis=1) > 0).all()
    assert capfd.readouterr().err == "updates continue on one core: a process was killed by SIGKILL\n"
