"""Writes a controller as C99: a header and a source file without dependencies."""

import dataclasses
import re
from typing import Any

import numpy as np

from rlctl.exporting import c_source
from rlctl.exporting.c_network import list_functions, write_action, write_network
from rlctl.exporting.c_source import CFunction, CSource
from rlctl.exporting.controller.limits_source import LimitsSource
from rlctl.exporting.controller.plan import ControllerPlan, JointTarget, Observed, Quantity
from rlctl.exporting.controller.program_mapping import NO_MAPPING, ElementMap, ProgramMapping
from rlctl.exporting.controller.symbols import CSymbol, CTables
from rlctl.limits.fitting import fit_limits
from rlctl.limits.limits import NO_LIMITS, Limits
from rlctl.policy.c_writer import CWriter, write_array, write_number
from rlctl.policy.file import PolicyFile
from rlctl.policy.network import Network
from rlctl.task.terms import Playback
from rlctl.version import __version__

_BASES = {
    "position": "{name}_default_positions[i] + ",
    "step": "position + ",
    "correction": "reference[i] + ",
}


@dataclasses.dataclass(frozen=True)
class _TargetCode:
    """The target as the templates read it."""

    kind: str
    interface: str
    formula: str
    unit: str
    base: str
    clips: str
    measured: int
    default: bool
    reference: list[str]  # expressions of the row that is corrected
    needs_inputs: bool


class ControllerSource:
    """The C code of a policy's controller; names of functions begin with the name of the file.

    Raises `UsageError` for a policy that cannot be written as C, `RecipeError` for limits that do not fit it.
    """

    def __init__(
        self,
        policy: PolicyFile,
        plan: ControllerPlan,
        file_name: str,
        limits: Limits | None,
        mapping: ProgramMapping = NO_MAPPING,
    ) -> None:
        c_source.check_can_be_written(policy)
        self.plan = plan
        self._mapping = mapping
        fitted = fit_limits(limits or NO_LIMITS, plan.inputs_info)
        self.limits = fitted.limits
        assert fitted.bounds is not None  # the actions are in a Box
        self._limits_source = LimitsSource(self.limits, fitted, fitted.bounds)
        self.target = plan.target if limits is None else plan.find_target(fitted)
        self.name = c_source.make_identifier(file_name)
        self._tables = CTables()
        self._values = self._describe(policy)

    def write(self, timing: str = "") -> CSource:
        """Return the code, with how long a step takes in the header's comment."""
        values = {**self._values, "timing": timing}
        header, source, harness = (
            c_source.render(file, values) for file in ("controller.h", "controller.c", "controller_harness.c")
        )
        prototype = (
            f"int {self.name}_step({self.name}_state *, const {self.name}_inputs *, double, {self.name}_outputs *)"
        )
        return CSource(self.name, header, source, prototype, harness)

    def _describe(self, policy: PolicyFile) -> dict[str, Any]:
        plan, network, writer = self.plan, Network(policy), CWriter()
        described = CFunction(self.name, policy.info)
        sizes = {key: part.shape[0] for key, part in plan.parts.items()}  # type: ignore[index]  # vectors
        value = write_network(writer, network, sizes, "state->observation")
        write_action(writer, network, value, plan.action_space, described.action_type)
        lstm = network.lstm
        hidden = 0 if lstm is None else len(lstm.layers) * lstm.hidden_size
        values: dict[str, Any] = {
            "name": self.name,
            "upper": self.name.upper(),
            "version": __version__,
            "info": policy.info,
            "plan": plan,
            "action_lines": described.describe_action(),
            "limits": self._limits_source,
            "kind": described.type,
            "type": described.action_type,
            "stacks": plan.stacks,
            "lstm_size": hidden,
            "arrays": self._list_arrays(described),
            "target": None if self.target is None else self._describe_target(self.target),
            "read_lines": [line for quantity in plan.quantities for line in self._write_reading(quantity)],
            "mapped": [f"{name}: {text}" for name, text in self._mapping.describe().items()],
            "members": {part.name: self._describe_input(part) for part in plan.quantities},
            "program_target": self._mapping.targets,
            "target_lines": [] if (one := self._mapping.targets) is None else self._write_targets(one),
            "term_lines": [line for part in plan.observed for line in self._write_term(part, described.type)],
            "constants": [*writer.constants, *self._write_tables()],
            "functions": list_functions(writer),
            "statements": writer.statements,
        }
        return {**values, "limits_code": self._write_limits(values)}

    def _write_limits(self, values: dict[str, Any]) -> str:
        """Return the code of the limits, with the constants that it uses."""
        code = c_source.render("limits.c", {**values, "constants_of_limits": []})
        used = set(re.findall(r"\w+", code))
        arrays = [text for name, text in self._limits_source.list_arrays().items() if name in used]
        return c_source.render("limits.c", {**values, "constants_of_limits": arrays})

    def _write_reading(self, quantity: Quantity) -> list[str]:
        """Return statements that read an input; with a mapping from the program's values to the policy's."""
        name, start = quantity.identifier, quantity.start
        if (one := self._mapping.inputs.get(quantity.name)) is None:
            loop = f"for (int i = 0; i < {quantity.size}; ++i) {{"
            return [loop, f"    values[{start} + i] = inputs->{name}[i];", "}"]
        rows = zip(one.order.tolist(), one.factor, one.offset, strict=True)
        return [
            f"values[{start + index}] = {write_number(factor, 'double')} * (double)inputs->{name}[{element}] + "
            f"{write_number(offset, 'double')};"
            for index, (element, factor, offset) in enumerate(rows)
        ]

    def _write_targets(self, one: ElementMap) -> list[str]:
        """Return statements that write the program's targets for the policy's."""
        rows = zip(one.order.tolist(), one.factor, one.offset, strict=True)
        return [
            f"outputs->target[{index}] = {write_number(factor, 'double')} * state->target[{element}] + "
            f"{write_number(offset, 'double')};"
            for index, (element, factor, offset) in enumerate(rows)
        ]

    def _describe_input(self, part: Quantity) -> str:
        """Return the unit of an input as the program gives it, for people; empty if it is unknown."""
        if part.name in self._mapping.inputs:
            return self._mapping.inputs[part.name].of_program
        return f"[{part.unit}]" if part.unit else ""

    def _write_term(self, part: Observed, kind: str) -> list[str]:
        """Return statements that compute the newest values of a part of the observation."""
        quantities = {quantity.name: quantity for quantity in self.plan.quantities}
        if part.term is None:
            start = quantities[part.name].start
            loop = f"for (int i = 0; i < {part.size}; ++i) {{"
            return [loop, f"    newest[{part.newest} + i] = ({kind})values[{start} + i];", "}"]
        symbols = [self._read_quantity(quantities[name].start, quantities[name].size) for name in part.term.inputs]
        if part.term.internal == "last_action":
            symbols.append(CSymbol([f"(double)state->last_action[{index}]" for index in range(part.size)]))
        elif part.term.internal == "time":
            symbols.append(self._read_time())
        parts: list[CSymbol] = part.term.compute(*symbols)
        expressions = [element for symbol in parts for element in symbol.elements]
        return [f"newest[{part.newest + i}] = ({kind}){text};" for i, text in enumerate(expressions)]

    def _read_quantity(self, start: int, size: int) -> CSymbol:
        return CSymbol([f"values[{start + index}]" for index in range(size)], self._tables)

    def _read_time(self) -> CSymbol:
        return CSymbol([f"((double)state->steps * {self.plan.env.control_dt!r})"], self._tables)

    def _write_tables(self) -> list[str]:
        arrays = self._tables.arrays.values()
        return [
            write_array(f"static const double {name}", [write_number(value, "double") for value in table.ravel()])
            for name, table in arrays
        ]

    def _write_reference(self, playback: Playback) -> list[str]:
        """Return an expression per joint for the row of a clip that a target corrects."""
        time = self._read_time()
        if playback.time:
            quantity = self.plan.find_quantity(playback.time)
            time = self._read_quantity(quantity.start, quantity.size)
        (row,) = playback.compute(time)
        return [*row.elements]

    def _describe_target(self, target: JointTarget) -> _TargetCode:
        base = _BASES.get(target.kind, "").format(name=self.name)
        is_position, joints = target.kind == "position", self.plan.env.joints
        playback = target.playback
        return _TargetCode(
            target.kind,
            target.interface,
            target.formula,
            target.unit,
            base,
            target.clips,
            target.measured,
            default=is_position or (playback is not None and bool(joints and joints.default_positions)),
            reference=[] if playback is None else self._write_reference(playback),
            needs_inputs=target.kind == "step" or (playback is not None and bool(playback.time)),
        )

    def _list_arrays(self, described: CFunction) -> list[tuple[str, str, str, list[str]]]:
        """Return the header's constant arrays: type, name, the macro of the length, and the values as C."""
        quote, target, env = c_source.quote, self.target, self.plan.env
        quantities = self.plan.quantities
        arrays: list[tuple[str, str, str, list[str]]] = [
            ("char *const", "input_names", "INPUTS", [quote(quantity.name) for quantity in quantities]),
            (
                "char *const",
                "input_units",
                "INPUTS",
                [quote(self._mapping.find_unit(quantity)) for quantity in quantities],
            ),
            ("int", "input_sizes", "INPUTS", [str(quantity.size) for quantity in quantities]),
            *(array for array in described.list_arrays() if array[2] == "ACTION_SIZE"),
        ]
        if (one := self._mapping.targets) is not None and one.names:
            arrays.append(("char *const", "target_names", "ACTION_SIZE", [quote(name) for name in one.names]))
        numbers: dict[str, Any] = {}
        if target is not None:
            numbers["target_factor"] = target.factor
            if target.kind == "position":
                numbers["default_positions"] = target.default
            if target.clips:
                numbers |= {"target_low": target.low, "target_high": target.high}
        if env.joints is not None and env.joints.default_positions:
            numbers.setdefault("default_positions", np.array(env.joints.default_positions))
        if env.joints is not None and env.joints.low and env.joints.high:
            numbers |= {"joint_low": np.array(env.joints.low), "joint_high": np.array(env.joints.high)}
        if env.joints is not None:
            gains = {
                "joint_stiffness": env.joints.stiffness,
                "joint_damping": env.joints.damping,
                "drive_gain": env.joints.drive_gain,
                "drive_voltage": env.joints.drive_voltage,
            }
            numbers |= {name: np.array(values) for name, values in gains.items() if values}
        for name, array in numbers.items():
            arrays.append(("double", name, "ACTION_SIZE", [write_number(value, "double") for value in array]))
        return arrays
