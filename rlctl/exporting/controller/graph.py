"""Writes a controller as one ONNX graph: a named input per quantity; action, targets and the next state out."""

from typing import Any

import numpy as np
import onnx

from rlctl.exporting.controller.plan import ControllerPlan, JointTarget, Observed, Quantity
from rlctl.exporting.controller.program_mapping import NO_MAPPING, ElementMap, ProgramMapping
from rlctl.exporting.controller.symbols import GraphSymbol
from rlctl.exporting.onnx_source import emit_policy, make_metadata
from rlctl.policy import onnx_policy
from rlctl.policy.file import PolicyFile
from rlctl.policy.onnx_graph import BATCH, Graph
from rlctl.task.layout import Part
from rlctl.task.terms import Playback

TARGET = "target"
OBSERVATION, LAST_ACTION, STEPS = "state_observation", "state_action", "state_steps"
"""Names of the state's inputs: the last observation, the last action, the number of steps of the episode."""
_TAKEN = {onnx_policy.ACTION, TARGET, *onnx_policy.STATE_INPUTS, OBSERVATION, LAST_ACTION, STEPS}
_ZEROS = "zeros when an episode begins, then the output of the step before"


def build_graph(policy: PolicyFile, plan: ControllerPlan, mapping: ProgramMapping = NO_MAPPING) -> onnx.ModelProto:
    """Write a policy's controller, without limits, as ONNX. Raises `UsageError` for one that cannot be written."""
    return _Writer(policy, plan, mapping).write()


def name_input(quantity: str) -> str:
    """Return the name of a quantity's input: its own, or with `_input` where the graph itself uses that name."""
    is_taken = quantity.startswith("/") or quantity in _TAKEN or quantity.endswith("_out")
    return f"{quantity.lstrip('/')}_input" if is_taken else quantity


class _Writer:
    def __init__(self, policy: PolicyFile, plan: ControllerPlan, mapping: ProgramMapping) -> None:
        self._policy, self._graph, self._mapping = policy, Graph(), mapping
        self._plan = plan
        self._target = self._plan.target
        self._inputs = {part.name: self._add_input(part) for part in self._plan.quantities}
        self._inputs |= {name: self._map_input(name, one) for name, one in mapping.inputs.items()}
        self._states: list[str] = []
        self._steps = ""
        if "time" in plan.internal or (plan.stacks and plan.repeats_first):
            self._steps = self._graph.input(STEPS, np.int64, (BATCH, 1), f"steps of the episode; {_ZEROS}")

    def _add_input(self, part: Quantity) -> str:
        graph, shape, unit = self._graph, (BATCH, part.size), part.unit
        text = f"[{unit}]" if unit else ""
        if part.name in self._mapping.inputs:
            text = self._mapping.inputs[part.name].of_program
        return graph.input(name_input(part.name), self._plan.dtype, shape, text)

    def _map_input(self, name: str, one: ElementMap) -> str:
        """Add the mapping from the program's values of an input to the policy's."""
        return self._graph.cast(self._map(f"mapping/{name}", self._inputs[name], one), self._plan.dtype)

    def _map(self, name: str, given: str, one: ElementMap) -> str:
        graph = self._graph
        value = graph.add("Gather", given, graph.constant(f"{name}/order", one.order), axis=1)
        value = graph.add("Mul", self._read(value), graph.constant(f"{name}/factor", one.factor))
        return graph.add("Add", value, graph.constant(f"{name}/offset", one.offset))

    def write(self) -> onnx.ModelProto:
        graph, plan, info = self._graph, self._plan, self._policy.info
        action_type = np.result_type(np.float32, plan.action_space.dtype)
        if "last_action" in plan.internal:
            shape = (BATCH, plan.action_size)
            self._last_action = graph.input(LAST_ACTION, action_type, shape, f"last action; {_ZEROS}")
        newest = [self._compute(part) for part in plan.observed]
        observation = self._stack(newest) if plan.stacks else graph.concatenate(newest)
        emit_policy(graph, self._policy, self._split(observation))
        action = onnx_policy.ACTION
        if self._target is not None:
            self._emit_target(action, self._target)
        if "last_action" in plan.internal:
            self._add_state(graph.add("Identity", action), LAST_ACTION, action_type, (BATCH, plan.action_size))
        if self._steps:
            after = graph.add("Add", self._steps, graph.constant("controller/one", np.array([1], np.int64)))
            self._add_state(after, STEPS, np.int64, (BATCH, 1))
        description = f"controller of {info.spec.task}: measured quantities in, action and joint targets out; no limits"
        return graph.model(self._describe(), description)

    def _describe(self) -> dict[str, str]:
        """Return the policy's metadata, with the inputs; what the file is not, a policy of `rlctl`, is left out."""
        metadata, quantities = make_metadata(self._policy.info), self._plan.quantities
        del metadata[onnx_policy.METADATA_KEY]
        metadata.pop("state", None)
        states = ", ".join(self._states)
        target = self._target
        return metadata | {
            onnx_policy.CONTROLLER_KEY: "1",
            "input_names": ",".join(name_input(part.name) for part in quantities),
            "input_sizes": ",".join(str(part.size) for part in quantities),
            "input_units": ",".join(self._mapping.find_unit(part).replace(",", ";") for part in quantities),
            **({"target": self._describe_target(target)} if target is not None else {}),
            **({"state": f"{states}: {_ZEROS}, NAME_out"} if states else {}),
        }

    def _compute(self, part: Observed) -> str:
        """Add the newest values of a part of the observation."""
        graph, term = self._graph, part.term
        if term is None:
            return self._inputs[part.name]
        sizes = {quantity.name: quantity.size for quantity in self._plan.quantities}
        symbols = [GraphSymbol(graph, self._read(self._inputs[name]), sizes[name]) for name in term.inputs]
        if term.internal == "last_action":
            symbols.append(GraphSymbol(graph, self._read(self._last_action), part.size))
        elif term.internal == "time":
            symbols.append(self._read_time())
        parts: list[GraphSymbol] = term.compute(*symbols)
        joined = graph.concatenate([symbol.value for symbol in parts])
        return graph.cast(joined, self._plan.dtype)

    def _read_time(self) -> GraphSymbol:
        graph = self._graph
        dt = graph.constant(f"controller/control_dt_{graph.count_constants()}", np.float64(self._plan.env.control_dt))
        return GraphSymbol(graph, graph.add("Mul", self._read(self._steps), dt), 1)

    def _read(self, value: str) -> str:
        return self._graph.cast(value, np.float64)

    def _stack(self, newest: list[str]) -> str:
        """Add the histories: the last values of the state, and the newest."""
        graph, plan = self._graph, self._plan
        shape = (BATCH, plan.size)
        before = graph.input(OBSERVATION, plan.dtype, shape, f"last observation; {_ZEROS}")
        if plan.frames > 1:
            newest = [graph.concatenate(newest)]
        if plan.repeats_first:
            zero = graph.constant("controller/zero", np.array([0], np.int64))
            self._is_first = graph.add("Equal", self._steps, zero)
        parts = [self._append(stack, before, value) for stack, value in zip(plan.stacks, newest, strict=True)]
        observation = graph.concatenate(parts)
        self._add_state(graph.add("Identity", observation), OBSERVATION, plan.dtype, shape)
        return observation

    def _append(self, stack: Part, before: str, newest: str) -> str:
        if stack.frames == 1:
            return newest
        graph = self._graph
        places = np.arange(stack.start + stack.size, stack.start + stack.size * stack.frames)
        older = graph.add("Gather", before, graph.constant(f"controller/older_{stack.start}", places), axis=1)
        value = graph.add("Concat", older, newest, axis=1)
        if not self._plan.repeats_first:
            return value
        return graph.add("Where", self._is_first, graph.add("Concat", *[newest] * stack.frames, axis=1), value)

    def _split(self, observation: str) -> dict[str, tuple[str, Any]]:
        """Return the parts of the policy's observation by key."""
        plan, parts = self._plan, dict[str, tuple[str, Any]]()
        for key, space in plan.parts.items():
            value = observation
            if len(plan.parts) > 1:
                starts = [part.start for part in plan.observed if part.key == key]
                places = self._graph.constant(f"controller/{key}", np.arange(space.shape[0]) + starts[0])  # type: ignore[index]
                value = self._graph.add("Gather", observation, places, axis=1)
            parts[key] = value, space.dtype
            if space.dtype != plan.dtype:
                parts[key] = self._graph.cast(value, space.dtype), space.dtype
        return parts

    def _emit_target(self, action: str, target: JointTarget) -> None:
        graph = self._graph
        value = graph.add("Mul", self._read(action), graph.constant("target/factor", target.factor))
        joints = self._policy.info.env.joints
        if target.kind == "position":
            value = graph.add("Add", graph.constant("target/default", target.default), value)
        elif target.kind == "step" and joints is not None:
            value = graph.add("Add", self._read(self._inputs[joints.measured]), value)
        elif target.playback is not None:
            value = graph.add("Add", self._add_reference(target.playback), value)
        if target.clips:
            value = graph.add("Max", value, graph.constant("target/low", target.low))
            value = graph.add("Min", value, graph.constant("target/high", target.high))
        if (one := self._mapping.targets) is not None:
            value = self._map("mapping/target", value, one)
        graph.output(value, TARGET, np.float64, (BATCH, self._plan.action_size), self._describe_target(target))

    def _add_reference(self, playback: Playback) -> str:
        """Add the row of a clip that a target corrects."""
        if playback.time:
            time = GraphSymbol(self._graph, self._read(self._inputs[playback.time]), 1)
        else:
            time = self._read_time()
        (row,) = playback.compute(time)
        return str(row.value)

    def _describe_target(self, target: JointTarget) -> str:
        one = self._mapping.targets
        return target.formula if one is None else f"{one.of_program}; mapped ({one.describe()}) from {target.formula}"

    def _add_state(self, value: str, name: str, dtype: Any, shape: tuple[int | str, ...]) -> None:
        self._states.append(name)
        self._graph.output(value, f"{name}_out", dtype, shape, "state for the next step")
