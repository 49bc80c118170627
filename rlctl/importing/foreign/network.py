"""`ForeignNetwork`: the network of another project's policy, and its form in a policy file of rlctl."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.task.deployment import Deployment

Array = NDArray[np.float64]
LARGEST_FILE = 256 * 2**20  # [bytes]; policies of walking robots have less than 10 MB
_LOG_STD = -3.0  # of exploration, which exported policies do not have; only further training uses it
_LSTM_PARTS = ("weight_ih", "weight_hh", "bias_ih", "bias_hh")


@dataclasses.dataclass(frozen=True, eq=False)
class ForeignLinear:
    """`weight @ x + bias`."""

    weight: Array  # shape (outputs, inputs)
    bias: Array

    def take_columns(self, columns: NDArray[np.int64], factors: Array, size: int) -> ForeignLinear:
        """Return the layer for another input of `size`: its own element k is `factors[k]` times one of that input."""
        weight = np.zeros((len(self.weight), size))
        weight[:, columns] = self.weight * factors
        return ForeignLinear(weight, self.bias)

    def fix_inputs(self, is_fixed: NDArray[np.bool_], values: Array) -> ForeignLinear:
        """Return the layer without those of its inputs that always have these values."""
        return ForeignLinear(self.weight[:, ~is_fixed], self.bias + self.weight[:, is_fixed] @ values)

    def standardize(self, mean: Array, scale: Array) -> ForeignLinear:
        """Return the layer for inputs from which `mean` is not yet subtracted, and which are not yet times `scale`."""
        weight = self.weight * scale
        return ForeignLinear(weight, self.bias - weight @ mean)


@dataclasses.dataclass(frozen=True, eq=False)
class ForeignLstm:
    """Layers of an LSTM with torch's order of gates: input, forget, cell, output."""

    layers: tuple[tuple[Array, Array, Array, Array], ...]  # of each: weights of input and hidden state, both biases

    @property
    def hidden_size(self) -> int:
        """The number of elements of a hidden state."""
        return int(self.layers[0][1].shape[1])


@dataclasses.dataclass(frozen=True, eq=False)
class ForeignNetwork:
    """A network from one vector of observations to one of actions: an LSTM if it has one, then a perceptron."""

    linears: tuple[ForeignLinear, ...]
    activation: str  # between the linear layers; one of `rlctl.policy.layers.ACTIVATIONS`
    ends_with_tanh: bool = False
    lstm: ForeignLstm | None = None

    @property
    def observation_size(self) -> int:
        """The number of elements of its input."""
        if self.lstm is not None:
            return int(self.lstm.layers[0][0].shape[1])
        return int(self.linears[0].weight.shape[1])

    @property
    def action_size(self) -> int:
        """The number of elements of its output."""
        return len(self.linears[-1].weight)

    @property
    def first(self) -> ForeignLinear:
        """The layer that reads the observation."""
        if self.lstm is None:
            return self.linears[0]
        weight, _, bias, _ = self.lstm.layers[0]
        return ForeignLinear(weight, bias)

    def with_first(self, first: ForeignLinear) -> ForeignNetwork:
        """Return the network with another layer that reads the observation."""
        if self.lstm is None:
            return dataclasses.replace(self, linears=(first, *self.linears[1:]))
        _, weight_hh, _, bias_hh = self.lstm.layers[0]
        layers = ((first.weight, weight_hh, first.bias, bias_hh), *self.lstm.layers[1:])
        return dataclasses.replace(self, lstm=ForeignLstm(layers))

    def observe_as(self, deployment: Deployment) -> ForeignNetwork:
        """Return the network for observations as rlctl's task has them: in its order, in SI units."""
        first = self.first.fix_inputs(*deployment.find_constants())
        columns, factors = deployment.find_columns()
        return self.with_first(first.take_columns(columns, factors, deployment.layout.size))

    @property
    def algo(self) -> str:
        """The algorithm whose network it is in a policy file."""
        if self.lstm is not None:
            return "recurrent_ppo"
        return "td3" if self.ends_with_tanh else "ppo"  # heads of TD3 contain the tanh

    @property
    def arguments(self) -> dict[str, Any]:
        """The `policy_kwargs` of a policy file."""
        sizes = [len(linear.weight) for linear in self.linears[:-1]]
        common: dict[str, Any] = {"activation_fn": self.activation}
        if self.algo == "td3":
            return {**common, "net_arch": {"pi": sizes, "qf": [1]}}
        common["net_arch"] = {"pi": sizes, "vf": []}
        if self.lstm is None:
            return common
        lstm = {"lstm_hidden_size": self.lstm.hidden_size, "n_lstm_layers": len(self.lstm.layers)}
        return {**common, **lstm, "enable_critic_lstm": False, "shared_lstm": True}

    def write_tensors(self) -> dict[str, NDArray[np.float32]]:
        """Return the tensors of a policy file, by the names of Stable-Baselines3."""
        tensors: dict[str, Any] = {}
        *hidden, last = self.linears
        if self.algo == "td3":
            for number, linear in enumerate(self.linears):
                _add(tensors, f"actor.mu.{2 * number}", linear)
        else:
            for number, linear in enumerate(hidden):
                _add(tensors, f"mlp_extractor.policy_net.{2 * number}", linear)
            _add(tensors, "action_net", last)
            tensors["log_std"] = np.full(self.action_size, _LOG_STD)
        if self.lstm is not None:
            for number, layer in enumerate(self.lstm.layers):
                for name, values in zip(_LSTM_PARTS, layer, strict=True):
                    tensors[f"lstm_actor.{name}_l{number}"] = values
        return {f"policy/{name}": np.asarray(values, np.float32) for name, values in tensors.items()}


def _add(tensors: dict[str, Any], name: str, linear: ForeignLinear) -> None:
    tensors[f"{name}.weight"], tensors[f"{name}.bias"] = linear.weight, linear.bias


class NotImportable(ValueError):
    """A network is of a kind that rlctl does not import; the text says why.

    `in_no_form`: it is not imported from another kind of file either.
    """

    def __init__(self, text: str, *, in_no_form: bool = False) -> None:
        super().__init__(text)
        self.in_no_form = in_no_form


ForeignLayer = tuple[str, Any]
"""`("linear", ForeignLinear)`, `("affine", (factor, shift))`, an activation's name and None, `("first", count)` for so
many of the values, or `("part", count)` for the first of so many equal parts of them."""


def assemble(
    layers: Sequence[ForeignLayer], activations: Mapping[str, Any], lstm: ForeignLstm | None = None
) -> ForeignNetwork:
    """Return the network of layers in a row; raises `NotImportable` where they are no perceptron.

    Factors and shifts before or after a linear layer become part of it.
    """
    linears: list[ForeignLinear] = []
    used: list[str] = []
    before: tuple[Any, Any] | None = None
    for kind, content in layers:
        follows_linear = len(linears) == len(used) + 1
        if kind == "linear":
            if follows_linear:
                raise NotImportable("two linear layers follow each other without an activation")
            linear = content
            if before is not None:
                factor, shift = before
                ones = np.ones(linear.weight.shape[1])
                linear = ForeignLinear(linear.weight * (factor * ones), linear.bias + linear.weight @ (shift * ones))
                before = None
            linears.append(linear)
        elif kind == "affine":
            factor, shift = content
            if follows_linear:
                last = linears.pop()
                column = np.broadcast_to(np.asarray(factor, float), len(last.weight))
                linears.append(ForeignLinear(column[:, None] * last.weight, factor * last.bias + shift))
            elif before is None:
                before = factor, shift
            else:
                before = before[0] * factor, before[1] * factor + shift
        elif kind in ("first", "part") and follows_linear:
            last = linears.pop()
            count = content if kind == "first" else len(last.weight) // content
            linears.append(ForeignLinear(last.weight[:count], last.bias[:count]))
        elif kind in activations and follows_linear:
            used.append(kind)
        else:
            raise NotImportable(f"{kind} is where a linear layer is expected")
    if not linears or before is not None:
        raise NotImportable("it has no linear layer at its end")
    ends_with_tanh = len(used) == len(linears)
    if ends_with_tanh and used.pop() != "tanh":
        raise NotImportable("it ends with an activation other than tanh")
    kinds = sorted(set(used))
    if len(kinds) > 1:
        raise NotImportable(f"it has several activations: {', '.join(kinds)}")
    if lstm is not None and ends_with_tanh:
        raise NotImportable("it has an LSTM and ends with tanh")
    network = ForeignNetwork(tuple(linears), kinds[0] if kinds else "elu", ends_with_tanh, lstm)
    _check_sizes(network)
    return network


def _check_sizes(network: ForeignNetwork) -> None:
    sizes = [linear.weight.shape for linear in network.linears]
    given = network.linears[0].weight.shape[1] if network.lstm is None else network.lstm.hidden_size
    for outputs, inputs in sizes:
        if inputs != given:
            raise NotImportable(f"a layer takes {inputs} numbers where {given} are computed")
        given = outputs
