"""Controllers of the source that take the position of one joint of MuJoCo, and the speed of another one."""

import ast
import functools
from collections.abc import Iterator
from typing import Any

import numpy as np

from rlctl.checking.assignments import peel
from rlctl.checking.definitions import ReadExpression
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.rule import Rule, RuleFinding
from rlctl.environments.simulations import find_mujoco


class PairedStates:
    """The differences of a source whose sides are made of positions, and of speeds: kp * (target - q) - kd * dq."""

    def __init__(self, noted: NotedEpisodes) -> None:
        self._noted, self._definitions = noted, noted.definitions
        simulation = find_mujoco(noted.instance.env)
        self._model: Any = None if simulation is None else simulation[0]

    def find(self, rule: Rule) -> Iterator[RuleFinding]:
        """Yield those whose positions and speeds are of other joints."""
        for one in self._noted.source.expressions if self._model is not None else ():
            match one.node:
                case ast.BinOp(left=left, op=ast.Sub(), right=right) if one.function in self._noted.of_steps:
                    position = self._find_state(ReadExpression(left, one.function), "qpos")
                    speed = self._find_state(ReadExpression(right, one.function), "qvel")
                case _:
                    continue
            if position is None or speed is None or len(position[1]) != len(speed[1]) or position[1] == speed[1]:
                continue
            number = next(i for i, (a, b) in enumerate(zip(position[1], speed[1], strict=True)) if a != b)
            names = [self._model.joint(joints[number]).name for joints in (position[1], speed[1])]
            message = f"{one.text} takes the position of {names[0]}, {position[0]}, and the speed of {names[1]},"
            message += f" {speed[0]}"
            evidence = {"element": one.text, "value": names[1], "expected": names[0]}
            yield RuleFinding(rule, message, evidence, where=one.where)

    def _find_state(self, place: ReadExpression, kind: str) -> tuple[str, list[int]] | None:
        """Return the only piece of a state of that kind that an expression is made of, and of which joints it is."""
        found: dict[str, ast.Subscript] = {}
        for part in self._definitions.walk(place):
            match part.node:
                case ast.Subscript(value=ast.Attribute(attr=name)) as node if name in ("qpos", "qvel"):
                    found[ast.unparse(peel(node))] = node
        if len(found) != 1 or not next(iter(found)).split("[")[0].endswith(kind):
            return None
        text, node = found.popitem()
        joints = self._list_joints(node.slice, kind)
        return None if joints is None else (text, joints)

    def _list_joints(self, index: ast.expr, kind: str) -> list[int] | None:
        owners = self._owners[kind]
        match index:
            case ast.Slice(lower=None | ast.Constant() as lower, upper=None | ast.Constant() as upper, step=None):
                ends = [None if end is None else end.value for end in (lower, upper)]
                return owners[slice(*ends)].tolist()
        one = self._noted.source.find(index)
        values = [value for call in self._noted.steps[:3] for value in call.values.get(one.number, ())] if one else []
        if not values or values[0] is None or np.ndim(values[0]) != 1:
            return None
        places = np.asarray(values[0])
        is_index = bool((places == places.astype(int)).all()) and len(places) > 0 and places.max() < len(owners)
        return owners[places.astype(int)].tolist() if is_index else None

    @functools.cached_property
    def _owners(self) -> dict[str, np.ndarray[Any, Any]]:
        """The joint of each number of qpos, and of qvel."""
        model = self._model
        found = {}
        for kind, size, firsts in (("qpos", model.nq, model.jnt_qposadr), ("qvel", model.nv, model.jnt_dofadr)):
            found[kind] = np.searchsorted(firsts, np.arange(size), side="right") - 1
        return found
