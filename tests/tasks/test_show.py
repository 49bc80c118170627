"""`rlctl tasks show`: what a task is, on a page and as JSON."""

import json

import pytest

from rlctl.errors import TaskError
from rlctl.tasks.description import describe

EVERYTHING = '''
    from dataclasses import dataclass, field

    import numpy as np
    from rlctl.task import Box, Event, Task, events

    print("printed by the import")

    @dataclass
    class Everything(Task):
        """
        # A heading

        Do everything at once.
        """

        tolerance: float = 0.1
        sides: list[int] = field(default_factory=lambda: [1, 2])

        robot = "no robot"
        control_dt, substeps, episode_s = 0.02, 2, 3.0
        action_space = Box(-1.0, 1.0, (2,), np.float32)
        action_meaning = "two pushes"
        observation_units = {"angle": "rad"}
        observation_bounds = {"angle": (-3.5, 3.5)}
        reward_weights = {"near": 1.0, "effort": 0.0}
        events = {
            "gravity": Event("reset", events.shift_gravity, change={"from": (0, 0), "to": (-0.5, 0.5)}),
            "wind": Event("interval", events.shift_gravity, every_s=0.5, enabled=True, change=(-1, 1)),
            "sensor": Event("observation", events.noise, of="angle", std=(0, 0.01)),
        }

        def build(self, sim): ...
        def act(self, action): ...
        def observe(self): return {"angle": np.zeros(1), "place": np.zeros(3)}
        def rewards(self, action): return {"near": 0.0, "effort": 0.0}
'''

RECIPE = """
    task: {tolerance: 0.05}
    reward_weights: {near: 2}
    events: {sensor: {std: 0.02}}
    frame_stack: 3
    stages:
      - {task: {tolerance: 0.5}, promote: {return: 1.5}}
      - {}
"""


@pytest.fixture
def everything(write_module):
    write_module("everything.yaml", RECIPE)
    return write_module("everything.py", EVERYTHING)


def lines(text: str) -> list[str]:
    """The lines with single spaces."""
    return [" ".join(line.split()) for line in text.splitlines()]


def test_a_bundled_task_on_a_page(rlctl):
    result = rlctl("tasks", "show", "reach")
    assert (result.returncode, result.stderr) == (0, "")
    shown = lines(result.stdout)
    assert shown[0].startswith("reach Bring the hand within `tolerance` of the goal")
    for line in (
        "class rlctl_manipulation.reach:Reach",
        "robot KUKA LBR iiwa",
        "control 0.0166667 s per action, 4 physics steps each",  # 4 / 240 s
        "episode 2 s, 120 steps",  # 2 s / (4 / 240 s)
        "joint_positions 7 rad unbounded",
        "tolerance float 0.05",
        "distance -1",
        "total_timesteps: 120000",
    ):
        assert line in shown
    assert "\x1b" not in result.stdout


def test_everything_that_a_task_says(rlctl, everything):
    result = rlctl("tasks", "show", "everything.py:Everything")
    assert result.returncode == 0, result.stderr
    assert "printed by the import" in result.stderr
    assert "printed" not in result.stdout
    shown = lines(result.stdout)
    assert shown[0] == "everything.py:Everything Do everything at once."
    for line in (
        "success not defined",
        "observation Box([-3.5 -inf -inf -inf], [3.5 inf inf inf], (4,), float32)",  # not stacked: parts have names
        "angle 1 rad -3.5 to 3.5",
        "place 3 unbounded",
        "two pushes",
        "tolerance float 0.1 0.05 in the recipe",
        "sides list[int] [1, 2]",
        "near 2 1 in the task",
        "effort 0 (a metric)",
        "gravity reset shift_gravity change 0..0 -> -0.5..0.5 with randomize=true",
        "wind every 0.5 s shift_gravity change -1..1 always",
        "sensor observation noise std 0.02, of angle with this recipe",
        "1 tolerance 0.5 until return 1.5",
        "2 the recipe's own task last stage, used for evaluation",
        "frame_stack: 3",
    ):
        assert line in shown


def test_the_same_as_json(rlctl, everything):
    content = json.loads(rlctl("tasks", "show", "everything.py:Everything", "--json", "-").stdout)
    angle, place = content["observations"]
    assert (angle["shape"], angle["unit"], angle["low"], angle["high"]) == ([1], "rad", -3.5, 3.5)
    assert (place["shape"], place["unit"], place["low"], place["high"]) == ([3], None, None, None)
    assert content["parameters"][1] == {"name": "sides", "type": "list[int]", "default": [1, 2], "required": False}
    definition = content["definition"]
    assert definition["rewards"][0] == {"name": "near", "weight": 2.0, "default": 1.0}
    assert [(event["name"], event["enabled"], event["acts"]) for event in definition["events"]] == [
        ("gravity", False, False),
        ("wind", True, True),
        ("sensor", False, True),
    ]
    assert content["recipe"]["stages"][0]["promote"]["return"] == 1.5


def test_an_observation_in_a_dict_space(write_module, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    layout = 'robot = "no robot"\n        observation_layout = "dict"'
    write_module("in_a_dict.py", EVERYTHING.replace('robot = "no robot"', layout))
    angle, place = describe("in_a_dict.py:Everything").content["observations"]
    assert (angle["name"], angle["unit"], angle["low"]) == ("angle", "rad", -3.5)
    assert (place["name"], place["shape"], place["low"]) == ("place", [3], None)


@pytest.mark.slow
def test_a_gymnasium_id():
    content = describe("Pendulum-v1").content
    assert content["target"] == "gymnasium.envs.classic_control.pendulum:PendulumEnv"
    assert content["distribution"] == "gymnasium"
    assert content["max_steps"] == 200
    assert [each["name"] for each in content["parameters"]] == ["g"]  # render_mode is not the user's to set
    assert content["definition"] is None
    (action,) = content["actions"]
    assert (action["low"], action["high"]) == (-2.0, 2.0)
    json.dumps(content, allow_nan=False)


def test_a_plain_environment(rlctl, write_module):
    write_module(
        "plain.py",
        """
        import gymnasium
        from gymnasium.spaces import Box, Dict, Discrete, Text

        class Plain(gymnasium.Env):
            observation_space = Dict({"camera": Box(0, 255, (4, 5, 3), "uint8"), "mode": Discrete(3), "note": Text(9)})
            action_space = Discrete(2)
            def __init__(self, size, *, colour="red"): ...

        def small():
            return Plain(1)
        """,
    )
    result = rlctl("tasks", "show", "plain.py:small")
    shown = lines(result.stdout)
    for line in (
        "class plain:Plain",
        "observation Dict(...)",
        "camera 4x5x3 0 to 255",
        "mode Discrete 0 to 2",
        "note Text unbounded",
        "parameters none",
    ):
        assert line in shown
    result = rlctl("tasks", "show", "plain.py:Plain")
    assert result.returncode == 3
    assert "missing 1 required positional argument: 'size'" in result.stderr.splitlines()[-1]


@pytest.mark.slow_except(first=2)
@pytest.mark.parametrize(
    ("task", "code", "message"),
    [
        ("reech", 2, "error: no task 'reech'. Did you mean 'reach'? Installed: "),
        ("Pendulm-v1", 2, "error: Gymnasium has no environment 'Pendulm-v1'. Did you mean 'Pendulum-v1'?"),
        ("halves.py:Half", 3, "error: task 'halves.py:Half': AttributeError: 'Half' object has no attribute "),
        ("broken.py:Broken", 3, "error: task 'broken.py:Broken': RuntimeError: no motors (broken.py:4)"),
    ],
)
def test_what_cannot_be_shown(rlctl, write_module, task, code, message):
    write_module(
        "broken.py",
        "class Broken:\n    def reset(self): ...\n    def step(self, action): ...\n"
        "    def __init__(self): raise RuntimeError('no motors')",
    )
    write_module("halves.py", "class Half:\n    action_space = 1\n    def reset(self): ...\n    def step(self, a): ...")
    result = rlctl("tasks", "show", task, "--json", "-")
    assert (result.returncode, json.loads(result.stdout)["exit_code"]) == (code, code)
    assert any(line.startswith(message) for line in result.stderr.splitlines()), result.stderr


def test_what_fails_at_its_end(write_module, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    write_module(
        "unclosable.py",
        """
        from gymnasium.envs.classic_control import PendulumEnv

        class Unclosable(PendulumEnv):
            def close(self):
                raise RuntimeError("stuck")
        """,
    )
    with pytest.raises(TaskError, match="RuntimeError: stuck"):
        describe("unclosable.py:Unclosable")


def test_options_of_the_list_are_not_lost(rlctl):
    result = rlctl("tasks", "--check", "show", "reach")
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr == "error: put the options after `rlctl tasks show`\n"
    assert "Did you mean 'show'?" in rlctl("tasks", "sho").stderr


@pytest.mark.slow
@pytest.mark.pybullet
def test_a_link_with_an_impossible_inertia_is_named(write_module, rlctl):
    source = EVERYTHING.replace("def build(self, sim): ...", 'def build(self, sim): sim.load("block", "block.urdf")')
    write_module("heavy.py", source)
    done = rlctl("tasks", "show", "heavy:Everything")
    assert done.returncode == 0, done.stderr
    notes = done.stdout.partition("model files")[2].split("\n\n")[0]
    assert "block.urdf, link 'block_2_base_link': a moment of 1 kg m^2 is more than 0.02 kg within 0.1 m" in notes
