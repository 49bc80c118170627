"""A user's own networks: their part is exported as an ONNX graph, which workers run to act."""

import io
import warnings
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.preprocessing import preprocess_obs

from rlctl.environments.dict_spaces import SINGLE, join, split, split_space
from rlctl.errors import RecipeError, describe_exception, short_repr
from rlctl.policy.actor import Rows, as_rows
from rlctl.policy.file import ACTOR_CRITIC, GRAPH, OPSET, SQUASHED_GAUSSIAN, PolicyFile, Tensors
from rlctl.policy.numpy_actor import NumpyActor
from rlctl.policy.onnx_policy import OWN_INPUT, OWN_OUTPUT
from rlctl.policy.torch_policy import ACTIVATIONS, TorchActor, is_own
from rlctl.training.privileged import has_privileged_critic

_COMPARED = 10  # number of random observations
_HEADS = {"dqn": "q_net", "td3": "actor.mu", "ddpg": "actor.mu"} | dict.fromkeys(
    SQUASHED_GAUSSIAN, "actor.mu and actor.log_std"
)
_CACHE = "rlctl_own_graph"  # attribute of a policy: its graph does not change with its weights


def has_own_parts(policy: Any) -> bool:
    """Return whether a policy is a user's own, or has its own features extractor or activation function."""
    own_activation = getattr(policy, "activation_fn", None) not in (None, *ACTIVATIONS.values())
    return own_activation or is_own(type(policy)) or is_own(policy.features_extractor_class)


def check_policy_class(model: Any, algo: str, policy: PolicyFile) -> None:
    """Raise `RecipeError` if a user's policy class acts differently from its exported graph, packed as `policy`."""
    network, name = model.policy, type(model.policy).__name__
    space = policy.info.env.spaces()[0]
    space.seed(0)
    try:
        for owner in (network, getattr(network, "actor", None)):
            for method in ("_get_action_dist_from_latent", "get_action_dist_params"):
                if (own := getattr(owner, method, None)) is not None and is_own(own):
                    raise ValueError(f"it overrides {method}")
        reference, actor = TorchActor(policy, network), NumpyActor(policy.actor_only())
        for step in range(_COMPARED):
            sample, row = as_rows(space.sample()), Rows.one(step=step)
            expected, action = reference.act(sample, row)[1][0], actor.act(sample, row)[1][0]
            if not np.allclose(action, expected, rtol=1e-4, atol=1e-5):
                raise ValueError(f"it chooses the action {short_repr(expected)}, its graph {short_repr(action)}")
    except Exception as error:  # any exception from the user's class
        raise RecipeError(
            f"policy_kwargs.policy_class: {name} cannot be exported as ONNX for acting: {short_repr(str(error), 200)}. "
            f"Change only what is before Stable-Baselines3's {_HEADS.get(algo, 'action_net')}"
        ) from error


def write_graph(model: Any, algo: str, raw_space: spaces.Space[Any]) -> Tensors:
    """Return the graph of a user's own network, as a tensor of a policy file; empty for SB3's networks."""
    policy = model.policy
    if not has_own_parts(policy):
        return {}
    if not hasattr(policy, _CACHE):
        setattr(policy, _CACHE, _write_graph(_Actor(policy, algo, raw_space), model))
    return {GRAPH: getattr(policy, _CACHE)}


class _Actor(torch.nn.Module):
    """Maps the normalised parts of raw observations to the last hidden layer, for recurrent PPO to the LSTM's input."""

    def __init__(self, policy: Any, algo: str, raw_space: spaces.Space[Any]) -> None:
        super().__init__()
        self.prefixes = {"extractor.": "pi_features_extractor.", "trunk.": "mlp_extractor."}
        owner, trunk = policy, "mlp_extractor"
        if algo in ACTOR_CRITIC or algo == "dqn":
            name = "q_net" if algo == "dqn" else "actor"
            owner, trunk = getattr(policy, name), {"dqn": "q_net", "td3": "mu", "ddpg": "mu"}.get(algo, "latent_pi")
            self.prefixes = {"extractor.": f"{name}.features_extractor.", "trunk.": f"{name}.{trunk}."}
        extractor = owner.pi_features_extractor if owner is policy else owner.features_extractor
        self.extractor = extractor.inner if has_privileged_critic(policy) else extractor
        self.trunk = None if algo == "recurrent_ppo" else getattr(owner, trunk)
        self.parts = split_space(raw_space)
        self._space = raw_space if has_privileged_critic(policy) else policy.observation_space
        self._normalize_images = policy.normalize_images

    def compute_features(self, *parts: torch.Tensor) -> torch.Tensor:
        network_spaces = split_space(self._space)
        arranged = {
            key: value if value.shape[1:] == (network_spaces[key].shape or ()) else value.permute(0, 3, 1, 2)
            for key, value in zip(self.parts, parts, strict=True)
        }
        observation: Any = preprocess_obs(join(arranged), self._space, normalize_images=self._normalize_images)
        return self.extractor(observation)

    def forward(self, *parts: torch.Tensor) -> torch.Tensor:
        features = self.compute_features(*parts)
        if self.trunk is None:
            return features
        return getattr(self.trunk, "forward_actor", self.trunk)(features)


def _write_graph(actor: _Actor, model: Any) -> NDArray[np.uint8]:
    was_training = model.policy.training
    model.policy.set_training_mode(False)
    normalizer = model.get_vec_normalize_env()
    normalized = split(normalizer.obs_rms) if normalizer is not None and normalizer.norm_obs else {}
    types = {key: np.float32 if key in normalized else part.dtype for key, part in actor.parts.items()}
    batch_of_two = tuple(
        torch.from_numpy(np.zeros((2, *(part.shape or ())), types[key])).to(model.device)
        for key, part in actor.parts.items()
    )
    try:
        with torch.no_grad():
            shape, expected = tuple(actor.compute_features(*batch_of_two).shape), (2, actor.extractor.features_dim)
        if shape != expected:
            raise ValueError(f"features of shape {shape} for 2 observations; features_dim requires {expected}")
        return _export(actor, batch_of_two)
    except Exception as error:  # any exception from the user's module or torch's exporter
        name, problem = type(actor.extractor).__name__, short_repr(describe_exception(error), 300)
        raise RecipeError(f"policy_kwargs: {name} cannot be used: {problem}") from error
    finally:
        model.policy.set_training_mode(was_training)


def _export(actor: _Actor, sample: tuple[torch.Tensor, ...]) -> NDArray[np.uint8]:
    import onnx

    names = [f"{OWN_INPUT}{'' if key == SINGLE else key}" for key in actor.parts]
    file = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter is deprecated, but the new one needs onnxscript
        torch.onnx.export(
            actor,
            sample,
            file,
            dynamo=False,
            opset_version=OPSET,
            input_names=names,
            output_names=[OWN_OUTPUT],
            dynamic_axes={name: {0: "batch"} for name in [*names, OWN_OUTPUT]},
            keep_initializers_as_inputs=True,
            do_constant_folding=False,
        )
    proto = onnx.load_from_string(file.getvalue())
    _take_weights_out(proto.graph, actor)
    return np.frombuffer(proto.SerializeToString(), np.uint8).copy()


def _take_weights_out(graph: Any, actor: _Actor) -> None:
    """Turn the weights into inputs without values, named as the tensors of a policy file."""
    renamed = {}
    for tensor in graph.initializer:
        begin = next((begin for begin in actor.prefixes if tensor.name.startswith(begin)), None)
        if begin is not None:
            renamed[tensor.name] = f"policy/{actor.prefixes[begin]}{tensor.name.removeprefix(begin)}"
    constants = {tensor.name: tensor for tensor in graph.initializer if tensor.name not in renamed}
    inputs = [port for port in graph.input if port.name not in constants]
    del graph.initializer[:], graph.input[:]
    graph.initializer.extend(constants.values())
    graph.input.extend(inputs)
    for port in graph.input:
        port.name = renamed.get(port.name, port.name)
    for node in graph.node:
        node.input[:] = [renamed.get(name, name) for name in node.input]
