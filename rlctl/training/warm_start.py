"""`rlctl train TASK --from POLICY`: starts with the weights and the normalisation of a policy."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydantic_core import to_jsonable_python

from rlctl.environments import installed
from rlctl.environments.info import EnvInfo
from rlctl.errors import UsageError
from rlctl.policy.file import PolicyFile, PolicyInfo, list_actor_tensors
from rlctl.policy.shipped import PRETRAINED
from rlctl.recipe.recipe import Recipe
from rlctl.runs.lookup import find_policy
from rlctl.task.deployment import NOT_TRAINED, TASKS

# With other values the same tensors compute other actions.
_SAME_FUNCTION = ("activation_fn", "use_sde", "squash_output", "use_expln", "clip_mean", "batch_norm_eps")
_TARGETS = {"td3": ("actor.", "actor_target."), "ddpg": ("actor.", "actor_target."), "dqn": ("q_net.", "q_net_target.")}


def find_source(text: str, recipe: Recipe) -> dict[str, Any]:
    """Find the policy of a run, a file, or a task that ships one; return the entry `from` of `run.json`."""
    if Path(text).suffix == ".onnx":
        raise UsageError(f"--from {text}: ONNX files cannot be trained further; give the run or its .safetensors file")
    ships = installed.find(text) is not None and not (Path(text) / "run.json").is_file()
    file = find_policy(text, PRETRAINED if ships else "best").file
    info = PolicyFile.read_info(file)
    if info.spec.task in TASKS:
        raise UsageError(f"--from {file}: {NOT_TRAINED}")
    if info.algo != recipe.algo:
        raise UsageError(
            f"--from {file}: the policy was trained with {info.algo}, the recipe uses {recipe.algo}; "
            f"add --algo {info.algo}, or give another policy"
        )
    source = {"policy": str(file.resolve()), "task": info.spec.task, "algo": info.algo}
    return source | {"training_steps": info.training_steps}


def load_source(source: Mapping[str, Any], model: Any, env: EnvInfo) -> str:
    """Load weights and normalisation of `find_source`'s policy into a model; return a message for the user.

    Raises `ArtifactError` if the spaces differ, `UsageError` if the network or normalisation differs.
    """
    file = Path(source["policy"])
    policy = PolicyFile.read(file)
    info = policy.info
    info.check_fits(env, file)
    from rlctl.training.privileged import read_privileged

    has_critic = len(policy.actor_only().tensors) < len(policy.tensors)
    privileged = read_privileged(model.policy)
    if has_critic and info.privileged != privileged:
        there, here = (", ".join(names) or "nothing else" for names in (info.privileged, privileged))
        raise UsageError(
            f"--from {file}: its critic saw {there} besides the actor's observation, the recipe's sees {here}: "
            "make the key privileged of the recipe the same"
        )
    _check_network(file, info, model, policy.weights)
    _load_weights(info, model, policy.weights)
    _load_normalization(file, info, model, policy.tensors)
    text = f"starts from {file} ({info.algo}, {info.training_steps:,} steps on {info.spec.task})"
    if has_critic:
        return f"{text}: its actor, critic and normalisation"
    return (
        f"{text}: its actor and normalisation; it has no critic, so training starts with a new one: the first "
        "updates may lower the score"
    )


def _check_network(file: Path, info: PolicyInfo, model: Any, weights: Mapping[str, Any]) -> None:
    from rlctl.policy.torch_policy import describe_network
    from rlctl.training.privileged import name_as_sb3

    ours = describe_network(model.policy)
    state = {name_as_sb3(name): tensor for name, tensor in model.policy.state_dict().items()}
    network = {f"policy/{name}": tuple(tensor.shape) for name, tensor in state.items()}
    given = {f"policy/{name}": tensor.shape for name, tensor in weights.items()}
    wrong = [name for name, shape in given.items() if network.get(name) != shape]
    wrong += [name for name in list_actor_tensors(info.algo, list(network)) if name not in given]
    keys = dict.fromkeys([*info.policy_kwargs, *ours]) if wrong else _SAME_FUNCTION
    parts = [
        f"policy_kwargs.{key} is {info.policy_kwargs.get(key)} in the policy and {ours.get(key)} in the recipe"
        for key in keys
        if to_jsonable_python(info.policy_kwargs.get(key)) != to_jsonable_python(ours.get(key))  # tuples are lists
    ]
    if wrong or parts:
        raise UsageError(f"--from {file}: its network differs: {'; '.join(parts) or f'tensor {wrong[0]} differs'}")


def _load_weights(info: PolicyInfo, model: Any, weights: Mapping[str, Any]) -> None:
    import torch

    from rlctl.training.privileged import name_as_sb3

    state = {name: torch.from_numpy(tensor.copy()) for name, tensor in weights.items()}
    actor, target = _TARGETS.get(info.algo, ("", ""))
    if actor and not any(name.startswith(target) for name in state):
        state |= {target + name.removeprefix(actor): tensor for name, tensor in state.items() if name.startswith(actor)}
    named = {name: state[found] for name in model.policy.state_dict() if (found := name_as_sb3(name)) in state}
    model.policy.load_state_dict(named, strict=False)  # the critic may be missing


def _load_normalization(file: Path, info: PolicyInfo, model: Any, tensors: Mapping[str, Any]) -> None:
    from rlctl.training.snapshot import observation_statistics

    normalizer = model.get_vec_normalize_env()
    statistics = observation_statistics(normalizer)
    if list(statistics) != info.normalized_keys:
        there, here = (
            "normalises" if normalizer else "does not normalise" for normalizer in (info.normalized_keys, statistics)
        )
        raise UsageError(
            f"--from {file}: it {there} observations, and the recipe {here} them; "
            f"add --set normalize.observation={str(bool(info.normalized_keys)).lower()}"
        )
    if statistics and normalizer.clip_obs != info.clip_observation:
        raise UsageError(
            f"--from {file}: it clips observations at {info.clip_observation:g}, the recipe at "
            f"{normalizer.clip_obs:g}; add --set normalize.clip_observation={info.clip_observation:g}"
        )
    for key, moments in statistics.items():
        steps = max(float(info.training_steps), 1.0)  # number of observations so far
        for name, values in (("mean", moments.mean), ("var", moments.var)):
            actor, critic = tensors[f"normalize/{key}/{name}"], tensors.get(f"critic/{name}")
            values[...] = np.concatenate([actor, values[len(actor) :] if critic is None else critic])
        of_critic = "critic/mean" in tensors or len(actor) == len(values)
        # What a shipped policy's critic saw is not known: the statistics of these elements start again.
        seen = np.arange(len(values)) < len(actor)
        moments.count = steps if of_critic else np.where(seen, steps, moments.count)  # type: ignore[assignment]
