"""What the steps of an episode leave to the next: constraints and bodies of PyBullet, forces and switches of MuJoCo,
and attributes that are set under conditions which episodes of a check hardly ever meet."""

import ast
import functools
from collections.abc import Iterator, Sequence, Set

import numpy as np

from rlctl.checking.assignments import Assignment, read_key, read_name, read_words
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.expressions import NotedCall, Value
from rlctl.checking.goal_draws import Branch, GoalDraws
from rlctl.checking.source_code import FaultyCode, Function, write_code
from rlctl.environments.bullet_calls import record_calls

RESETS = {"reset", "reset_model", "reset_idx", "_reset"}
REMOVED = {
    "createConstraint": {"removeConstraint", "resetSimulation", "disconnect"},
    "createMultiBody": {"removeBody", "resetSimulation", "disconnect"},
    "loadURDF": {"removeBody", "resetSimulation", "disconnect"},
}
"""What PyBullet keeps until it is removed, and what removes it; restoreState does not."""
FIELDS = {"xfrc_applied", "qfrc_applied", "eq_active", "mocap_pos", "mocap_quat"}
"""Fields of MuJoCo's data that stay as they are."""
STATE_FIELDS = FIELDS | {"ctrl", "qpos", "qvel", "act", "qacc_warmstart", "time"}
DATA_RESETS = {"mj_resetData", "mj_resetDataKeyframe", "mj_setState", "mj_copyData", "MjData"}
LASTING_WORDS = {
    "all", "best", "buffer", "cache", "cached", "curriculum", "difficulty", "episode", "episodes", "ever", "frames",
    "history", "level", "lifetime", "log", "max", "record", "rate", "render", "renderer", "running", "score", "stats",
    "success", "successes", "total", "viewer", "window", "wins",
}  # fmt: skip
"""What is meant to last longer than an episode."""
DRAWING = {"changeVisualShape", "addUserDebugLine", "addUserDebugText", "removeUserDebugItem", "render", "print"}
ACTING = ast.Assign | ast.AugAssign | ast.AnnAssign | ast.NamedExpr | ast.Delete | ast.Return | ast.Raise | ast.Break
FORCED_FROM, FORCED_STEPS = 2, 5
MOST_TRIED = 6


class LeftOvers:
    """Finds them."""

    def __init__(self, noted: NotedEpisodes) -> None:
        self.noted, self.definitions, self.source = noted, noted.definitions, noted.source
        self._draws = noted.share(GoalDraws)
        functions = self.definitions.functions
        own = [one for name in RESETS for one in functions.get(name, ())]
        self._resets = self._close([*own, *(one for one in noted.of_resets if isinstance(one, Function))])
        self._steps = self._close([one for one in noted.of_steps if isinstance(one, Function)])

    def _close(self, functions: Sequence[Function]) -> dict[Function, None]:
        """Return functions, and all that they call."""
        found: dict[Function, None] = {}
        waiting = list(functions)
        while waiting:
            one = waiting.pop()
            if one not in found:
                found[one] = None
                waiting += [inner for call in sorted(_list_calls(one)) for inner in self._list_called(one, call)]
        return found

    def _list_called(self, caller: Function, name: str) -> Sequence[Function]:
        """Return the functions of a name; without those that another one replaces."""
        several = self.definitions.functions.get(name, [])
        first = self.definitions.find_function(name) if f"super().{name}(" not in ast.unparse(caller) else None
        return [first] if first is not None else several

    def find_made(self) -> Iterator[FaultyCode]:
        """Yield what steps make in PyBullet, where nothing that resets run removes anything of the kind."""
        called = {name for one in self._resets for name in _list_calls(one)}
        for function in self._steps:
            if function in self._resets or function.name in RESETS:
                continue
            for node in ast.walk(function):
                removing = REMOVED.get(read_name(node.func)) if isinstance(node, ast.Call) else None
                if isinstance(node, ast.Call) and removing and not removing & (called | self._called_by_a_reset):
                    removal = min(removing - {"resetSimulation", "disconnect"})
                    what = f"{read_name(node.func)} in a step, and no reset calls {removal}: what an episode has"
                    what += " made is still there in the next one"
                    yield FaultyCode(node, what, self.source.find_place(node))

    @functools.cached_property
    def _called_by_a_reset(self) -> Set[str]:
        """The functions of PyBullet that a reset calls, also from files of other folders, which are not read."""
        names: set[str] = set()
        with record_calls(()) as calls:
            calls.after_call = lambda name, *_: names.add(name)
            self.noted.play(0, 0, {})
        return names

    def find_fields(self) -> Iterator[FaultyCode]:
        """Yield fields of MuJoCo's data that steps set under a condition, and resets never."""
        called = {name for one in self._resets for name in _list_calls(one)}
        if (
            DATA_RESETS & called
            or hasattr(self.source.author, "reset_model")
            or not hasattr(self.source.author, "step")
        ):
            return
        for key, assignments in self.definitions.assigned.items():
            field = key.rpartition(".")[2]
            several = [one for one in assignments if one.function in self._steps and one.function not in self._resets]
            is_reset = any(one.function in self._resets for one in assignments)
            is_always = any(not self.definitions.list_conditions(one.statement) for one in several)
            if field in FIELDS and several and not is_reset and not is_always:
                what = f"{write_code(several[0].statement)} in a step, and no reset sets it back or calls mj_resetData"
                yield FaultyCode(several[0].statement, what, self.source.find_place(several[0].statement))

    def find_attributes(self) -> Iterator[FaultyCode]:
        """Yield attributes that begin an episode as the last one has left them, after its condition held in that."""
        tried = 0
        for key, assignments in self.definitions.assigned.items():
            of_steps = [one for one in assignments if one.function in self._steps]
            is_reset = any(one.function in self._resets for one in assignments)
            words = {*read_words(key)}
            is_meant = words & LASTING_WORDS or key.rpartition(".")[2] in STATE_FIELDS
            if is_reset or not of_steps or is_meant or self._is_never_read(key):
                continue
            for one in of_steps:
                for tests in list(self._draws.list_tests(one))[:1] if tried < MOST_TRIED else ():
                    if self._is_always_met(tests):
                        continue
                    tried += 1
                    found = self._try(key, one, Branch(key, tests))
                    if found is not None:
                        yield found
                        return

    def _is_always_met(self, tests: Sequence[tuple[int, bool]]) -> bool:
        """Say whether a condition held in each step that was played: what it sets was left over there already."""
        values = [
            np.all(value) == is_met
            for call in self.noted.steps
            for number, is_met in tests
            for value in call.values.get(number, ())
            if value is not None
        ]
        return all(values)

    def _is_never_read(self, key: str) -> bool:
        reads = [one for one in self.source.expressions if read_key(one.node) == key and one.function in self._steps]
        return all(self._only_draws(one.node) for one in reads)

    def _only_draws(self, read: ast.AST) -> bool:
        """Say whether a value decides only what is drawn, as the colour of a robot that has hit something."""
        node, parent = read, self.source.parents[read]
        while isinstance(parent, ast.expr):
            node, parent = parent, self.source.parents[parent]
        if not isinstance(parent, ast.If) or node is not parent.test:
            return False
        inside = [inner for one in (*parent.body, *parent.orelse) for inner in ast.walk(one)]
        calls = {read_name(inner.func) for inner in inside if isinstance(inner, ast.Call)}
        return calls <= DRAWING and not any(isinstance(inner, ACTING) for inner in inside)

    def _try(self, key: str, assignment: Assignment, branch: Branch) -> FaultyCode | None:
        number, episode = 0, self.noted.episodes[0]
        forced = {step: self._draws.force(branch) for step in range(FORCED_FROM, FORCED_FROM + FORCED_STEPS)}
        if len(episode) < 2 or len(self.noted.play(number, FORCED_FROM + FORCED_STEPS, forced)) < FORCED_FROM + 1:
            return None
        again = self.noted.play(number, 1, {})
        for (noted, _), before in zip(again, episode[:2], strict=False):
            for one in self.source.expressions:
                if read_key(one.node) != key:
                    continue
                first, value = _read_first(before, one.number), _read_first(noted, one.number)
                if first is not None and value is not None and not np.array_equal(first, value):
                    text = self.source.expressions[branch.tests[0][0]].text
                    what = f"no reset sets {key} back: after an episode in which {text} was made"
                    what += f" {branch.tests[0][1]}, {one.text} begins the next one as {_show(value)} instead of"
                    what += f" {_show(first)}"
                    return FaultyCode(assignment.statement, what, self.source.find_place(assignment.statement))
        return None


def _read_first(call: NotedCall, number: int) -> Value:
    return next(iter(call.values.get(number, ())), None)


def _show(value: Value) -> str:
    numbers = np.asarray(value)
    return np.array2string(numbers, precision=3) if numbers.ndim else f"{float(numbers):.4g}"


def _list_calls(function: Function) -> set[str]:
    return {read_name(node.func) for node in ast.walk(function) if isinstance(node, ast.Call)}
