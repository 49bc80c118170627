"""The mapping between a program's values and the policy's, inside an exported controller: of inputs and of targets."""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
import pydantic
from numpy.typing import NDArray

from rlctl.errors import RecipeError, UsageError, check_name
from rlctl.exporting.controller.plan import ControllerPlan, Quantity
from rlctl.storage import yaml_text
from rlctl.storage.validation import Number, Section, Whole


def _check_sign(value: float) -> float:
    if value not in (1.0, -1.0):
        raise ValueError(f"a sign is 1 or -1, not {value:g}; write factors as scale")
    return value


Sign = Annotated[Number, pydantic.AfterValidator(_check_sign)]


class MappedValue(Section):
    """value = sign * scale * given[order] + offset; a key that is left out changes nothing."""

    order: list[Whole] | list[str] | None = None
    """Element of the given value for each element of the result; or the elements' names in the program's order."""
    sign: list[Sign] | None = None
    """1 or -1 for each element."""
    scale: Number | list[Number] | None = None
    """Positive factor for each element, or one for all."""
    offset: Number | list[Number] | None = None
    """Added to each element, or to all, in the unit of the result."""
    unit: str | None = None
    """Unit of the program's values, for the header."""
    like: str | None = None
    """Only of targets: the observation whose mapping leads from the targets to the policy's."""
    delay: Whole = 0
    """Control steps by which the value is late; a controller cannot undo it."""
    frame: str | None = None
    """`to body` or `to world`; a controller cannot turn vectors."""


class MappingFile(Section):
    """A program's values and the policy's; `rlctl diagnose` prints such a file."""

    observations: dict[str, MappedValue] = {}
    """From the program's value to the policy's, per input."""
    targets: MappedValue | None = None
    """From the policy's targets of the joints to the program's."""
    actions: MappedValue | None = None
    """From the policy's action to what the robot must execute; no controller applies it, and `targets` replaces it."""
    log: Any = None
    """What only a log has otherwise; a controller needs no change for it."""


@dataclasses.dataclass(frozen=True, eq=False)
class ElementMap:
    """value = factor * given[order] + offset."""

    order: NDArray[np.int64]
    factor: NDArray[np.float64]
    offset: NDArray[np.float64]
    unit: str = ""  # of the program's values; empty if unknown
    names: tuple[str, ...] = ()  # of the program's elements, in its order; empty if unknown

    def undo(self, value: NDArray[Any]) -> NDArray[np.float64]:
        """Return what `value` is made of, shape (elements,)."""
        given = np.empty(len(self.order))
        given[self.order] = (np.asarray(value, np.float64).ravel() - self.offset) / self.factor
        return given

    def invert(self) -> Self:
        """Return the map from values to what they are made of."""
        back = np.argsort(self.order)
        return dataclasses.replace(
            self, order=back, factor=(1.0 / self.factor)[back], offset=0.0 - (self.offset / self.factor)[back]
        )

    def describe(self) -> str:
        """Return what it does, for people."""
        parts = {"order": self.order, "factor": self.factor, "offset": self.offset}
        usual = {"order": np.arange(len(self.order)), "factor": 1.0, "offset": 0.0}
        shown = [f"{key} {_shorten(values)}" for key, values in parts.items() if (values != usual[key]).any()]
        return ", ".join(shown) or "unchanged"

    @property
    def of_program(self) -> str:
        """What the program's values are, for people."""
        unit = f" [{self.unit}]" if self.unit else ""
        return f"the program's value{unit}" + (f": {', '.join(self.names)}" if self.names else "")


@dataclasses.dataclass(frozen=True)
class ProgramMapping:
    """The maps from a program's inputs to the policy's, by name, and from the policy's targets to the program's."""

    inputs: Mapping[str, ElementMap] = dataclasses.field(default_factory=dict)
    targets: ElementMap | None = None

    def describe(self) -> dict[str, str]:
        """Return a line per map, for people."""
        lines = {name: one.describe() for name, one in self.inputs.items()}
        return lines if self.targets is None else {**lines, "target": self.targets.describe()}

    def find_unit(self, quantity: Quantity) -> str:
        """Return the unit of what the program gives for a quantity; empty if it is unknown."""
        return self.inputs[quantity.name].unit if quantity.name in self.inputs else quantity.unit


def _shorten(values: NDArray[Any]) -> str:
    texts = [f"{value:.6g}" for value in values.tolist()]
    return texts[0] if len(set(texts)) == 1 else f"[{', '.join(texts)}]"


NO_MAPPING = ProgramMapping()


def read_mapping(path: Path, plan: ControllerPlan) -> ProgramMapping:
    """Read the mapping of a controller from YAML.

    Raises `RecipeError` for a mapping that does not fit the policy, `UsageError` for what a controller cannot do.
    """
    mapping, target = yaml_text.read_model(path, MappingFile), plan.target
    if mapping.actions is not None and mapping.targets is None:
        instead = "the controller returns targets of joints: map them with targets:"
        if target is None:
            instead = "change the action where the program sends it"
        raise UsageError(f"{path}: actions: what diagnose prints there is of the policy's action; {instead}")
    computed = {part.name: part.term.inputs for part in plan.observed if part.term is not None}
    quantities = {quantity.name: quantity for quantity in plan.quantities}
    maps = {}
    for name, value in mapping.observations.items():
        if name not in quantities and name in computed:
            inputs = ", ".join(computed[name]) or "its own state"
            raise UsageError(f"{path}: {name} is computed inside the controller, from {inputs}; map that instead")
        check_name(name, quantities, f"{path}: the controller has no input", RecipeError)
        maps[name] = _map_input(f"{path}: {name}", value, quantities[name], plan)
    if mapping.targets is None:
        return ProgramMapping(maps)
    if target is None:
        raise UsageError(f"{path}: targets: the task does not describe what an action commands, so there are none")
    return ProgramMapping(maps, _map_targets(f"{path}: targets", mapping.targets, plan, maps, target.unit))


def _map_input(where: str, value: MappedValue, quantity: Quantity, plan: ControllerPlan) -> ElementMap:
    if value.like is not None:
        raise UsageError(f"{where}: like: only targets can be like an observation")
    names = _name_elements(quantity, plan)
    order = _read_order(where, value, quantity.size, names)
    back = np.argsort(order)
    one = _read_numbers(where, value, order, quantity.unit)
    return _name(one, [names[index] for index in back] if names else [], quantity.unit)


def _map_targets(
    where: str, value: MappedValue, plan: ControllerPlan, maps: Mapping[str, ElementMap], unit: str
) -> ElementMap:
    size, names = plan.action_size, list(plan.env.joints.names if plan.env.joints is not None else [])
    if value.like is not None:
        if value.model_fields_set != {"like"}:
            raise RecipeError(f"{where}: like and other keys exclude each other")
        check_name(value.like, maps, f"{where}: like: the file maps no observation", RecipeError)
        if len(maps[value.like].order) != size:
            raise RecipeError(f"{where}: like: {value.like} has {len(maps[value.like].order)} elements, not {size}")
        one = maps[value.like].invert()
        return dataclasses.replace(one, names=tuple(names[index] for index in one.order))
    order = _read_order(where, value, size, names)
    if value.order and isinstance(value.order[0], str):
        order = np.argsort(order)
    one = _read_numbers(where, value, order, unit)
    return _name(one, [names[index] for index in order], unit)


def _name_elements(quantity: Quantity, plan: ControllerPlan) -> list[str]:
    """Return the names of a quantity's elements, in the policy's order; empty if they have none."""
    joints, axes = plan.env.joints, re.findall(r"\b[xyzw]\b", quantity.unit)
    if "quaternion" in quantity.unit and len(axes) == quantity.size:
        return axes
    is_of_joints = joints is not None and (quantity.name == joints.measured or quantity.name.startswith("joint"))
    if joints is None or not is_of_joints or len(joints.names) != quantity.size:
        return []
    return list(joints.names)


def _read_order(where: str, value: MappedValue, size: int, names: Sequence[str]) -> NDArray[np.int64]:
    """Return the index of the program's element for each of the policy's if names are given, else as it is given."""
    given = value.order or range(size)
    if isinstance(given[0], str):
        if not names:
            raise RecipeError(f"{where}: order: the elements have no names; write their indices, from 0")
        for name in given:
            check_name(str(name), names, f"{where}: order: no element", RecipeError, listed="Known")
        if sorted(map(str, given)) != sorted(names):
            raise RecipeError(f"{where}: order must have each of {', '.join(names)} once")
        return np.array([list(given).index(name) for name in names], np.int64)
    order = np.array(given, np.int64)
    if len(order) != size:
        raise RecipeError(f"{where}: order has {len(order)} numbers, not {size}")
    if sorted(order.tolist()) != list(range(size)):
        raise RecipeError(f"{where}: order {order.tolist()} must have each of 0 to {size - 1} once")
    return order


def _read_numbers(where: str, value: MappedValue, order: NDArray[np.int64], unit: str) -> ElementMap:
    if value.delay or value.frame:
        what = f"delay {value.delay}" if value.delay else f"frame {value.frame}"
        raise UsageError(f"{where}: {what}: a controller cannot undo it; remove the cause in the program")
    size, numbers = len(order), {}
    for key, usual in (("sign", 1.0), ("scale", 1.0), ("offset", 0.0)):
        given = np.atleast_1d(usual if getattr(value, key) is None else getattr(value, key))
        if len(given) != size and (isinstance(getattr(value, key), list)):
            raise RecipeError(f"{where}: {key} has {len(given)} numbers, not {size}")
        numbers[key] = np.broadcast_to(given, (size,)).astype(np.float64)
    if not (numbers["scale"] > 0).all():
        raise RecipeError(f"{where}: scale must be positive; write -1 as sign")
    own = unit if (numbers["scale"] == 1.0).all() else ""
    factor = numbers["sign"] * numbers["scale"]
    return ElementMap(order, factor, numbers["offset"], own if value.unit is None else value.unit)


def _name(one: ElementMap, names: Sequence[str], unit: str) -> ElementMap:
    """Return the map with the names of the program's elements; the unit of a quaternion is its order."""
    if one.unit == unit and "quaternion" in unit and names:
        return dataclasses.replace(one, unit=f"quaternion {', '.join(names)}")
    return dataclasses.replace(one, names=tuple(names))
