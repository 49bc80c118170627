"""What an ONNX file says about itself: everything for rlctl, and plain text for people who write C++."""

from __future__ import annotations

from gymnasium import spaces

from rlctl.joints import Joints
from rlctl.run.onnx_file import METADATA_KEY
from rlctl.run.policy import PolicyInfo


def metadata(info: PolicyInfo) -> dict[str, str]:
    """Return the metadata of a policy's ONNX file.

    Under `rlctl` the whole description as JSON. The other keys repeat what somebody needs who runs the file
    elsewhere: lists are separated by commas, in the order of the observation's or the action's elements.
    """
    env = info.env
    plain = {
        "task": info.spec.task,
        "algorithm": info.algo,
        "training_steps": str(info.training_steps),
        "observation_names": ",".join(env.observation_sizes),
        "observation_sizes": ",".join(str(size) for size in env.observation_sizes.values()),
        "observation_units": ",".join(env.observation_units.get(name, "") for name in env.observation_sizes),
        "frame_stack": str(info.spec.frame_stack),
        "action_meaning": env.action_meaning,
        **_format_bounds(info),
        **_format_joints(info.env.joints),
        "control_dt": "" if env.control_dt is None else f"{env.control_dt!r} s",
        "robot": env.robot,
        "state": "state_h and state_c: zeros when an episode begins" if info.algo == "recurrent_ppo" else "",
        "versions": ", ".join(f"{name} {version}" for name, version in info.versions.items()),
    }
    return {METADATA_KEY: info.model_dump_json(), **{key: value for key, value in plain.items() if value.strip(",")}}


def _format_joints(joints: Joints | None) -> dict[str, str]:
    """Return the keys that the controllers of mjlab and BeyondMimic read, and in that form: values and commas."""
    if joints is None:
        return {}
    numbers = {
        "default_joint_pos": joints.default_positions,
        "action_scale": joints.action_scale,
        "joint_stiffness": joints.stiffness,
        "joint_damping": joints.damping,
        "joint_pos_lower": joints.low,
        "joint_pos_upper": joints.high,
        "joint_max_velocity": joints.max_speed,
        "joint_max_effort": joints.max_torque,
    }
    names = {"joint_names": ",".join(joints.names)}
    return names | {key: ",".join(f"{value:.9g}" for value in values) for key, values in numbers.items()}


def _format_bounds(info: PolicyInfo) -> dict[str, str]:
    space = info.env.spaces()[1]
    if not isinstance(space, spaces.Box):
        return {"action_space": str(space)}
    return {
        "action_low": ",".join(f"{value:.9g}" for value in space.low.ravel().tolist()),
        "action_high": ",".join(f"{value:.9g}" for value in space.high.ravel().tolist()),
    }


def describe(info: PolicyInfo) -> str:
    """Return a sentence on the graph, for those who open the file in a viewer."""
    return (
        f"{info.algo} policy for {info.spec.task} after {info.training_steps} steps: raw observations in, "
        "deterministic action out; normalisation and the action's bounds are inside"
    )
