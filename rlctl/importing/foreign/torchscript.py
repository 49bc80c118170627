"""Reads the network of a TorchScript archive as data. None of its code is executed.

The weights are read from the archive's pickle, the structure from the classes of the modules, and the order of the
parts from the code of the exported module, as text: a module that does more than its parts is refused.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from rlctl.errors import ArtifactError, short_repr
from rlctl.importing.foreign.network import (
    Array,
    ForeignLinear,
    ForeignLstm,
    ForeignNetwork,
    Layer,
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
_CONVERT = "convert it where it was trained: torch.onnx.export(policy, zeros, 'policy.onnx')"


def read_torchscript_network(path: Path) -> ForeignNetwork:
    """Return the network of a TorchScript file; raises `ArtifactError` for one that is not imported."""
    content = untrusted.read_bytes(path)
    try:
        return _read(read_torchscript(content))
    except NotImportable as error:
        raise ArtifactError(f"{path}: {error}; {_CONVERT}") from None
    except (NotPlainData, *untrusted.ZIP_ERRORS, LookupError, TypeError, AttributeError) as error:
        raise ArtifactError(f"{path}: damaged, or not TorchScript: {short_repr(str(error), 200)}") from None


def _read(module: Module) -> ForeignNetwork:
    if _find_class(module) == "Sequential":
        return assemble(_list_layers(module), ACTIVATIONS)
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
    start = module.code.find("def forward(")
    if start < 0:
        raise NotImportable(f"its module {_find_class(module)} has no forward")
    body = module.code[start:]
    end = body.find("\n  def ", 1)
    body = body if end < 0 else body[:end]
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


def _list_layers(module: Module) -> list[Layer]:
    """Return the layers of a `Sequential`, in the order of its numbers."""
    layers: list[Layer] = []
    for name in sorted(module.modules, key=_read_number):
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
