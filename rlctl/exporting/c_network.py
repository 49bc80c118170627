"""Writes a network as statements of a C function for one observation."""

import re
from collections.abc import Iterable, Mapping

from gymnasium import spaces

from rlctl.policy.c_writer import CVector, CWriter
from rlctl.policy.layers import Layer, Linear, activation, clip, linear, lstm
from rlctl.policy.network import Network

_FIND_LARGEST = """\
static int find_largest(const float *values, int count)
{
    int largest = 0;
    for (int i = 1; i < count; ++i) {
        if (values[i] > values[largest]) {
            largest = i;
        }
    }
    return largest;
}
"""
_FUNCTIONS = {
    **activation.C_FUNCTIONS,
    **clip.C_FUNCTIONS,
    "find_largest": _FIND_LARGEST,
    **linear.C_FUNCTIONS,
    **lstm.C_FUNCTIONS,
}


def write_network(writer: CWriter, network: Network, sizes: Mapping[str, int], source: str) -> CVector:
    """Write a network, head included, and return the head's value.

    `source` is the C array of the observation; `sizes` are the elements of its parts.
    """
    first = {key: network.parts[key][0] for key in sizes}
    features = writer.declare("features", sum(first[key].count_outputs(size) for key, size in sizes.items()))
    start, free = 0, features
    for key, size in sizes.items():
        layer = first[key]
        count = layer.count_outputs(size)
        layer.write_c(writer, CVector(source, start, size), CVector(free.name, free.start, count))
        start, free = start + size, free.skip(count)
    value = features if network.lstm is None else network.lstm.write_c(writer, features)
    return _write_layers(writer, [*network.trunk, *network.head], value)


def _write_layers(writer: CWriter, layers: Iterable[Layer], value: CVector) -> CVector:
    for layer in layers:
        target = value
        if isinstance(layer, Linear):  # others change the values where they are
            target = writer.declare("layer", layer.count_outputs(value.size))
        layer.write_c(writer, value, target)
        value = target
    return value


def write_action(writer: CWriter, network: Network, value: CVector, space: spaces.Space[object], kind: str) -> None:
    """Write the action from the head's value: clipped or scaled, as C type `kind`, or the most likely choices."""
    x, size = value.element, value.size
    if isinstance(space, spaces.MultiBinary):
        writer.loop(size, f"action[i] = {x} > 0.0f;")
    elif not isinstance(space, spaces.Box):
        counts = space.nvec.tolist() if isinstance(space, spaces.MultiDiscrete) else [size]
        for index, count in enumerate(counts):
            place = f"{value.name} + {sum(counts[:index])}"
            writer.statements.append(f"action[{index}] = find_largest({place}, {count});")
    else:
        low, high = space.low.ravel(), space.high.ravel()
        if network.ends_with_tanh:
            writer.loop(size, f"{x} = hyperbolic_tangent({x});")
        lowest = writer.constant("low", low, kind)
        if network.is_squashed:
            x = f"({x} + 1.0f) * 0.5f * {writer.constant('range', high - low, kind)} + {lowest}"
        else:
            x = f"({kind})bound({x}, {lowest}, {writer.constant('high', high, kind)})"
        writer.loop(size, f"action[i] = {x};")


def list_functions(writer: CWriter) -> list[str]:
    """Return the definitions of the functions that the statements call, in an order in which C can read them."""
    called = set(re.findall(r"\b(\w+)\(", "\n".join(writer.statements)))
    if "apply_gates" in called:
        called |= {"sigmoid", "hyperbolic_tangent"}
    return [text for name, text in _FUNCTIONS.items() if name in called]
