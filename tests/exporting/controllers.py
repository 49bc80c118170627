"""Small policies and controllers, made without a training."""

import numpy as np
from gymnasium import spaces

from rlctl.environments.info import EnvInfo, space_to_json
from rlctl.environments.spec import EnvSpec
from rlctl.exporting.c_source import find_compiler
from rlctl.exporting.controller.controllers import CController, compile_controller
from rlctl.exporting.controller.plan import ControllerPlan
from rlctl.exporting.controller.source import ControllerSource
from rlctl.policy.file import PolicyFile, PolicyInfo


def make_policy(env, seed=0, scale=1.0, **fields):
    """A PPO policy of 8 hidden units for an environment's description, with random weights."""
    observation, action = env.spaces()
    size, count = observation.shape[0], action.shape[0]
    rng = np.random.default_rng(seed)
    shapes = {
        "mlp_extractor.policy_net.0.weight": (8, size),
        "mlp_extractor.policy_net.0.bias": (8,),
        "action_net.weight": (count, 8),
        "action_net.bias": (count,),
        "log_std": (count,),
    }
    tensors = {
        f"policy/{name}": rng.normal(scale=scale, size=shape).astype(np.float32) for name, shape in shapes.items()
    }
    spec = fields.pop("spec", EnvSpec("reach"))
    info = PolicyInfo(algo="ppo", policy="MlpPolicy", policy_kwargs={"net_arch": [8]}, env=env, spec=spec, **fields)
    return PolicyFile(info, tensors)


def make_arm(low=-10.0, high=10.0, dtype=np.float32, **fields):
    """An arm of two joints that observes their positions and a goal; a control step takes 0.1 s."""
    return EnvInfo(
        observation_space=space_to_json(spaces.Box(-np.inf, np.inf, (5,), np.float32)),
        action_space=space_to_json(spaces.Box(low, high, (2,), dtype)),
        observation_sizes={"positions": 2, "goal": 3},
        control_dt=0.1,
        **fields,
    )


def plan_of(policy):
    """Return what a policy's controller takes, computes and returns."""
    return ControllerPlan(policy.info.env, policy.info.spec.frame_stack)


def build_controller(policy, folder, limits=None, name="controller"):
    """Write a controller and compile it; warnings are errors. Return its source and what acts."""
    source = ControllerSource(policy, plan_of(policy), name, limits)
    strict = [*find_compiler(), "-Werror", "-Wdouble-promotion"]
    library = compile_controller(source.write(), folder, strict)
    return source, CController(source.plan, library, has_target=source.target is not None)
