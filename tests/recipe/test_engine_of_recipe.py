"""The key `sim` of a task's recipe: obeyed wherever the task is named."""

import pytest

import rlctl as api
from rlctl.engine import MUJOCO, Engine
from rlctl.errors import RecipeError, UsageError
from rlctl.recipe.recipe_files import make_spec

POLE = """
<mujoco>
  <default><default class="hinged"><joint type="hinge" axis="0 1 0" range="-90 90"/></default></default>
  <worldbody>
    <body name="pole" pos="0 0 1">
      <joint name="swing" class="hinged"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" density="500"/>
    </body>
  </worldbody>
</mujoco>
"""
TASK = """
from pathlib import Path

import numpy as np

from rlctl.task import Box, Task


class Pole(Task):
    action_space = Box(-1.0, 1.0, (1,), np.float32)
    control_dt = 0.02
    substeps = 4
    max_steps = 20
    reward_weights = {"low": -1.0}

    def build(self, sim):
        assert sim.engine == "MuJoCo"  # PyBullet reads no classes of <default>
        self.pole = sim.load("pole", Path(__file__).with_name("pole.xml"), fixed=True)

    def reset(self, rng):
        pass

    def act(self, action):
        pass

    def observe(self):
        return {"height": np.array([1.0])}

    def rewards(self, action):
        return {"low": 0.0}
"""


@pytest.fixture
def pole(tmp_path):
    (tmp_path / "pole.xml").write_text(POLE)
    (tmp_path / "pole.py").write_text(TASK)
    (tmp_path / "pole.yaml").write_text("sim: mujoco\n")
    return f"{tmp_path / 'pole.py'}:Pole"


def test_a_task_of_an_mjcf_file_is_made_in_python(pole):
    env = api.make(pole)
    env.reset(seed=0)
    env.close()
    again = env.unwrapped.spec.make()  # from what Gymnasium knows of it
    assert again.unwrapped.sim.engine == "MuJoCo"
    again.close()


def test_another_engine_than_the_recipe_names(pole, tmp_path):
    assert make_spec(pole).sim == MUJOCO
    assert make_spec("Pendulum-v1").sim == Engine()
    with pytest.raises(UsageError, match=r"sim 'mujocoo': no such engine\. Did you mean 'mujoco'"):
        api.make(pole, sim="mujocoo")
    env = api.make(pole, sim="mujoco:0.01")
    assert env.unwrapped.spec.kwargs["sim"] == "mujoco:0.01"
    env.close()
    (tmp_path / "pole.yaml").write_text("algo: sac\nsim: mujocoo\n")
    with pytest.raises(RecipeError, match=r"pole\.yaml:2: sim: 'mujocoo': no such engine"):
        make_spec(pole)


@pytest.mark.slow
def test_it_is_checked_in_the_engine_of_its_recipe(pole, rlctl):
    done = rlctl("check-env", pole, "--select", "RL001")
    assert done.returncode == 0, done.stdout + done.stderr
