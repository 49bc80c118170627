"""A controller computes from measured quantities what the policy does from observations: in C, in ONNX and in NumPy."""

import dataclasses

import numpy as np
import pytest
from gymnasium import spaces

from rlctl.deploy import Limits
from rlctl.environments.info import EnvInfo, space_to_json
from rlctl.errors import ArtifactError, RecipeError, UsageError
from rlctl.exporting.c_source import find_compiler
from rlctl.exporting.controller.controllers import OnnxController
from rlctl.exporting.controller.graph import build_graph
from rlctl.exporting.controller.plan import ControllerPlan, JointTarget
from rlctl.exporting.controller.source import ControllerSource
from rlctl.policy.numpy_actor import NumpyActor
from rlctl.policy.onnx_policy import OnnxActor, encode
from rlctl.policy.policy import Policy
from rlctl.policy.torch_policy import TorchActor
from rlctl.task import Joints, terms
from rlctl.task.history import TermHistory
from rlctl.task.rotations import normalize
from tests.exporting.controllers import build_controller, make_arm, make_policy, plan_of

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler (cc, or $CC) on this machine")
ROWS = [[0.5, -1.0], [0.25, 2.0], [-0.75, 1.0]]
AXES = [[1.0, 0.0, 0.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, -1.0, 0.0, 0.0], [0.6, 0.0, -0.8, 0.0, 1.0, 0.0]]
TERMS = {
    "gravity": terms.Gravity("orientation"),
    "angles": terms.Scaled("angles", offset=(0.1, -0.2), scale=(2.0,)),
    "to_goal": terms.Displacement("goal", "hand"),
    "far": terms.Distance("goal", "hand"),
    "last": terms.LastAction(),
    "clock": terms.PhaseClock(0.35),
    "legs": terms.PhaseClock(0.35, offsets=(0.0, 0.5)),
    "euler": terms.Euler("orientation"),
    "clipped": terms.Scaled("angles", clip=(-0.2, 0.3)),
    "clip": terms.Playback(ROWS, 0.2),
    "off": terms.Playback(ROWS, 0.2, "angles"),
    "timed": terms.Playback(ROWS, 0.25, "angles", "clip_time"),
    "turned": terms.ClipOrientation(AXES, 0.2, "orientation"),
}
QUANTITIES = {"orientation": 4, "angles": 2, "goal": 3, "hand": 3, "clip_time": 1}
SIZES = {
    "gravity": 3,
    "angles": 2,
    "hand": 3,
    "to_goal": 3,
    "far": 1,
    "last": 2,
    "clock": 2,
    "legs": 4,
    "euler": 3,
    "clipped": 2,
    "int": 1,
    "clip": 2,
    "off": 2,
    "timed": 2,
    "turned": 6,
}
JOINTS = Joints(["a", "b"], default_positions=[0.5, -0.5], low=[-0.4, -0.4], high=[0.4, 0.4])
STEPS = 12


def make_env(history=None, start="first", **fields):
    """An environment with every kind of term, some of which have a history; an input is called `int`."""
    history = history or {}
    sizes = {name: size * history.get(name, 1) for name, size in SIZES.items()}
    size = sum(sizes.values())
    return EnvInfo(
        observation_space=space_to_json(spaces.Box(-np.inf, np.inf, (size,), np.float32)),
        action_space=space_to_json(spaces.Box(-1.0, 1.0, (2,), np.float32)),
        observation_sizes=sizes,
        observation_terms=TERMS,
        observation_history=history,
        history_start=start,
        quantity_sizes=QUANTITIES,
        control_dt=0.1,
        **fields,
    )


def draw_inputs(rng):
    sizes = {**QUANTITIES, "int": 1}
    inputs = {name: rng.uniform(-1, 1, size).astype(np.float32) for name, size in sizes.items()}
    return {**inputs, "orientation": normalize(inputs["orientation"]).astype(np.float32)}


def play(policy, controllers, env):
    """Compare controllers with terms, history and policy in Python, in two episodes; return the largest difference."""
    rng, worst = np.random.default_rng(3), 0.0
    history = TermHistory(1, env.observation_history, env.history_start)
    for _ in range(2):
        history.begin(slice(None))
        policy.reset()
        last = np.zeros(2)
        for controller in controllers:
            controller.begin()
        for step in range(STEPS):
            inputs = draw_inputs(rng)
            parts = {
                "gravity": TERMS["gravity"](inputs["orientation"]),
                "angles": (inputs["angles"].astype(float) - [0.1, -0.2]) * 2.0,
                "hand": inputs["hand"],
                "to_goal": inputs["goal"].astype(float) - inputs["hand"],
                "far": [np.linalg.norm(inputs["goal"].astype(float) - inputs["hand"])],
                "last": last,
                "clock": [np.sin(2 * np.pi * step * 0.1 / 0.35), np.cos(2 * np.pi * step * 0.1 / 0.35)],
                "legs": TERMS["legs"](step * 0.1),
                "euler": TERMS["euler"](inputs["orientation"]),
                "clipped": np.clip(inputs["angles"], -0.2, 0.3),
                "int": inputs["int"],
                # A row takes two steps; those of an odd number are in the middle, and 0.5 is rounded up.
                "clip": ROWS[min((step + 1) // 2, 2)],
                "off": inputs["angles"] - ROWS[min((step + 1) // 2, 2)],
                "timed": inputs["angles"] - ROWS[int(np.clip(np.floor(inputs["clip_time"][0] / 0.25 + 0.5), 0, 2))],
                "turned": TERMS["turned"]((inputs["orientation"], np.array([step * 0.1]))),
            }
            stacked = history.add({name: np.asarray(part)[None] for name, part in parts.items()}, slice(None))
            last = policy.predict(np.concatenate([np.ravel(part) for part in stacked.values()]).astype(np.float32))
            for controller in controllers:
                action, _ = controller.step(inputs)
                worst = max(worst, float(np.abs(action - last).max()))
    return worst


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize(
    ("history", "start"), [({}, "first"), ({"angles": 3, "int": 2, "last": 2}, "first"), ({"gravity": 2}, "zeros")]
)
def test_terms_and_histories(history, start, tmp_path):
    env = make_env(history, start)
    policy = make_policy(env, seed=4)
    source, in_c = build_controller(policy, tmp_path)
    onnx = OnnxController(encode(build_graph(policy, plan_of(policy))))
    assert [quantity.name for quantity in source.plan.quantities] == [
        "orientation",
        "angles",
        "hand",
        "goal",
        "int",
        "clip_time",
    ]
    assert play(Policy(NumpyActor(policy)), [in_c, onnx], env) < 1e-5
    assert in_c.may_send


@pytest.mark.slow
@needs_compiler
def test_a_stack_of_frames_and_an_lstm(small, train, write, tmp_path):
    spec = dataclasses.replace(small("vector", "box"), frame_stack=2)
    path = write(train("recurrent_ppo", spec, steps=0, policy_kwargs={"lstm_hidden_size": 8}), "recurrent_ppo", spec)
    actor = TorchActor.load(path)
    policy = Policy(actor)
    _, in_c = build_controller(actor.file, tmp_path)
    controllers = [in_c, OnnxController(encode(build_graph(actor.file, plan_of(actor.file))))]
    rng = np.random.default_rng(0)
    for _ in range(2):
        policy.reset()
        for controller in controllers:
            controller.begin()
        before = None
        for _ in range(STEPS):
            newest = rng.uniform(-2, 2, 3).astype(np.float32)
            before = newest if before is None else before
            expected = policy.predict(np.concatenate([before, newest]))
            for controller in controllers:
                assert controller.step({"observation": newest})[0] == pytest.approx(expected, abs=1e-5)
            before = newest


def commanding(**command):
    joints = dataclasses.replace(JOINTS, **command)
    return make_policy(make_env(joints=joints))


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize(
    ("command", "expected"),
    [
        # The default pose plus the scaled action; clipped to 0.4 rad.
        pytest.param({"action_scale": [0.5, 0.5]}, [0.5 + 0.5, -0.5 - 0.125], marks=pytest.mark.slow),
        ({"action_scale": [0.5, 0.5], "clips_target": True}, [0.4, -0.4]),
        ({"action_step": [0.1, 0.2], "measured": "angles"}, [0.25 + 0.1, -0.3 - 0.05]),
        # The row of the clip at the first step, plus the scaled action.
        ({"action_correction": [0.1, 0.2], "reference": "clip"}, [0.5 + 0.1, -1.0 - 0.05]),
        pytest.param({"action_speed": [2.0, 3.0]}, [2.0, -0.75], marks=pytest.mark.slow),
        pytest.param({"action_torque": [40.0, 20.0]}, [40.0, -5.0], marks=pytest.mark.slow),
    ],
)
def test_targets_by_hand(command, expected, tmp_path):
    policy = commanding(**command)
    # An action that does not depend on the observation: 1 and -0.25.
    tensors = dict(policy.tensors)
    tensors["policy/action_net.weight"] = np.zeros((2, 8), np.float32)
    tensors["policy/action_net.bias"] = np.array([7.0, -0.25], np.float32)
    policy = dataclasses.replace(policy, tensors=tensors)
    source, in_c = build_controller(policy, tmp_path)
    inputs = {**draw_inputs(np.random.default_rng(0)), "angles": np.array([0.25, -0.3], np.float32)}
    for controller in (in_c, OnnxController(encode(build_graph(policy, plan_of(policy))))):
        action, target = controller.step({name: inputs[name] for name in source_names(source)})
        assert action.tolist() == [1.0, -0.25]
        assert target == pytest.approx(expected, abs=1e-7)
    assert source.target.find_targets({name: inputs[name] for name in source_names(source)}, action) == pytest.approx(
        expected, abs=1e-7
    )


@pytest.mark.slow
@needs_compiler
def test_targets_follow_a_clip_and_stop_with_the_robot(tmp_path):
    policy = commanding(action_correction=[0.1, 0.2], reference="clip")
    source, in_c = build_controller(policy, tmp_path)
    onnx = OnnxController(encode(build_graph(policy, plan_of(policy))))
    rng = np.random.default_rng(0)
    for step in range(8):
        inputs = {name: draw_inputs(rng)[name] for name in source_names(source)}
        for controller in (in_c, onnx):
            action, target = controller.step(inputs)
            row = ROWS[min((step + 1) // 2, 2)]
            assert target == pytest.approx(row + np.array([0.1, 0.2]) * action, abs=1e-6)
            assert target == pytest.approx(source.target.find_targets(inputs, action, step), abs=1e-6)
            assert source.target.find_action(inputs, target, step) == pytest.approx(action, abs=1e-5)
    in_c.begin()
    _, first = in_c.step(inputs)
    # The clip goes on, but a robot that is stopped, or measures nothing, does not.
    for order in ("", "stop"):
        if order:
            in_c.order(order)
        for _ in range(3):
            _, target = in_c.step(inputs if order else None)
            assert target.tolist() == first.tolist()
    assert "clip (3 rows of a clip, at the time of the episode)" in source.write().header


@pytest.mark.slow
@needs_compiler
def test_the_time_in_a_clip_may_be_an_input(tmp_path):
    env = make_env(joints=dataclasses.replace(JOINTS, action_correction=0.1, reference="timed_joints"))
    timed = {**env.observation_terms, "timed_joints": terms.Playback(ROWS, 0.25, time="clip_time")}
    sizes = {**env.observation_sizes, "timed_joints": 2}
    space = space_to_json(spaces.Box(-np.inf, np.inf, (sum(sizes.values()),), np.float32))
    env = env.model_copy(update={"observation_terms": timed, "observation_sizes": sizes, "observation_space": space})
    policy = make_policy(env)
    source, in_c = build_controller(policy, tmp_path)
    onnx = OnnxController(encode(build_graph(policy, plan_of(policy))))
    for time, row in ((0.0, 0), (0.5, 2), (0.3, 1), (9.0, 2)):
        inputs = {name: draw_inputs(np.random.default_rng(1))[name] for name in source_names(source)}
        inputs["clip_time"] = np.array([time], np.float32)
        for controller in (in_c, onnx):
            action, target = controller.step(inputs)
            assert target == pytest.approx(ROWS[row] + 0.1 * action, abs=1e-6)


def source_names(source):
    return [quantity.name for quantity in source.plan.quantities]


@pytest.mark.slow
@needs_compiler
def test_what_leaves_is_finite_and_the_last_target_is_repeated(tmp_path):
    policy = commanding(action_step=[0.1, 0.2], measured="angles")
    limits = Limits.model_validate({"command": "step", "measured": {"position": "angles"}, "max_age_periods": 2})
    source, controller = build_controller(policy, tmp_path, limits)
    good = {name: draw_inputs(np.random.default_rng(0))[name] for name in source_names(source)}
    bad = {**good, "angles": np.array([np.nan, 0.0], np.float32)}
    action, target = controller.step(bad)
    assert (action.tolist(), target.tolist(), controller.may_send) == ([0.0, 0.0], [0.0, 0.0], False)
    assert controller.status == ("holding", "not finite")
    action, target = controller.step(good)
    assert controller.status == ("running", "")
    assert controller.may_send
    assert target == pytest.approx(good["angles"] + [0.1, 0.2] * action, abs=1e-6)
    for inputs, age, reason in ((None, 0.0, "missing"), (good, 0.3, "too old"), (bad, 0.0, "not finite")):
        action, again = controller.step(inputs, age)
        assert (action.tolist(), again.tolist()) == ([0.0, 0.0], target.tolist())
        assert controller.status == ("holding", reason)
    controller.order("stop")
    assert controller.step(good)[0].tolist() == [0.0, 0.0]
    assert controller.status == ("stopped", "ordered")
    controller.order("reset")
    assert controller.step(good)[0].tolist() == [0.0, 0.0]  # only `resume` ends a stop
    controller.order("resume")
    controller.step(good)
    assert controller.status == ("running", "")


@pytest.mark.slow
@needs_compiler
def test_the_last_action_is_the_limited_one(tmp_path):
    env = EnvInfo(
        observation_space=space_to_json(spaces.Box(-np.inf, np.inf, (3,), np.float32)),
        action_space=space_to_json(spaces.Box(-1.0, 1.0, (1,), np.float32)),
        observation_sizes={"place": 2, "last": 1},
        observation_terms={"last": terms.LastAction()},
        control_dt=0.1,
    )
    policy = make_policy(env, seed=1)
    source, controller = build_controller(policy, tmp_path, Limits.model_validate({"limits": {"all": {"rate": 1.0}}}))
    reference, last = Policy(NumpyActor(policy)), np.zeros(1, np.float32)
    for step in range(5):
        place = np.array([5.0 * step, -3.0], np.float32)
        wanted = reference.predict(np.concatenate([place, last]))
        action, target = controller.step({"place": place})
        assert action == pytest.approx(np.clip(wanted, last - 0.1, last + 0.1), abs=1e-6)
        assert target is None
        last = action
    assert source.target is None


def test_a_quantity_with_the_name_of_an_output():
    env = make_arm(observation_units={"target": "m"}).model_copy(
        update={"observation_sizes": {"positions": 2, "target": 3}}
    )
    policy = make_policy(env)
    model = build_graph(policy, plan_of(policy))
    assert [port.name for port in model.graph.input] == ["positions", "target_input"]
    assert {entry.key: entry.value for entry in model.metadata_props}["input_names"] == "positions,target_input"
    inputs = {"positions": np.ones(2), "target": np.zeros(3)}
    action, _ = OnnxController(encode(model)).step(inputs)
    assert action == pytest.approx(Policy(NumpyActor(policy)).predict(np.array([1, 1, 0, 0, 0], np.float32)), abs=1e-6)


def test_the_header_and_the_metadata_name_everything(tmp_path):
    policy = commanding(action_scale=[0.5, 0.5])
    code = ControllerSource(policy, plan_of(policy), "arm-1.c", None).write("A step took 1.0 us.")
    for line in (
        "A step took 1.0 us.",
        "float input_int[1];",
        "orientation[4]",
        "goal[3], no unit declared",
        "computed inside:\n *   gravity (gravity of orientation)\n *   angles ((angles - [0.1, -0.2]) * [2])\n",
        "#define ARM_1_C_CONTROL_DT 0.1",
        "double target[ARM_1_C_ACTION_SIZE]; /* rad or m, of the joints arm_1_c_action_names */",
    ):
        assert line in code.header
    model = build_graph(policy, plan_of(policy))
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    assert metadata["input_names"] == "orientation,angles,hand,goal,int,clip_time"
    assert metadata["input_sizes"] == "4,2,3,3,1,1"
    assert metadata["joint_names"] == "a,b"
    assert metadata["state"].startswith("state_action, state_steps: zeros when an episode begins")
    path = tmp_path / "controller.onnx"
    path.write_bytes(encode(model))
    with pytest.raises(ArtifactError, match="a controller takes what a robot measures; give the policy"):
        OnnxActor.load(path)


def write_code(policy, limits=None):
    return ControllerSource(policy, plan_of(policy), "c", limits).write()


def test_what_cannot_be_a_controller():
    discrete = make_arm().model_copy(update={"action_space": space_to_json(spaces.Discrete(3))})
    image = make_arm().model_copy(update={"observation_space": space_to_json(spaces.Box(0, 255, (8, 8, 3), np.uint8))})
    inner = make_arm().model_copy(
        update={"observation_terms": dict.fromkeys(("positions", "goal"), terms.LastAction())}
    )
    for env, message in (
        (discrete, "must be a vector of real numbers"),
        (image, "must be vectors"),
        (inner, "nothing"),
    ):
        with pytest.raises(UsageError, match=message):
            ControllerPlan(env)
    with pytest.raises(UsageError, match="no input has the joints' positions: 'last' is computed inside"):
        write_code(commanding(action_step=[1.0, 1.0], measured="last"))
    with pytest.raises(UsageError, match="reference: 'off' is no Playback without a quantity"):
        write_code(commanding(action_correction=0.1, reference="off"))
    wrong = Limits.model_validate({"command": "position", "scale": 0.3})
    with pytest.raises(RecipeError, match="scale and offset differ from the task's"):
        write_code(commanding(action_scale=[0.5, 0.5]), wrong)
    unknown = Limits.model_validate({"sensors": {"gravity": {"range": [-1, 1]}}})
    with pytest.raises(RecipeError, match="limits: sensors: no observation 'gravity'"):
        write_code(commanding(), unknown)


@pytest.mark.parametrize(
    ("joint_unit", "kind", "unit"),
    [("", "position", "rad or m"), ("rad", "step", "rad"), ("m", "speed", "m/s"), ("rad", "torque", "N m")],
)
def test_the_unit_of_a_command_is_that_of_the_joints(joint_unit, kind, unit):
    ones = np.ones(2)
    target = JointTarget(kind, ones, ones, 0, "", "", ones, ones, joint_unit=joint_unit)
    assert target.unit == unit
