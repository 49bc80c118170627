"""From an SB3 model to a policy file's content."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize

from rlctl.dict_spaces import split
from rlctl.env_spec import EnvSpec
from rlctl.run.env_info import EnvInfo
from rlctl.run.policy import PolicyInfo, collect_versions
from rlctl.run.torch_policy import describe_network, policy_name


def pack(model: BaseAlgorithm, algo: str, spec: EnvSpec, env: EnvInfo) -> tuple[PolicyInfo, dict[str, NDArray[Any]]]:
    """Return description and tensors of a model's policy, with the normalisation it has now.

    The arrays are copies: training may go on.
    """
    tensors = {f"policy/{key}": value.cpu().numpy().copy() for key, value in model.policy.state_dict().items()}
    statistics = observation_statistics(model.get_vec_normalize_env())
    for key, rms in statistics.items():
        tensors[f"normalize/{key}/mean"] = rms.mean.copy()
        tensors[f"normalize/{key}/var"] = rms.var.copy()
    normalizer = model.get_vec_normalize_env()
    info = PolicyInfo(
        algo=algo,
        policy=policy_name(algo, env.spaces()[0]),
        policy_kwargs=describe_network(model.policy),
        clip_observation=normalizer.clip_obs if normalizer is not None and statistics else None,
        normalized_keys=list(statistics),
        env=env,
        spec=spec,
        training_steps=model.num_timesteps,
        versions=collect_versions(),
    )
    return info, tensors


def observation_statistics(normalizer: VecNormalize | None) -> dict[str, RunningMeanStd]:
    """Return the running statistics per observation key, "" for an observation that is no dict."""
    if normalizer is None or not normalizer.norm_obs:
        return {}
    return split(normalizer.obs_rms)
