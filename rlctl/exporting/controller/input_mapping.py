"""The mapping that `rlctl diagnose` wrote, inside an exported controller: from a program's values to the policy's."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.deploy.controller_layout import ControllerLayout
from rlctl.deploy.diagnose.mapping import CorrectedMapping, TermMapping
from rlctl.errors import RecipeError, UsageError, check_name
from rlctl.storage import yaml_text


@dataclasses.dataclass(frozen=True, eq=False)
class InputMap:
    """value = factor * input[order] + offset."""

    order: NDArray[np.int64]
    factor: NDArray[np.float64]
    offset: NDArray[np.float64]

    def undo(self, value: NDArray[Any]) -> NDArray[np.float64]:
        """Return the input of which `value` is made, shape (elements,)."""
        found = np.empty(len(self.order))
        found[self.order] = (np.asarray(value, np.float64) - self.offset) / self.factor
        return found

    def describe(self) -> str:
        """Return what it does, for people."""
        parts = {"order": self.order, "factor": self.factor, "offset": self.offset}
        usual = {"order": np.arange(len(self.order)), "factor": 1.0, "offset": 0.0}
        shown = [f"{key} {values.tolist()}" for key, values in parts.items() if (values != usual[key]).any()]
        return ", ".join(shown) or "unchanged"


InputMaps = Mapping[str, InputMap]


def read_mapping(path: Path, layout: ControllerLayout) -> dict[str, InputMap]:
    """Read the mapping of a controller's inputs from YAML.

    Raises `RecipeError` for a mapping that does not fit the policy, `UsageError` for what a controller cannot do.
    """
    mapping = yaml_text.read_model(path, CorrectedMapping)
    if mapping.actions is not None:
        raise UsageError(
            f"{path}: actions: a controller's outputs are the policy's; change them where the program sends them"
        )
    computed = {part.name: part.term.inputs for part in layout.observed if part.term is not None}
    sizes = {quantity.name: quantity.size for quantity in layout.quantities}
    maps = {}
    for name, term in mapping.observations.items():
        if name not in sizes and name in computed:
            inputs = ", ".join(computed[name]) or "its own state"
            raise UsageError(f"{path}: {name} is computed inside the controller, from {inputs}; map that instead")
        check_name(name, sizes, f"{path}: the controller has no input", RecipeError)
        maps[name] = _check(f"{path}: {name}", term, sizes[name])
    return maps


def _check(where: str, term: TermMapping, size: int) -> InputMap:
    if term.delay or term.frame:
        what = f"delay {term.delay}" if term.delay else f"frame {term.frame}"
        raise UsageError(f"{where}: {what}: a controller cannot undo it; remove the cause in the program")
    for key in ("order", "sign", "scale", "offset"):
        values = getattr(term, key)
        if values is not None and len(values) != size:
            raise RecipeError(f"{where}: {key} has {len(values)} numbers, the input {size}")
    order = np.array(term.order if term.order is not None else range(size), np.int64)
    if sorted(order.tolist()) != list(range(size)):
        raise RecipeError(f"{where}: order {order.tolist()} must have each of 0 to {size - 1} once")
    factor = np.array(term.sign or np.ones(size)) * np.array(term.scale or np.ones(size))
    if (factor == 0).any():
        raise RecipeError(f"{where}: sign and scale must not be 0")
    return InputMap(order, factor, np.array(term.offset or np.zeros(size)))
