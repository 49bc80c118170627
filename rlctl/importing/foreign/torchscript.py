"""Reads the network of a TorchScript archive as data. None of its code is executed.

The weights are read from the archive's pickle, the structure from the classes of the modules, and the order of the
parts from the code of the exported module, as text: a module that does more than its parts is refused.
"""

from __future__ import annotations

import ast
import re
import textwrap
from pathlib import Path

import numpy as np

from rlctl.errors import ArtifactError, short_repr
from rlctl.importing.foreign.network import (
    LARGEST_FILE,
    Array,
    ForeignLayer,
    ForeignLinear,
    ForeignLstm,
    ForeignNetwork,
    NotImportable,
    assemble,
)
from rlctl.importing.pickle_data import NotPlainData
from rlctl.importing.tensor_file import Module, read_torchscript
from rlctl.policy.layers import ACTIVATIONS
from rlctl.storage import untrusted

_ACTIVATIONS = {"ELU": "elu", "ReLU": "relu", "Tanh": "tanh", "SiLU": "silu"}
_TRUNKS = ("actor", "actor_mlp", "policy", "mlp", "net")  # names of the perceptron in exported modules
_RECURRENT = ("rnn", "memory", "memory_a")
_NORMALIZERS = ("normalizer", "obs_normalizer")
_HARMLESS = {"unsqueeze", "squeeze", "slice", "copy_", "linear", "elu", "relu", "tanh", "silu", "to", "detach"}
_LONGEST_CODE = 100_000  # characters
_CONVERT = "convert it where it was trained: torch.onnx.export(policy, zeros, 'policy.onnx')"


def read_torchscript_network(path: Path) -> ForeignNetwork:
    """Return the network of a TorchScript file; raises `ArtifactError` for one that is not imported."""
    content = untrusted.read_bytes(path, LARGEST_FILE)
    try:
        return _read(read_torchscript(content))
    except NotImportable as error:
        text = str(error)
        if not error.in_no_form:
            text = f"{text}; {_CONVERT}"
        raise ArtifactError(f"{path}: {text}") from None
    except (NotPlainData, *untrusted.ZIP_ERRORS, LookupError, TypeError, AttributeError) as error:
        raise ArtifactError(f"{path}: damaged, or not TorchScript: {short_repr(str(error), 200)}") from None


def _read(module: Module) -> ForeignNetwork:
    if _find_class(module) in ("Sequential", "GraphModule"):
        return assemble(_list_layers(module), ACTIVATIONS)
    if "estimator" in module.modules:
        raise NotImportable("it estimates what it does not observe (HIMLoco), which rlctl cannot play", in_no_form=True)
    trunk = _choose(module, _TRUNKS)
    if trunk is None:
        raise NotImportable(f"its module {_find_class(module)} has none of the parts {', '.join(_TRUNKS)}")
    recurrent, normalizer = _choose(module, _RECURRENT), _choose(module, _NORMALIZERS)
    known = [name for name in (trunk, recurrent, normalizer) if name is not None]
    _check_code(module, known)
    lstm = None
    if recurrent is not None:
        lstm = _read_lstm(module.modules[recurrent])
    network = assemble(_list_layers(module.modules[trunk]), ACTIVATIONS, lstm)
    if normalizer is None or _find_class(module.modules[normalizer]) == "Identity":
        return network
    return network.with_first(_standardize(network.first, module.modules[normalizer]))


def _find_class(module: Module) -> str:
    return module.name.rpartition(".")[2]


def _choose(module: Module, names: tuple[str, ...]) -> str | None:
    return next((name for name in names if name in module.modules), None)


def _check_code(module: Module, known: list[str]) -> None:
    """Raise `NotImportable` if the module's `forward` does more than to call the known parts one after the other."""
    body = _find_forward(module)
    called = set(re.findall(r"\((\w+)\)\.forward", body))
    functions = set(re.findall(r"\btorch\.(?!nn\b)(\w+)\(", body)) - _HARMLESS
    functions |= {name.rpartition(".")[2] for name in re.findall(r"__torch__\.torch\.nn\.functional\.\w+", body)}
    if functions:
        raise NotImportable(
            f"its forward calls {', '.join(sorted(functions))}; rlctl reads a normaliser, an LSTM and a perceptron "
            "in a row"
        )
    if others := sorted(called - set(known)):
        raise NotImportable(f"its forward calls the part {others[0]!r}, which rlctl does not know")


def _find_forward(module: Module) -> str:
    """Return the code of a module's `forward`."""
    start = module.code.find("def forward(")
    if start < 0:
        raise NotImportable(f"its module {_find_class(module)} has no forward")
    body = module.code[start:]
    end = body.find("\n  def ", 1)
    return body if end < 0 else body[:end]


def _list_layers(module: Module) -> list[ForeignLayer]:
    """Return the layers of a `Sequential`, in the order of its numbers, or of a graph, in the order of its calls."""
    layers: list[ForeignLayer] = []
    for name in _list_names(module):
        part = module.modules[name]
        kind = _find_class(part)
        if kind == "Sequential":
            layers += _list_layers(part)
        elif kind == "Linear":
            weight = part.tensors["weight"].astype(float)
            bias = part.tensors.get("bias")
            bias = np.zeros(len(weight)) if bias is None else bias.astype(float)
            layers.append(("linear", ForeignLinear(weight, bias)))
        elif kind in _ACTIVATIONS:
            if kind == "ELU" and re.search(r"\belu\(\w+, (?!1\.0*[,)])", part.code):
                raise NotImportable("its ELU has an alpha other than 1")
            layers.append((_ACTIVATIONS[kind], None))
        elif kind != "Identity":
            raise NotImportable(f"its perceptron has a {kind}; known are Linear, {', '.join(_ACTIVATIONS)}")
    return layers


def _list_names(module: Module) -> list[str]:
    if _find_class(module) != "GraphModule":
        return sorted(module.modules, key=_read_number)
    text = textwrap.dedent("  " + _find_forward(module).rstrip())
    try:
        (function,) = ast.parse(text[:_LONGEST_CODE]).body
        names = _read_chain(function)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise NotImportable("its graph is no chain of layers") from None
    if sorted(names) != sorted(module.modules):
        raise NotImportable("its graph is no chain of layers")
    return names


def _read_chain(function: ast.stmt) -> list[str]:
    """Return the parts that a graph calls, in their order; raises `ValueError` if it does anything else.

    Its code is `a = getattr(self, "actor/0/Gemm")`, `b = (a).forward(input, )`, and so on; calls may be nested.
    """
    parts: dict[str, str] = {}
    values: dict[str, list[str]] = {}

    def follow(value: ast.expr) -> list[str]:
        match value:
            case ast.Name(id=name) if name in values:
                return values[name]
            case ast.Call(func=ast.Attribute(value=ast.Name(id=part), attr="forward"), args=[given]) if part in parts:
                return [*follow(given), parts[part]]
        raise ValueError(ast.dump(value))

    match function:
        case ast.FunctionDef(args=ast.arguments(args=[ast.arg(arg="self"), ast.arg(arg=given)])):
            values[given] = []
        case _:
            raise ValueError("no forward of one input")
    for line in function.body:
        match line:
            case ast.Assign(
                targets=[ast.Name(id=variable)],
                value=ast.Call(func=ast.Name(id="getattr"), args=[ast.Name(id="self"), ast.Constant(value=str(name))]),
            ):
                parts[variable] = name
            case ast.Assign(targets=[ast.Name(id=variable)], value=value):
                values[variable] = follow(value)
            case ast.Return(value=ast.expr() as value):
                return follow(value)
    raise ValueError("it returns nothing")


def _read_number(name: str) -> int:
    if not name.isdecimal():
        raise NotImportable(f"its perceptron has a part {name!r} without a number")
    return int(name)


def _read_lstm(module: Module) -> ForeignLstm:
    if _find_class(module) != "LSTM":
        raise NotImportable(f"its recurrent part is a {_find_class(module)}; only LSTM is imported")
    layers: list[tuple[Array, Array, Array, Array]] = []
    while f"weight_ih_l{len(layers)}" in module.tensors:
        number = len(layers)
        names = (f"{name}_l{number}" for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh"))
        weight_ih, weight_hh, bias_ih, bias_hh = (module.tensors[name].astype(float) for name in names)
        layers.append((weight_ih, weight_hh, bias_ih, bias_hh))
    if not layers:
        raise NotImportable("its LSTM has no weights")
    return ForeignLstm(tuple(layers))


def _standardize(first: ForeignLinear, module: Module) -> ForeignLinear:
    """Return the layer that reads the observation, for one that is not normalised yet."""
    tensors = module.tensors
    mean, std = tensors.get("_mean"), tensors.get("_std")
    if mean is None or std is None:
        raise NotImportable(f"its normaliser is a {_find_class(module)}; those with _mean and _std are known")
    epsilon = float(module.values.get("eps", 0.0))
    return first.standardize(np.ravel(mean).astype(float), 1.0 / (np.ravel(std).astype(float) + epsilon))
