"""Writes the layers of a network as statements of a C function for one observation."""

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.policy.layers import Activation, BatchRenorm, Clip, Layer, Linear, Lstm, Normalize, OneHot
from rlctl.policy.network import Network

_PER_LINE = 8
_ACTIVATIONS = {"tanh": "hyperbolic_tangent({x})", "relu": "relu({x})", "elu": "elu({x})", "silu": "{x} * sigmoid({x})"}


class CWriter:
    """Writes a network layer by layer. The methods pass on values: the name and the size of a C array of floats."""

    def __init__(self) -> None:
        self.statements: list[str] = []
        self.constants: list[str] = []  # definitions of the arrays that the statements use
        self._numbers: Counter[str] = Counter()

    def find_functions(self) -> set[str]:
        """Return the names of the functions that the statements call."""
        called = set(re.findall(r"\b(\w+)\(", "\n".join(self.statements)))
        return called | {"sigmoid", "hyperbolic_tangent"} if "apply_gates" in called else called

    def loop(self, count: int, statement: str) -> None:
        """Add a loop of one statement over `i` below `count`."""
        self.statements += [f"for (int i = 0; i < {count}; ++i) {{", f"    {statement}", "}"]

    def write(self, network: Network, sizes: dict[str, int], source: str) -> tuple[str, int]:
        """Write the network, head included, and return the head's value.

        `source` is the C array of the observation; `sizes` are the elements of its parts.
        """
        layers = {key: network.parts[key][0] for key in sizes}
        counts = [int(layer.sizes.sum()) if isinstance(layer, OneHot) else sizes[key] for key, layer in layers.items()]
        value, start, feature = self._declare("features", sum(counts)), 0, 0
        for (key, size), count in zip(sizes.items(), counts, strict=True):
            self._write_part(layers[key], source, start, size, value, feature)
            start, feature = start + size, feature + count
        if network.lstm is not None:
            value, feature = self._write_lstm(network.lstm, value, feature)
        return self._write_layers([*network.trunk, *network.head], value, feature)

    def _write_part(self, layer: Layer, source: str, start: int, size: int, target: str, feature: int) -> None:
        if isinstance(layer, OneHot):
            for number, count in enumerate(layer.sizes.ravel().tolist()):
                element = f"{target}[{_offset(feature)}]"
                self.loop(count, f"{element} = (int){source}[{start + number}] == i ? 1.0f : 0.0f;")
                feature += count
            return
        value = f"{source}[{_offset(start)}]"
        if isinstance(layer, Normalize):
            # In float64, as `Normalize` computes it.
            deviation = self.constant("deviation", np.sqrt(layer.variance + layer.epsilon), "double")
            value = f"((double){value} - {self.constant('mean', layer.mean, 'double')}) / {deviation}"
            if np.isfinite(layer.clip):
                value = f"bound({value}, {write_number(-layer.clip, 'double')}, {write_number(layer.clip, 'double')})"
            value = f"(float)({value})"
        self.loop(size, f"{target}[{_offset(feature)}] = {value};")

    def _write_layers(self, layers: Iterable[Layer], value: str, size: int) -> tuple[str, int]:
        for layer in layers:
            x = f"{value}[i]"
            if isinstance(layer, Linear):
                source, inputs, size = value, size, len(layer.bias)
                value = self._declare("layer", size)
                self.loop(size, f"{value}[i] = {self.constant('bias', layer.bias)};")
                self._add_linear(layer.weight, source, inputs, value)
            elif isinstance(layer, BatchRenorm):
                deviation = self.constant("deviation", np.sqrt(layer.variance + layer.epsilon))
                centred = f"({x} - {self.constant('mean', layer.mean)}) / {deviation}"
                scale, bias = self.constant("scale", layer.scale), self.constant("bias", layer.bias)
                self.loop(size, f"{x} = {centred} * {scale} + {bias};")
            elif isinstance(layer, Clip):
                self.loop(size, f"{x} = (float)bound({x}, {-layer.limit!r}, {layer.limit!r});")
            else:
                assert isinstance(layer, Activation)  # other layers are for images, which `write_c` refuses
                self.loop(size, f"{x} = {_ACTIVATIONS[layer.name].format(x=x)};")
        return value, size

    def _write_lstm(self, lstm: Lstm, value: str, size: int) -> tuple[str, int]:
        count = lstm.hidden_size
        for number, layer in enumerate(lstm.layers):
            hidden, cell = (f"state->{member} + {number * count}" for member in ("hidden", "cell"))
            gates = self._declare("gates", 4 * count)
            bias = np.sum(layer.biases, axis=0) if layer.biases else np.zeros(4 * count)
            self.loop(4 * count, f"{gates}[i] = {self.constant('bias', bias)};")
            self._add_linear(layer.of_input, value, size, gates)
            self._add_linear(layer.of_hidden, hidden, count, gates)
            self.statements.append(f"apply_gates({gates}, {count}, {hidden}, {cell});")
            value, size = hidden, count
        return value, size

    def write_action(self, network: Network, value: str, size: int, space: spaces.Space[Any], kind: str) -> None:
        """Write the action from the head's value: clipped or scaled, as C type `kind`, or the most likely choices."""
        if isinstance(space, spaces.MultiBinary):
            self.loop(size, f"action[i] = {value}[i] > 0.0f;")
        elif not isinstance(space, spaces.Box):
            counts = space.nvec.tolist() if isinstance(space, spaces.MultiDiscrete) else [size]
            for index, count in enumerate(counts):
                self.statements.append(f"action[{index}] = find_largest({value} + {sum(counts[:index])}, {count});")
        else:
            low, high = space.low.ravel(), space.high.ravel()
            x = f"{value}[i]"
            if network.ends_with_tanh:
                self.loop(size, f"{x} = hyperbolic_tangent({x});")
            lowest = self.constant("low", low, kind)
            if network.is_squashed:
                x = f"({x} + 1.0f) * 0.5f * {self.constant('range', high - low, kind)} + {lowest}"
            else:
                x = f"({kind})bound({x}, {lowest}, {self.constant('high', high, kind)})"
            self.loop(size, f"action[i] = {x};")

    def constant(self, name: str, values: NDArray[Any], kind: str = "float") -> str:
        """Return element `i` of a constant array; a number if all elements are equal."""
        flat = values.ravel()
        if (flat == flat[0]).all():
            return write_number(flat[0], kind)
        return f"{self._define(name, flat, kind)}[i]"

    def _define(self, name: str, values: NDArray[Any], kind: str = "float") -> str:
        name = self._number(name)
        numbers = [write_number(value, kind) for value in values]
        self.constants.append(write_array(f"static const {kind} {name}", numbers))
        return name

    def _add_linear(self, weight: NDArray[Any], source: str, inputs: int, target: str) -> None:
        constant = self._define("weight", weight.T.ravel())
        self.statements.append(f"apply_linear({constant}, {source}, {inputs}, {target}, {len(weight)});")

    def _declare(self, name: str, size: int) -> str:
        name = self._number(name)
        self.statements.append(f"float {name}[{size}];")
        return name

    def _number(self, name: str) -> str:
        self._numbers[name] += 1
        return f"{name}_{self._numbers[name]}"


def _offset(offset: int) -> str:
    return f"{offset} + i" if offset else "i"


def write_array(declaration: str, values: Sequence[str]) -> str:
    """Return the definition of an array; `declaration` is its type and name."""
    body = ",\n    ".join(", ".join(values[low : low + _PER_LINE]) for low in range(0, len(values), _PER_LINE))
    return f"{declaration}[{len(values)}] = {{\n    {body},\n}};\n"


def write_number(value: Any, kind: str) -> str:
    """Return a C literal with exactly the value of a number."""
    if kind == "int":
        return str(int(value))
    if np.isinf(value):
        return "INFINITY" if value > 0 else "-INFINITY"
    return f"{np.float32(value)!s}f" if kind == "float" else repr(float(value))
