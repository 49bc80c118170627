"""Where the parameters of algorithms and networks make sense. Their names are checked against SB3's own signatures."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

from rlctl.errors import did_you_mean, short_repr

Rule = Callable[[Any], None]
"""Raises `ValueError`, which says what would be right, for a value that makes no sense."""

ON_POLICY = frozenset({"ppo", "a2c", "recurrent_ppo"})

_MOST = 10**9
_WIDEST = 65_536
_DEEPEST = 100


@dataclasses.dataclass(frozen=True)
class Range:
    """Numbers from `low` to `high`, finite, and what else a parameter may be."""

    low: float
    high: float = math.inf
    integer: bool = False
    open_low: bool = False
    schedule: bool = False
    """Also `lin_` and a number of the range, which falls to zero over the training."""
    auto: bool = False
    """Also `auto`, or `auto_` and a positive number to begin with."""
    optional: bool = False
    """Also null."""

    def __call__(self, value: Any) -> None:
        if value is None and self.optional:
            return
        if isinstance(value, str):
            self._check_text(value)
            return
        if isinstance(value, bool) or not isinstance(value, int | float) or (self.integer and not _is_whole(value)):
            raise ValueError(f"expected {self._kind()}, got {short_repr(value)}")
        if not self._contains(value):
            raise ValueError(f"{short_repr(value)} is not in {self}")

    def _contains(self, value: float) -> bool:
        above = self.low < value if self.open_low else self.low <= value
        return above and value <= self.high and math.isfinite(value)

    def _check_text(self, text: str) -> None:
        if self.auto and text == "auto":
            return
        for prefix, allowed in (("lin_", self.schedule), ("auto_", self.auto)):
            if allowed and text.startswith(prefix):
                start = _number(text.removeprefix(prefix))
                if start is None or not self._contains(start) or (prefix == "auto_" and start <= 0):
                    raise ValueError(
                        f"{short_repr(text)!r} is not {prefix} and a number in {self}, such as {prefix}0.1"
                    )
                return
        raise ValueError(f"expected {self._kind()}, got {short_repr(text)!r}")

    def _kind(self) -> str:
        kinds = ["a whole number" if self.integer else "a number"]
        kinds += ["lin_ and a number"] if self.schedule else []
        kinds += ["auto"] if self.auto else []
        return " or ".join(kinds)

    def __str__(self) -> str:
        return f"{'(' if self.open_low else '['}{self.low:g}, {self.high:g}]"


def _is_whole(value: float) -> bool:
    return math.isfinite(value) and float(value).is_integer()


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _switch(value: Any) -> None:
    if not isinstance(value, bool):
        raise ValueError(f"expected true or false, got {short_repr(value)}")


def _off(value: Any) -> None:
    if value is not False:
        raise ValueError("not supported: checkpoints need the whole buffer; leave it out")


def _name(value: Any) -> None:
    if not isinstance(value, str):
        raise ValueError(f"expected a name, such as tanh, got {short_repr(value)}")


def _one_of_no_use(value: float) -> Rule:
    """Whole numbers from 1, and one that stands for something else."""

    def check(given: Any) -> None:
        if given != value or isinstance(given, bool):
            _COUNT(given)

    return check


_COUNT = Range(1, _MOST, integer=True)
_FRACTION = Range(0, 1)
_PART = Range(0, 1, open_low=True)
_NOT_NEGATIVE = Range(0)
_POSITIVE = Range(0, open_low=True)
_CLIP = Range(0, 10, open_low=True, schedule=True)
_WIDTH = Range(1, _WIDEST, integer=True)
_FEW = Range(1, _DEEPEST, integer=True)
_ALL_OR_COUNT = _one_of_no_use(-1)


def _train_freq(value: Any) -> None:
    if not isinstance(value, list):
        _COUNT(value)
        return
    if len(value) != 2 or value[1] not in ("step", "episode"):
        raise ValueError(f"expected a number of steps, or a pair such as [1, episode], got {short_repr(value)}")
    _COUNT(value[0])


def _mapping(rules: Mapping[str, Rule]) -> Rule:
    def check(value: Any) -> None:
        if value is None:
            return
        if not isinstance(value, Mapping):
            raise ValueError(f"expected a mapping of {', '.join(rules)}, got {short_repr(value)}")
        _check_all(value, rules, known_only=True)

    return check


def _layers(value: Any) -> None:
    if not isinstance(value, list):
        raise ValueError(f"expected a list of layer widths, such as [64, 64], got {short_repr(value)}")
    if len(value) > _DEEPEST:
        raise ValueError(f"{len(value):,} layers; at most {_DEEPEST} make sense")
    for width in value:
        _WIDTH(width)


def _net_arch(*parts: str) -> Rule:
    """A list of widths, or one for each part of a network that has parts."""

    def check(value: Any) -> None:
        if not isinstance(value, Mapping) or not parts:
            _layers(value)
            return
        if set(value) != set(parts):
            example = ", ".join(f"{part}: [64, 64]" for part in parts)
            raise ValueError(f"expected [64, 64] or {{{example}}}, got {short_repr(value)}")
        for part, layers in value.items():
            _checked(part, layers, _layers)

    return check


_ALGORITHM: dict[str, Rule] = {
    "learning_rate": Range(0, 1, schedule=True, open_low=True),
    "n_steps": _COUNT,
    "batch_size": Range(2, _MOST, integer=True),
    "n_epochs": _COUNT,
    "gamma": _PART,
    "gae_lambda": _FRACTION,
    "clip_range": _CLIP,
    "clip_range_vf": dataclasses.replace(_CLIP, high=math.inf, optional=True),
    "normalize_advantage": _switch,
    "ent_coef": _NOT_NEGATIVE,
    "vf_coef": _NOT_NEGATIVE,
    "max_grad_norm": _POSITIVE,
    "use_sde": _switch,
    "sde_sample_freq": _ALL_OR_COUNT,
    "use_sde_at_warmup": _switch,
    "target_kl": dataclasses.replace(_POSITIVE, optional=True),
    "stats_window_size": _COUNT,
    "rms_prop_eps": _PART,
    "use_rms_prop": _switch,
    "buffer_size": Range(1, 10**15, integer=True),  # what memory there is decides
    "learning_starts": Range(0, _MOST, integer=True),
    "tau": _PART,
    "train_freq": _train_freq,
    "gradient_steps": _ALL_OR_COUNT,
    "action_noise": dataclasses.replace(_NOT_NEGATIVE, optional=True),
    "optimize_memory_usage": _off,
    "target_update_interval": _COUNT,
    "target_entropy": Range(-math.inf, auto=True),
    "policy_delay": _COUNT,
    "target_policy_noise": _NOT_NEGATIVE,
    "target_noise_clip": _NOT_NEGATIVE,
    "exploration_fraction": _FRACTION,
    "exploration_initial_eps": _FRACTION,
    "exploration_final_eps": _FRACTION,
    "top_quantiles_to_drop_per_net": Range(0, integer=True),
}
_OFF_POLICY_ONLY: dict[str, Rule] = {"ent_coef": dataclasses.replace(_NOT_NEGATIVE, auto=True)}

_POLICY: dict[str, Rule] = {
    "activation_fn": _name,
    "ortho_init": _switch,
    "log_std_init": Range(-20, 10),
    "full_std": _switch,
    "use_expln": _switch,
    "squash_output": _switch,
    "share_features_extractor": _switch,
    "features_extractor_kwargs": _mapping(
        {"features_dim": _WIDTH, "cnn_output_dim": _WIDTH, "normalized_image": _switch}
    ),
    "clip_mean": _NOT_NEGATIVE,
    "n_critics": _FEW,
    "n_quantiles": Range(1, 10_000, integer=True),
    "batch_norm": _switch,
    "batch_norm_momentum": _PART,
    "batch_norm_eps": _PART,
    "renorm_warmup_steps": Range(0, _MOST, integer=True),
    "lstm_hidden_size": _WIDTH,
    "n_lstm_layers": _FEW,
    "shared_lstm": _switch,
    "enable_critic_lstm": _switch,
    "lstm_kwargs": _mapping({"dropout": Range(0, 0.99), "bias": _switch}),
}
_PARTS = {"dqn": (), **dict.fromkeys(ON_POLICY, ("pi", "vf"))}
_QUANTILES = 25  # as TQC has it


def check_algorithm(algo: str, values: Mapping[str, Any]) -> None:
    """Raise `ValueError`, which begins with the parameter's name, for a value that an algorithm can do nothing with."""
    _check_all(values, _ALGORITHM if algo in ON_POLICY else {**_ALGORITHM, **_OFF_POLICY_ONLY})


def check_policy(algo: str, values: Mapping[str, Any]) -> None:
    """Raise `ValueError`, which begins with the parameter's name, for a value that a network cannot have."""
    _check_all(values, {**_POLICY, "net_arch": _net_arch(*_PARTS.get(algo, ("pi", "qf")))})


def check_together(algo: str, values: Mapping[str, Any], policy: Mapping[str, Any], n_envs: int) -> None:
    """Raise `ValueError` for values that are each possible, but not with the others."""
    train_freq = values.get("train_freq")
    if n_envs > 1 and isinstance(train_freq, list) and train_freq[1] == "episode":
        raise ValueError(
            f"algo_kwargs.train_freq: {short_repr(train_freq)} counts the episodes of one environment, and n_envs is "
            f"{n_envs}; count steps, such as train_freq: {train_freq[0]}, or set n_envs: 1"
        )
    dropped, quantiles = values.get("top_quantiles_to_drop_per_net", 0), policy.get("n_quantiles", _QUANTILES)
    if algo == "tqc" and dropped >= quantiles:
        raise ValueError(
            f"algo_kwargs.top_quantiles_to_drop_per_net: {dropped} of {quantiles} leaves nothing; "
            "it must be below policy_kwargs.n_quantiles"
        )


def with_whole_numbers(name: str, value: Any) -> Any:
    """Return a value with `1e3` made 1000 wherever a parameter counts something; SB3 takes no float there."""
    rule = _ALGORITHM.get(name) or _POLICY.get(name)
    if isinstance(rule, Range) and not rule.integer:
        return value
    if isinstance(value, Mapping):
        return {key: with_whole_numbers(key, each) for key, each in value.items()}
    if isinstance(value, list):
        return [with_whole_numbers(name, each) for each in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _check_all(values: Mapping[str, Any], rules: Mapping[str, Rule], known_only: bool = False) -> None:
    for name, value in values.items():
        if name in rules:
            _checked(name, value, rules[name])
        elif known_only:
            raise ValueError(
                f"no key {short_repr(name)!r}.{did_you_mean(str(name), rules)} Keys here: {', '.join(rules)}"
            )


def _checked(name: str, value: Any, rule: Rule) -> None:
    try:
        rule(value)
    except ValueError as error:
        text = str(error)
        inside = isinstance(value, Mapping) and any(text.startswith(f"{key}: ") for key in value)
        raise ValueError(f"{name}{'.' if inside else ': '}{text}") from None
