"""The parameters of the networks of every algorithm, `policy_kwargs`: SB3's names, with the type and range of each."""

import math
from typing import Annotated, Any, Literal

from pydantic import Field, PlainSerializer, ValidationInfo, WrapValidator, field_validator

from rlctl.recipe.hyperparameters import Parameters
from rlctl.storage.validation import Number, Switch, Whole

_Width = Annotated[Whole, Field(ge=1, le=65_536)]
_Few = Annotated[Whole, Field(ge=1, le=100)]
_Layers = Annotated[list[_Width], Field(max_length=100)]
_PositiveFraction = Annotated[Number, Field(gt=0, le=1)]


def _widths(default: str, *examples: str) -> Any:
    return Field(None, examples=list(examples) or None, json_schema_extra={"default_text": default})


class _FeaturesExtractor(Parameters):
    features_dim: _Width = 512
    """Number of features of an image (NatureCNN)."""
    cnn_output_dim: _Width = 256
    """Number of features per image of a dict observation."""
    normalized_image: Switch = False
    """Whether the values of images are already in [0, 1]."""


class _Lstm(Parameters):
    dropout: Annotated[Number, Field(ge=0, le=0.99)] = 0.0
    """Dropout between layers."""
    bias: Switch = True
    """Whether the layers have a bias."""


class _ActorAndValue(Parameters):
    pi: _Layers
    vf: _Layers


class _ActorAndCritic(Parameters):
    pi: _Layers
    qf: _Layers


def _accept_arguments(value: Any, check: Any, info: ValidationInfo) -> Any:
    return value if isinstance(value, dict) and info.data.get("features_extractor_class") else check(value)


def _to_plain(value: Any) -> Any:
    return value.model_dump(mode="json", exclude_unset=True) if isinstance(value, Parameters) else value


_OwnClass = Annotated[str, Field(pattern=r"^[^:]+:\w+$", json_schema_extra={"text": "FILE.py:CLASS or MODULE:CLASS"})]
Activation = Literal["tanh", "relu", "elu", "silu"] | _OwnClass


class _Network(Parameters):
    activation_fn: Activation = "relu"
    """Activation function of the hidden layers, or a class of torch or your own."""
    policy_class: _OwnClass | None = None
    """Your own policy: a subclass of SB3's policy of this algorithm, such as ActorCriticPolicy or SACPolicy."""
    features_extractor_class: _OwnClass | None = None
    """Your own features extractor before the layers of `net_arch`: a subclass of SB3's BaseFeaturesExtractor."""
    features_extractor_kwargs: Annotated[
        _FeaturesExtractor | None, WrapValidator(_accept_arguments), PlainSerializer(_to_plain)
    ] = None
    """For images: `features_dim`, `cnn_output_dim`, `normalized_image`; or the arguments of your own class."""


class QNetwork(_Network):
    """The network of DQN."""

    net_arch: _Layers | None = _widths("[64, 64]; [] for images")
    """Widths of the hidden layers."""


class ActorCritic(_Network):
    """The networks of PPO and A2C."""

    net_arch: _Layers | _ActorAndValue | None = _widths(
        "[64, 64]; [] for images", "[64, 64]", "{pi: [64, 64], vf: [64, 64]}"
    )
    """Widths of the hidden layers, of the actor (`pi`) and the value function (`vf`)."""
    activation_fn: Activation = "tanh"
    ortho_init: Switch = True
    """Orthogonal initialisation."""
    log_std_init: Annotated[Number, Field(ge=-20, le=10)] = 0.0
    """Logarithm of the initial standard deviation of the actions."""
    full_std: Switch = True
    """With gSDE: a standard deviation per feature and action, instead of one per feature."""
    use_expln: Switch = False
    """With gSDE: expln() instead of exp() for the standard deviation."""
    squash_output: Switch = False
    """With gSDE: apply tanh to the action."""
    share_features_extractor: Switch = True
    """Whether actor and value function share their features extractor."""


class RecurrentActorCritic(ActorCritic):
    """The networks of recurrent PPO."""

    lstm_hidden_size: _Width = 256
    """Units per LSTM layer."""
    n_lstm_layers: _Few = 1
    """LSTM layers."""
    shared_lstm: Switch = False
    """Whether actor and value function share one LSTM."""
    enable_critic_lstm: Switch = True
    """Whether the value function has an LSTM."""
    lstm_kwargs: _Lstm | None = None
    """Further arguments of torch's LSTM: `dropout`, `bias`."""


class TwinCritics(_Network):
    """The networks of TD3 and DDPG."""

    net_arch: _Layers | _ActorAndCritic | None = _widths(
        "[400, 300]; [256, 256] for images", "[256, 256]", "{pi: [256, 256], qf: [256, 256]}"
    )
    """Widths of the hidden layers, of the actor (`pi`) and the critics (`qf`)."""
    n_critics: _Few = 2
    """Number of critics; their minimum is used."""
    share_features_extractor: Switch = False
    """Whether actor and critics share their features extractor."""


class DdpgNetwork(TwinCritics):
    """The networks of DDPG."""

    n_critics: _Few = Field(2, json_schema_extra={"default_text": "1"})


class SquashedActor(TwinCritics):
    """The networks of SAC."""

    net_arch: _Layers | _ActorAndCritic | None = _widths("[256, 256]", "[256, 256]", "{pi: [256, 256], qf: [256, 256]}")
    log_std_init: Annotated[Number, Field(ge=-20, le=10)] = -3.0
    """With gSDE: logarithm of the initial standard deviation of the actions."""
    use_expln: Switch = False
    """With gSDE: expln() instead of exp() for the standard deviation."""
    clip_mean: Annotated[Number, Field(ge=0)] = 2.0
    """With gSDE: bound of the mean action before tanh."""


class QuantileCritics(SquashedActor):
    """The networks of TQC."""

    n_quantiles: Annotated[Whole, Field(ge=1, le=10_000)] = 25
    """Quantiles per critic."""


class BatchNormCritics(SquashedActor):
    """The networks of CrossQ."""

    net_arch: _Layers | _ActorAndCritic | None = _widths(
        "{pi: [256, 256], qf: [1024, 1024]}", "[256, 256]", "{pi: [256, 256], qf: [1024, 1024]}"
    )
    batch_norm: Switch = True
    """Whether to use batch normalisation."""
    batch_norm_momentum: _PositiveFraction = 0.01
    """Weight of a new batch in the running statistics."""
    batch_norm_eps: _PositiveFraction = 0.001
    """Small number added to the variance."""
    renorm_warmup_steps: Annotated[Whole, Field(ge=0, le=10**9)] = 100_000
    """Gradient steps before batch renormalisation begins."""


class CategoricalCritics(BatchNormCritics):
    """The networks of XQC: the actor of CrossQ, and categorical critics."""

    net_arch: _Layers | _ActorAndCritic | None = _widths(
        "[256, 256]", "[256, 256]", "{pi: [256, 256], qf: [512, 512, 512, 512]}"
    )
    n_atoms: Annotated[Whole, Field(ge=2, le=10_000)] = 101
    """Returns whose probabilities a critic estimates."""
    v_min: Number = -5.0
    """The lowest of these returns, of normalised rewards."""
    v_max: Number = Field(5.0, validate_default=True)
    """The highest of these returns; above `v_min`."""

    @field_validator("v_max")
    @classmethod
    def _check_bounds(cls, v_max: float, others: ValidationInfo) -> float:
        if v_max <= (v_min := others.data.get("v_min", -math.inf)):
            raise ValueError(f"{v_max:g} is not above v_min, {v_min:g}")
        return v_max


NETWORK_PARAMETERS: dict[str, type[Parameters]] = {
    "ppo": ActorCritic,
    "a2c": ActorCritic,
    "sac": SquashedActor,
    "td3": TwinCritics,
    "ddpg": DdpgNetwork,
    "dqn": QNetwork,
    "tqc": QuantileCritics,
    "crossq": BatchNormCritics,
    "xqc": CategoricalCritics,
    "recurrent_ppo": RecurrentActorCritic,
}
