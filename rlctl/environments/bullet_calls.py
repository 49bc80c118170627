"""Records how an environment calls PyBullet: which calls leave physicsClientId out."""

import contextlib
import dataclasses
import inspect
import itertools
import linecache
import math
import re
import sys
import types
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from types import CodeType, FrameType
from typing import Any, NamedTuple

LIBRARIES = (
    "gymnasium",
    "numpy",
    "torch",
    "pybullet",
    "pybullet_utils",
    "rlctl",
    "rlctl_robot",
    "builtins",
    "stable_baselines3",
)
"""Packages that are not part of an environment; rlctl's own tasks are in packages of their own."""
NO_CLIENT = re.compile(
    r"connect|error|getAPIVersion|isNumpyEnabled|submitProfileTiming|rotateVector|calculateVelocityQuaternion"
    r"|(multiply|invert)Transforms?|compute(View|Projection)Matrix\w*|get\w*Quaternion\w*|getEuler\w*|getMatrix\w*"
)
"""Functions that are the same for every client: mathematics, and what makes one."""
FIRST_IS_CLIENT = {
    "disconnect", "getConnectionInfo", "getNumBodies", "getNumConstraints", "isConnected", "performCollisionDetection",
    "getKeyboardEvents", "getMouseEvents", "getPhysicsEngineParameters", "removeAllUserDebugItems", "saveState",
    "stepSimulation",
}  # fmt: skip  # with the client as only positional argument
CLIENT_WORDS = re.compile(r"client|\bcid\b|_cid\b|server", re.IGNORECASE)
"""Names of a client that is passed by position."""


@dataclasses.dataclass(frozen=True, order=True)
class BulletCall:
    """A call of a function of PyBullet in the environment's code."""

    file: str
    line: int
    name: str

    @property
    def place(self) -> str:
        """`file.py:12`."""
        return f"{Path(self.file).name}:{self.line}"


def is_library(frame: FrameType) -> bool:
    """Say whether a frame runs code of a package that is not part of an environment."""
    return str(frame.f_globals.get("__name__", "")).partition(".")[0] in LIBRARIES


MOTORS = ("setJointMotorControl2", "setJointMotorControlArray", "resetJointState")
RECORDED = (*MOTORS, "getContactPoints", "getLinkState", "loadURDF", "setAdditionalSearchPath")
POSITION = 2  # PyBullet's POSITION_CONTROL
FULL_TURN = 2 * math.pi


class GivenPosition(NamedTuple):
    """A position that a joint was given [rad], [m]."""

    client: int
    body: int
    joint: int
    value: float
    force: float  # The most that its motor has [N m], [N]
    call: BulletCall


@dataclasses.dataclass
class ContactQuery:
    """The calls of getContactPoints at one line with the same arguments."""

    call: BulletCall
    client: int
    bodies: tuple[int, int]  # Of both sides; -1 where the call leaves it out
    links: tuple[int | None, int | None]
    calls: int = 0
    contacts: int = 0


class BulletCalls:
    """What was recorded."""

    def __init__(self) -> None:
        self.without_client: set[BulletCall] = set()
        self.targets: dict[tuple[int, int, int], GivenPosition] = {}  # last motor target by client, body and joint
        self.far_targets: list[GivenPosition] = []  # Positions of more than a full turn
        self.queries: dict[tuple[Any, ...], ContactQuery] = {}
        self.late_links: dict[BulletCall, float] = {}  # how far getLinkState was from the present position [m]
        self.models: dict[tuple[int, int], str] = {}  # the file of a URDF, by client and body
        self.search_paths: list[str] = []
        self.before_step: Callable[[int], None] | None = None  # called with the client before each stepSimulation
        self._known: set[tuple[CodeType, int]] = set()

    def note_call(self, name: str, frame: FrameType, arguments: Sequence[Any], keywords: dict[str, Any]) -> None:
        """Note a call that a frame is about to make, if it leaves the client out."""
        where = frame.f_code, frame.f_lasti
        if "physicsClientId" not in keywords and where not in self._known:
            self._known.add(where)
            has_client = bool(arguments) if name in FIRST_IS_CLIENT else CLIENT_WORDS.search(_read_arguments(frame))
            if not is_library(frame) and not has_client:
                self.without_client.add(BulletCall(frame.f_code.co_filename, frame.f_lineno, name))

    def note_result(
        self, name: str, frame: FrameType, arguments: Sequence[Any], keywords: dict[str, Any], result: Any
    ) -> None:
        """Note what a call set or returned, if it loads, moves joints, or asks for contacts or a place."""
        call = BulletCall(frame.f_code.co_filename, frame.f_lineno, name)
        client = int(keywords.get("physicsClientId", 0))
        if name == "loadURDF":
            self.models[client, result] = str(keywords.get("fileName", arguments[0] if arguments else ""))
            return
        if name == "setAdditionalSearchPath":
            self.search_paths.append(str(keywords.get("path", arguments[0] if arguments else "")))
            return
        if name == "getLinkState":
            if len(arguments) <= 3 and not keywords.get("computeForwardKinematics") and not is_library(frame):
                again = sys.modules["pybullet"].getLinkState
                present = again(*arguments, **{**keywords, "computeForwardKinematics": 1})[4]
                self.late_links[call] = max(self.late_links.get(call, 0.0), math.dist(result[4], present))
            return
        if name == "getContactPoints":
            names = ("bodyA", "bodyB", "linkIndexA", "linkIndexB")
            one, two, link, other = ({**dict(zip(names, arguments, strict=False)), **keywords}.get(n) for n in names)
            key = (call, client, one, two, link, other)
            bodies = tuple(-1 if body is None else int(body) for body in (one, two))
            query = self.queries.setdefault(key, ContactQuery(call, client, bodies, (link, other)))  # type: ignore[arg-type]
            query.calls, query.contacts = query.calls + 1, query.contacts + len(result or ())
            return
        for body, joint, value, force in _read_positions(name, arguments, keywords):
            target = GivenPosition(client, body, joint, value, force, call)
            if name != "resetJointState":
                self.targets[client, body, joint] = target
            if abs(value) > FULL_TURN and len(self.far_targets) < 1_000:
                self.far_targets.append(target)


def _read_positions(
    name: str, arguments: Sequence[Any], keywords: dict[str, Any]
) -> list[tuple[int, int, float, float]]:
    """Return body, joint, position and force of each joint that a call moves by a position; empty for other modes."""
    many = name.endswith("Array")
    names = ["bodyUniqueId", "jointIndices" if many else "jointIndex"]
    names += ["targetValue"] if name == "resetJointState" else ["controlMode", "targetPosition" + "s" * many]
    named = {**dict(zip(names, arguments, strict=False)), **keywords}
    body, joints, values = named.get("bodyUniqueId", named.get("bodyIndex")), named.get(names[1]), named.get(names[-1])
    if body is None or joints is None or values is None or named.get("controlMode", POSITION) != POSITION:
        return []
    forces = named.get("force" + "s" * many)
    if not many:
        joints, values, forces = [joints], [values], None if forces is None else [forces]
    try:
        triples = zip(joints, values, itertools.repeat(math.inf) if forces is None else forces, strict=False)
        return [(int(body), int(joint), float(value), float(force)) for joint, value, force in triples]
    except (TypeError, ValueError):  # PyBullet itself has refused or converted it
        return []


def _read_arguments(frame: FrameType) -> str:
    positions = inspect.getframeinfo(frame).positions
    if positions is None or positions.lineno is None:
        return ""
    lines = linecache.getlines(frame.f_code.co_filename)[positions.lineno - 1 : positions.end_lineno]
    if lines:
        lines[-1] = lines[-1][: positions.end_col_offset]
        lines[0] = lines[0][positions.col_offset :]
    return "".join(lines).partition("(")[2]


class Replacement:
    """Takes the place of a function of PyBullet."""

    @property  # type: ignore[misc]
    def __class__(self) -> type:  # BulletClient adds the client to builtins only
        return types.BuiltinFunctionType


@contextlib.contextmanager
def replace_functions(replace: Callable[[str, Any], Any]) -> Iterator[None]:
    """Replace PyBullet's functions inside the `with` block by what `replace` returns for a name and a function."""
    pybullet = sys.modules.get("pybullet")
    members = vars(pybullet) if pybullet else {}
    functions = {name: function for name, function in members.items() if inspect.isbuiltin(function)}
    for name, function in functions.items():
        setattr(pybullet, name, replace(name, function))
    try:
        yield
    finally:
        for name, function in functions.items():
            setattr(pybullet, name, function)


@contextlib.contextmanager
def record_calls(with_results: Collection[str] = RECORDED) -> Iterator[BulletCalls]:
    """Record the calls of PyBullet inside the `with` block; of some functions also what they set or return."""
    calls = BulletCalls()

    def replace(name: str, function: Any) -> Any:
        def call(self: Any, *arguments: Any, **keywords: Any) -> Any:
            frame = sys._getframe(1)
            calls.note_call(name, frame, arguments, keywords)
            if name == "stepSimulation" and calls.before_step is not None:
                calls.before_step(int(keywords.get("physicsClientId", arguments[0] if arguments else 0)))
            result = function(*arguments, **keywords)
            if name in with_results:
                calls.note_result(name, frame, arguments, keywords, result)
            return result

        return function if NO_CLIENT.fullmatch(name) else type(name, (Replacement,), {"__call__": call})()

    with replace_functions(replace):
        yield calls


def visible_to_profilers() -> contextlib.AbstractContextManager[None]:
    """Let Python's profiler see functions of PyBullet inside the `with` block also where a `functools.partial` calls
    them, as BulletClient does. Each has a code object of this file, of its own and with its name."""

    def replace(name: str, function: Any) -> Any:
        def call(self: Any, *arguments: Any, **keywords: Any) -> Any:
            return function(*arguments, **keywords)

        call.__code__ = call.__code__.replace(co_name=name, co_qualname=name)
        return type(name, (Replacement,), {"__call__": call})()

    return replace_functions(replace)
