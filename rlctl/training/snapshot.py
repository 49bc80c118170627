"""Saves and restores the model's state as tensors and plain data; packs its policy."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sb3_contrib.common.recurrent.type_aliases import RNNStates
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize

from rlctl.environments.dict_spaces import split
from rlctl.environments.info import EnvInfo
from rlctl.environments.registry import find_origin
from rlctl.environments.spec import EnvSpec
from rlctl.errors import ArtifactError, DivergedError
from rlctl.policy.file import PolicyFile, PolicyInfo
from rlctl.policy.torch_policy import describe_network, policy_name
from rlctl.training.own_networks import write_graph
from rlctl.training.privileged import has_privileged_critic, name_as_sb3, read_privileged
from rlctl.version import collect_versions

Tensors = dict[str, NDArray[Any]]

_COUNTERS = (
    "num_timesteps", "_n_updates", "_episode_num", "_n_calls", "exploration_rate", "_current_progress_remaining",
)  # fmt: skip
# Other values may be NaN without a fault, e.g. the explained variance if rewards are constant.
_MUST_BE_FINITE = ("loss", "value_loss", "policy_gradient_loss", "policy_loss", "actor_loss", "critic_loss")


def pack(model: BaseAlgorithm, algo: str, spec: EnvSpec, env: EnvInfo) -> PolicyFile:
    """Return a copy of a model's policy, with its current normalisation."""
    normalizer = model.get_vec_normalize_env()
    statistics = observation_statistics(normalizer)
    state = {name_as_sb3(name): value for name, value in model.policy.state_dict().items()}
    tensors = {f"policy/{key}": value.cpu().numpy().copy() for key, value in state.items()}
    for key, rms in statistics.items():
        for part, values in (("mean", rms.mean), ("var", rms.var)):
            actor = select_actor(values, model.policy)
            tensors[f"normalize/{key}/{part}"] = actor.copy()
            if len(actor) < len(values):  # not needed to act
                tensors[f"critic/{part}"] = values[len(actor) :].copy()
    info = PolicyInfo(
        algo=algo,
        policy=policy_name(algo, env.spaces()[0]),
        policy_kwargs=describe_network(model.policy),
        clip_observation=normalizer.clip_obs if normalizer is not None and statistics else None,
        normalized_keys=list(statistics),
        privileged=read_privileged(model.policy),
        env=env,
        spec=spec,
        training_steps=model.num_timesteps,
        versions=collect_versions(),
        origin=find_origin(spec.task),
    )
    return PolicyFile(info, {**tensors, **write_graph(model, algo, env.spaces()[0])})


def select_actor(values: NDArray[Any], policy: Any) -> NDArray[Any]:
    """Return the part of the elements of an observation that the actor of a policy sees, which comes first."""
    return values[: policy.actor_size] if has_privileged_critic(policy) else values


def observation_statistics(normalizer: VecNormalize | None) -> dict[str, RunningMeanStd]:
    """Return the running statistics per observation key; the key is "" if the observation is not a dict."""
    if normalizer is None or not normalizer.norm_obs:
        return {}
    return split(normalizer.obs_rms)


def learned_tensors(model: BaseAlgorithm) -> tuple[Tensors, Any]:
    """Return all learned tensors of a model and its normalisation, and the structure of its state dicts."""
    weights, structure = flatten(model.get_parameters(), "parameters")
    variables = {name: _array(tensor) for name, tensor in _variables(model).items()}
    return weights | variables | _normalizer_tensors(model), structure


def take(model: BaseAlgorithm) -> tuple[Tensors, dict[str, Any]]:
    """Return the state of a model at a boundary between updates."""
    tensors, structure = learned_tensors(model)
    counters = {name: getattr(model, name) for name in _COUNTERS if hasattr(model, name)}
    tensors |= _randomness_tensors(model.device) | _rollout_tensors(model)
    return tensors, {"counters": counters, "parameters": structure}


def restore(model: BaseAlgorithm, tensors: Tensors, plain: dict[str, Any]) -> None:
    """Restore the state that `take` returned; raises `ArtifactError` if it does not fit the model."""
    try:
        model.set_parameters(unflatten(plain["parameters"], tensors), exact_match=True, device=model.device)
        for name, variable in _variables(model).items():
            variable.copy_(torch.from_numpy(tensors[name].copy()))  # in place: the optimiser holds the same tensor
        _restore_normalizer(model, tensors)
        _restore_rollout(model, tensors)
        for name in plain["counters"].keys() & set(_COUNTERS):  # only these: a file must not choose attributes to set
            setattr(model, name, plain["counters"][name])
        # The generators that updates draw from; gSDE's matrices are drawn again by updates.
        torch.set_rng_state(torch.from_numpy(tensors["randomness/torch"].copy()))
        if (state := tensors.get(f"randomness/{model.device.type}")) is not None:  # not after a change of the device
            torch.get_device_module(model.device).set_rng_state(torch.from_numpy(state.copy()), model.device)
        keys, position, has_gauss, cached = (tensors[f"randomness/numpy/{part}"] for part in _NUMPY)
        np.random.set_state(("MT19937", keys, int(position), int(has_gauss), float(cached)))  # noqa: NPY002 (SB3 draws there)
    except (KeyError, ValueError, RuntimeError, TypeError, AttributeError) as error:
        raise ArtifactError(f"does not fit this recipe: {' '.join(str(error).split())[:200]}") from None


_NUMPY = ("keys", "position", "has_gauss", "cached")


def _randomness_tensors(device: torch.device) -> Tensors:
    _, *state = np.random.get_state()  # noqa: NPY002 (SB3 draws from it)
    tensors = {f"randomness/numpy/{part}": np.asarray(value) for part, value in zip(_NUMPY, state, strict=True)}
    tensors["randomness/torch"] = torch.get_rng_state().numpy()
    if device.type != "cpu":  # its own generator: updates and exploration draw there
        tensors[f"randomness/{device.type}"] = torch.get_device_module(device).get_rng_state(device).numpy()
    return tensors


def _array(tensor: torch.Tensor) -> NDArray[Any]:
    return tensor.detach().cpu().numpy()


def flatten(value: Any, path: str) -> tuple[Tensors, Any]:
    """Split nested dicts and lists into tensors by path, and JSON that refers to them; `TypeError` for others."""
    if isinstance(value, torch.Tensor):
        return {path: _array(value)}, {"tensor": path}
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        return {path: value.copy()}, {"array": path}
    if isinstance(value, dict) and all(isinstance(key, str | int) for key in value):
        tensors: Tensors = {}
        entries = []
        for key, item in value.items():
            below, structure = flatten(item, f"{path}/{key}")
            tensors.update(below)
            entries.append([key, structure])
        return tensors, {"dict": entries}
    if isinstance(value, list | tuple):
        below, structure = flatten(dict(enumerate(value)), path)
        return below, {"list" if isinstance(value, list) else "tuple": [item for _, item in structure["dict"]]}
    if isinstance(value, np.generic):
        value = value.item()
    if value is not None and not isinstance(value, bool | int | float | str):
        raise TypeError(f"{path} is a {type(value).__name__}")
    return {}, {"value": value}


def unflatten(structure: Any, tensors: Tensors) -> Any:
    """Return what `flatten` split."""
    ((kind, content),) = structure.items()
    if kind == "array":
        return tensors[content].copy()
    if kind == "tensor":
        return torch.from_numpy(tensors[content].copy())
    if kind == "dict":
        return {key: unflatten(item, tensors) for key, item in content}
    if kind in ("list", "tuple"):
        items = [unflatten(item, tensors) for item in content]
        return items if kind == "list" else tuple(items)
    return content


def _variables(model: BaseAlgorithm) -> dict[str, torch.Tensor]:
    """Return what SB3 trains besides the networks: SAC's entropy coefficient, which `get_parameters` omits."""
    _, names = model._get_torch_save_params()
    return {f"variables/{name}": getattr(model, name).data for name in names}


def _normalizer_tensors(model: BaseAlgorithm) -> Tensors:
    normalizer = model.get_vec_normalize_env()
    if normalizer is None:
        return {}
    tensors: Tensors = {"normalize/returns": normalizer.returns}
    for key, rms in {**observation_statistics(normalizer), "return": normalizer.ret_rms}.items():
        tensors |= {f"normalize/{key}/{part}": np.asarray(getattr(rms, part)) for part in ("mean", "var", "count")}
    return tensors


def _restore_normalizer(model: BaseAlgorithm, tensors: Tensors) -> None:
    normalizer = model.get_vec_normalize_env()
    if normalizer is None:
        return
    normalizer.returns = tensors["normalize/returns"].copy()
    for key, rms in {**observation_statistics(normalizer), "return": normalizer.ret_rms}.items():
        rms.mean, rms.var = (tensors[f"normalize/{key}/{part}"].copy() for part in ("mean", "var"))
        count = tensors[f"normalize/{key}/count"]
        rms.count = count.copy() if count.ndim else float(count)  # type: ignore[assignment]


def _rollout_tensors(model: BaseAlgorithm) -> Tensors:
    tensors: Tensors = {"rollout/starts": np.asarray(model._last_episode_starts)}
    states: Any = getattr(model, "_last_lstm_states", None)
    for kind, pair in zip(("pi", "vf"), states or (), strict=False):
        tensors |= {f"rollout/lstm/{kind}/{index}": _array(state) for index, state in enumerate(pair)}
    return tensors


def _restore_rollout(model: BaseAlgorithm, tensors: Tensors) -> None:
    model._last_episode_starts = tensors["rollout/starts"].copy()
    if getattr(model, "_last_lstm_states", None) is not None:
        pairs = [
            tuple(torch.from_numpy(tensors[f"rollout/lstm/{kind}/{index}"].copy()).to(model.device) for index in (0, 1))
            for kind in ("pi", "vf")
        ]
        model._last_lstm_states = RNNStates(*pairs)  # type: ignore[attr-defined]


def check_finite(model: BaseAlgorithm, run: Path) -> None:
    """Raise `DivergedError`, which names `run`, if a loss or a learned number is not finite."""
    tensors, _ = learned_tensors(model)
    losses = {name: np.array(model.logger.name_to_value.get(f"train/{name}", 0.0)) for name in _MUST_BE_FINITE}
    for name, values in {**tensors, **losses}.items():
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            raise DivergedError(
                f"training diverged: {name.replace('/', ' ')} is not finite at step {model.num_timesteps:,}. Try "
                f"a smaller algo_kwargs.learning_rate or smaller rewards.\nThe last saved state is in {run}"
            )
