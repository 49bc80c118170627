"""`pick`: a script succeeds, and rewards pay each stage more than the last."""

import numpy as np
import pytest

from tests.manipulation.scripted_hands import CLOSED, OPEN, WORLDS, Script, above

pytest.importorskip("mujoco")


def test_a_script_succeeds_and_each_stage_is_worth_more_than_the_last():
    script, paid = Script("pick"), []
    task = script.task

    def note(result):
        paid.append(np.median(result.reward))

    note(script.go(above(task.block.base_position, 0.2), OPEN, 20))
    note(script.grasp())
    assert task.grasped.sum() >= WORLDS - 1
    assert not task.is_success().any()
    note(script.go(above(task.block.base_position, 0.1), CLOSED, 20))
    script.go(above(task.goal, 0.08), CLOSED, 25)
    note(script.go(task.goal, CLOSED, 20))
    assert task.is_success().sum() >= WORLDS - 1
    assert paid == sorted(paid)
    assert paid[-1] > 1.2  # of 1.5 in all
    script.worlds.close()
