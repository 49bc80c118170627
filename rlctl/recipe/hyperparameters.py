"""The parameters of every algorithm, `algo_kwargs`: SB3's names, with the type and range of each.

Names and defaults are compared with SB3's signatures by a test; `docs/recipe.md` is generated from these models.
"""

from typing import Annotated, Any, Literal

from pydantic import Field

from rlctl.storage.validation import Number, NumberAfter, Section, Switch, Whole

LINEAR = "lin_"
"""Before the first value of a schedule that falls linearly to zero: `lin_3e-4`."""
ON_POLICY = frozenset({"ppo", "a2c", "recurrent_ppo"})

_Fraction = Annotated[Number, Field(ge=0, le=1)]
_ShareBelow1 = Annotated[Number, Field(ge=0, lt=1)]
_PositiveFraction = Annotated[Number, Field(gt=0, le=1)]
_NotNegative = Annotated[Number, Field(ge=0)]
_Positive = Annotated[Number, Field(gt=0)]
_ClipRange = Annotated[Number, Field(gt=0, le=10)]
_Count = Annotated[Whole, Field(ge=1, le=10**9)]
_CountFrom0 = Annotated[Whole, Field(ge=0, le=10**9)]
_Minibatch = Annotated[Whole, Field(ge=2, le=10**9)]

_Schedule = _PositiveFraction | Annotated[str, NumberAfter(LINEAR, _PositiveFraction)]
_ClipSchedule = _ClipRange | Annotated[str, NumberAfter(LINEAR, _ClipRange)]
_PositiveSchedule = _Positive | Annotated[str, NumberAfter(LINEAR, _Positive)]
_EntropyCoefficient = _NotNegative | Literal["auto"] | Annotated[str, NumberAfter("auto_", _Positive)]


def split_schedule(value: float | str) -> tuple[float, bool]:
    """Return the value at the beginning of the training, and whether it falls linearly to zero."""
    text = str(value)
    return float(text.removeprefix(LINEAR)), text.startswith(LINEAR)


def decide_by(rule: str) -> dict[str, Any]:
    """Return the `json_schema_extra` of a parameter whose default rlctl chooses by `rule`."""
    return {"default_text": f"{rule} *rlctl*"}


_ROLLOUT = decide_by("4096 / n_envs, from 16 to 2048")
_MINIBATCH = decide_by("128, or the whole rollout where that is smaller")


class Parameters(Section):
    """Parameters by SB3's names; only those that a recipe sets are passed to SB3."""


class _Learning(Parameters):
    learning_rate: _Schedule = 3e-4
    """Step size of the optimiser; `lin_3e-4` falls from 3e-4 to zero over the training."""
    gamma: _PositiveFraction = 0.99
    """Discount per step."""


class _OnPolicy(_Learning):
    n_steps: _Count = Field(2048, json_schema_extra=_ROLLOUT)
    """Steps per environment and rollout."""
    gae_lambda: _Fraction = 0.95
    """Trade-off between bias and variance of the advantage estimate (GAE); 1 is the Monte Carlo return."""
    ent_coef: _NotNegative = 0.0
    """Weight of the entropy bonus in the loss."""
    vf_coef: _NotNegative = 0.5
    """Weight of the value function in the loss."""
    max_grad_norm: _Positive = 0.5
    """Maximum norm of the gradient; larger ones are scaled down."""
    normalize_advantage: Switch = True
    """Whether to normalise the advantages of a minibatch."""
    use_sde: Switch = False
    """State-dependent exploration (gSDE)."""
    sde_sample_freq: _Count | Literal[-1] = -1
    """Steps after which gSDE draws new noise; -1: once per rollout."""


class Ppo(_OnPolicy):
    """Proximal policy optimisation."""

    batch_size: _Minibatch = Field(64, json_schema_extra=_MINIBATCH)
    """Minibatch size."""
    n_epochs: _Count = 10
    """Passes over each rollout."""
    clip_range: _ClipSchedule = 0.2
    """Clip range of the probability ratio: how far it may differ from 1."""
    clip_range_vf: _PositiveSchedule | None = None
    """Clip range of the value function; null: not clipped."""
    target_kl: _Positive | None = None
    """KL divergence at which an update stops early; null: never."""


class RecurrentPpo(Ppo):
    """PPO with an LSTM."""

    n_steps: _Count = Field(128, json_schema_extra=_ROLLOUT)
    batch_size: _Minibatch = Field(128, json_schema_extra=_MINIBATCH)


class A2c(_OnPolicy):
    """Advantage actor-critic."""

    learning_rate: _Schedule = 7e-4
    n_steps: _Count = 5
    gae_lambda: _Fraction = 1.0
    normalize_advantage: Switch = False
    rms_prop_eps: _PositiveFraction = 1e-5
    """Epsilon of RMSProp."""
    use_rms_prop: Switch = True
    """Whether to use RMSProp instead of Adam."""


class _OffPolicy(_Learning):
    buffer_size: Annotated[Whole, Field(ge=1, le=10**15)] = Field(
        1_000_000, json_schema_extra=decide_by("total_timesteps, from 1,000 to 1,000,000")
    )
    """Transitions in the replay buffer."""
    learning_starts: _CountFrom0 = 100
    """Steps of random actions before the first update."""
    batch_size: _Minibatch = 256
    """Transitions per gradient step."""
    train_freq: _Count = Field(1, json_schema_extra=decide_by("1"))
    """Steps of each environment between updates."""
    gradient_steps: _Count | Literal[-1] = Field(1, json_schema_extra=decide_by("-1"))
    """Gradient steps per update; -1: as many as environment steps were taken."""
    n_steps: _Count = 1
    """Steps of the n-step return."""


class _Continuous(_OffPolicy):
    action_noise: _NotNegative | None = None
    """Standard deviation of normal noise on actions scaled to [-1, 1]; null: none."""
    actor_average: _ShareBelow1 = 0.0
    """Decay per gradient step of the averaged actor that is evaluated, kept and exported; 0: the last one is."""


class _MaximumEntropy(_Continuous):
    ent_coef: _EntropyCoefficient = "auto"
    """Entropy coefficient; `auto` learns it, `auto_0.1` learns it starting at 0.1."""
    target_entropy: Number | Literal["auto"] = "auto"
    """Target entropy of `ent_coef: auto`; `auto`: minus the number of action elements."""
    use_sde: Switch = False
    """State-dependent exploration (gSDE)."""
    sde_sample_freq: _Count | Literal[-1] = -1
    """Steps after which gSDE draws new noise; -1: once per rollout."""
    use_sde_at_warmup: Switch = False
    """Whether to use gSDE instead of random actions before `learning_starts`."""


class Sac(_MaximumEntropy):
    """Soft actor-critic."""

    tau: _PositiveFraction = 0.005
    """Soft update coefficient of the target network."""
    target_update_interval: _Count = 1
    """Gradient steps between updates of the target network."""
    policy_delay: _Count = 1
    """Critic updates per update of the actor and the entropy coefficient; Stable-Baselines3's SAC does not have it."""


class Tqc(Sac):
    """Truncated quantile critics."""

    top_quantiles_to_drop_per_net: _CountFrom0 = 2
    """Number of highest quantiles dropped per critic; less than `policy_kwargs.n_quantiles`."""


class CrossQ(_MaximumEntropy):
    """CrossQ: SAC with batch normalisation instead of target networks."""

    learning_rate: _Schedule = 1e-3
    policy_delay: _Count = 3
    """Critic updates per update of the actor."""


class Xqc(CrossQ):
    """XQC: CrossQ whose critics have weights of unit norm and estimate the distribution of the return.

    D. Palenicek et al., [XQC](https://arxiv.org/abs/2509.25174), 2025. Unlike there, the actor, the target entropy and
    the order of layers are those of CrossQ, there are no target networks, and the networks are narrower. It needs
    rewards that are divided by the standard deviation of the return, as its default `normalize` does; `v_min` and
    `v_max` bound the values of such rewards. Early in a training evaluations are far below the training's return: they
    play the averaged actor (`actor_average`), which is over 3,333 gradient steps.
    """

    ent_coef: _EntropyCoefficient = "auto_0.01"
    actor_average: _ShareBelow1 = 0.9997


class Ddpg(_Continuous):
    """Deep deterministic policy gradient."""

    learning_rate: _Schedule = 1e-3
    tau: _PositiveFraction = 0.005
    """Soft update coefficient of the target network."""
    action_noise: _NotNegative | None = Field(None, json_schema_extra=decide_by("0.1"))


class Td3(Ddpg):
    """Twin delayed DDPG."""

    policy_delay: _Count = 2
    """Critic updates per update of the actor."""
    target_policy_noise: _NotNegative = 0.2
    """Standard deviation of the noise that smooths the target policy."""
    target_noise_clip: _NotNegative = 0.5
    """Clip bound of that noise."""


class Dqn(_OffPolicy):
    """Deep Q-network."""

    learning_rate: _Schedule = 1e-4
    batch_size: _Minibatch = 32
    tau: _PositiveFraction = 1.0
    """Soft update coefficient of the target network."""
    train_freq: _Count = Field(4, json_schema_extra=decide_by("1"))
    target_update_interval: _Count = 10_000
    """Steps between updates of the target network."""
    exploration_fraction: _Fraction = 0.1
    """Fraction of the training during which epsilon falls."""
    exploration_initial_eps: _Fraction = 1.0
    """Initial epsilon: fraction of random actions."""
    exploration_final_eps: _Fraction = 0.05
    """Final epsilon: fraction of random actions."""
    max_grad_norm: _Positive = 10.0
    """Maximum norm of the gradient; larger ones are scaled down."""


ALGORITHM_PARAMETERS: dict[str, type[Parameters]] = {
    "ppo": Ppo,
    "a2c": A2c,
    "sac": Sac,
    "td3": Td3,
    "ddpg": Ddpg,
    "dqn": Dqn,
    "tqc": Tqc,
    "crossq": CrossQ,
    "xqc": Xqc,
    "recurrent_ppo": RecurrentPpo,
}
