"""Lengths of velocities that the source of a reward calls the speed forwards, or along a direction."""

import ast
import dataclasses
import re
from collections.abc import Iterator

import numpy as np

from rlctl.checking.assignments import list_name_words, read_converted, read_name
from rlctl.checking.definitions import ReadExpression
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.lengths import read_vector
from rlctl.checking.paid_commands import CommandReader
from rlctl.checking.paid_errors import FEWEST
from rlctl.checking.source_code import Function
from rlctl.checking.summands import Summand
from rlctl.checking.term_names import COST_WORDS, ERROR_WORDS, split_name
from rlctl.checking.vector_series import Array

ALONG_WORDS = {"along", "forward", "forwards", "fwd", "ahead", "toward", "towards", "onward", "onwards"}
ALONG_TEXT = r"\b(along|forwards?|ahead|towards?|in the (\w+ )?direction)\b"
OTHER_WORDS = {"acc", "across", "backward", "backwards", "lateral", "sideways", *COST_WORDS, *ERROR_WORDS}
VELOCITY_WORDS = {
    *("dx", "dy", "lin", "linvel", "qvel", "speed", "v", "vel", "velocities", "velocity", "velxy", "vx", "vxy", "vy"),
    *("vz", "cvel"),
}
STRAIGHT, NEARLY_ALL = 0.05, 0.9
"""How much longer a velocity may be than its part ahead, and in which part of the steps."""


@dataclasses.dataclass(frozen=True, eq=False)
class PaidLength:
    """The length of a velocity that is called a part of it."""

    summand: Summand
    place: ReadExpression  # of the length
    vector: str
    called: str


class LengthReader:
    """Finds them."""

    def __init__(self, notes: NotedEpisodes) -> None:
        self.notes, self.definitions = notes, notes.reward.definitions
        self._walked = notes.share(CommandReader).walked

    def find(self) -> Iterator[PaidLength]:
        """Yield the lengths that are paid."""
        for summand, places in self._walked:
            names = set(split_name(summand.name))
            has_difference = any(isinstance(one.node, ast.BinOp) and isinstance(one.node.op, ast.Sub) for one in places)
            if names & OTHER_WORDS or (summand.weight < 0 and not has_difference):
                continue
            for place in places:
                vector = read_vector(place.node)
                called = "" if vector is None else self._find_name(place, summand)
                if called and self._is_velocity(place, vector):  # type: ignore[arg-type]
                    yield PaidLength(summand, place, ", ".join(map(ast.unparse, vector or ())), called)

    def _find_name(self, place: ReadExpression, summand: Summand) -> str:
        """Return what the source calls a length; empty if no name says that it is along a direction."""
        parents, node = self.notes.source.parents, place.node
        while isinstance(parent := parents.get(node), ast.expr):
            is_same = isinstance(parent, ast.Tuple | ast.Dict | ast.IfExp) or read_converted(parent) is node
            is_scaled = isinstance(parent, ast.BinOp) and isinstance(parent.op, ast.Mult | ast.Div)
            if isinstance(parent, ast.Dict):
                keys = [key for key, value in zip(parent.keys, parent.values, strict=True) if value is node]
                return self._choose([str(key.value) for key in keys if isinstance(key, ast.Constant)])
            if not is_same and not is_scaled:
                break
            node = parent
        statement = self.notes.source.find_statement(place.node)
        if isinstance(statement, ast.Return) and statement.value is node:
            return self._name_function(place.function)
        several = self.definitions.list_assigned(place.function).values()
        targets = [read_name(one.target) for some in several for one in some if one.statement is statement]
        of_value = [
            read_name(one.target)
            for some in several
            for one in some
            if one.statement is statement and any(part is place.node for part in ast.walk(one.value))
        ]
        return self._choose(of_value or targets) if node is getattr(statement, "value", node) or of_value else ""

    def _name_function(self, function: Function) -> str:
        text = ast.get_docstring(function) or ""
        described = text if re.search(ALONG_TEXT, text.lower()) else ""
        return self._choose([function.name]) or described.partition("\n")[0]

    def _choose(self, names: list[str]) -> str:
        return next((one for one in names if {*split_name(one)} & ALONG_WORDS and not _is_other(one)), "")

    def _is_velocity(self, place: ReadExpression, parts: list[ast.expr]) -> bool:
        """Say whether numbers are those of a velocity that also has other directions than one."""
        resolved = [self.definitions.resolve(place.at(part)).node for part in parts]
        words = {word for part in [*parts, *resolved] for word in list_name_words(part)}
        if not words & VELOCITY_WORDS or words & OTHER_WORDS:
            return False
        rows = self._read_rows(parts)
        return rows is None or not self._is_straight(rows)

    def _read_rows(self, parts: list[ast.expr]) -> Array | None:
        """Return the vector that the numbers are: (calls, worlds, elements)."""
        series = self.notes.turned.series
        if len(parts) == 1:
            found = [rows for size in (2, 3) if (rows := series.read(parts[0], size=size)) is not None]
            return found[0] if found else None
        elements = [series.read(part) for part in parts]
        known = [one for one in elements if one is not None]
        is_known = len(known) == len(parts) and len({one.shape for one in known}) == 1
        return np.stack(known, axis=-1) if is_known else None

    def _is_straight(self, rows: Array) -> bool:
        """Say whether a robot moves along its first axis, or along its heading, only."""
        lengths = np.linalg.norm(rows, axis=-1)
        moving = np.isfinite(lengths) & (lengths > STRAIGHT * np.nanmax(lengths, initial=0.0))
        if moving.sum() < FEWEST:
            return True
        directions = np.arctan2(rows[..., 1], rows[..., 0])
        headings = [np.zeros_like(directions)]
        headings += [angles for _, angles in self.notes.turned.directions.angles if angles.shape == directions.shape]
        for heading in headings:
            aside = np.abs(np.sin(directions - heading))
            known = aside[moving & np.isfinite(aside)]
            if known.size and (known < STRAIGHT**0.5).mean() > NEARLY_ALL:
                return True
        return False


def _is_other(name: str) -> bool:
    return bool({*split_name(name)} & OTHER_WORDS)
