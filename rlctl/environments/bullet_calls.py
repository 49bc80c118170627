"""Records how an environment calls PyBullet: which calls leave physicsClientId out."""

import collections
import contextlib
import dataclasses
import inspect
import itertools
import linecache
import math
import re
import sys
import types
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
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


def _place(frame: FrameType, name: str) -> BulletCall:
    return BulletCall(frame.f_code.co_filename, frame.f_lineno, name)


def _leave_libraries(frame: FrameType) -> FrameType:
    """Return the environment's frame that called a library, such as a task; the frame itself where there is none."""
    found: FrameType | None = frame
    while found is not None and is_library(found):
        found = found.f_back
    return found or frame


MOTORS = ("setJointMotorControl2", "setJointMotorControlArray", "resetJointState")
MANY_AXES = ("setJointMotorControlMultiDof", "setJointMotorControlMultiDofArray")
RECORDED = (*MOTORS, *MANY_AXES, "getContactPoints", "getLinkState", "loadURDF", "setAdditionalSearchPath")
TORQUE, POSITION = 1, 2  # PyBullet's TORQUE_CONTROL and POSITION_CONTROL
FULL_TURN = 2 * math.pi


class GivenPosition(NamedTuple):
    """A position that a joint was given [rad], [m]."""

    client: int
    body: int
    joint: int
    value: float
    force: float  # The most that its motor has [N m], [N]
    call: BulletCall


class GivenStrength(NamedTuple):
    """The largest force that the motor of a joint had in any call [N m], [N]."""

    value: float
    speed: float  # The largest that it was told, at positions 0 [rad/s], [m/s]
    call: BulletCall


class GivenTorque(NamedTuple):
    """A force that a joint was given in TORQUE_CONTROL [N m], [N]."""

    value: float
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


Contacts = tuple[tuple[Any, ...], ...]
"""What getContactPoints returns."""
ChangeContacts = Callable[[Sequence[Any], Contacts], Contacts]
"""Returns other contacts for bodyA, bodyB, linkIndexA, linkIndexB and the client of a call, None where left out."""

AfterCall = Callable[[str, Sequence[Any], Mapping[str, Any], BulletCall], None]
"""Takes the function, its arguments and keywords, and the place of a call."""


def _read_contact_arguments(arguments: Sequence[Any], keywords: Mapping[str, Any]) -> tuple[Any, ...]:
    """Return bodyA, bodyB, linkIndexA and linkIndexB of a call; None where left out."""
    names = ("bodyA", "bodyB", "linkIndexA", "linkIndexB")
    named = {**dict(zip(names, arguments, strict=False)), **keywords}
    return tuple(named.get(name) for name in names)


class BulletCalls:
    """What was recorded."""

    def __init__(self) -> None:
        self.without_client: set[BulletCall] = set()
        self.targets: dict[tuple[int, int, int], GivenPosition] = {}  # last motor target by client, body and joint
        self.torques: dict[tuple[int, int, int], GivenTorque] = {}  # the largest by client, body and joint
        self.strengths: dict[tuple[int, int, int], GivenStrength] = {}  # of motors, by client, body and joint
        self.motorized: set[tuple[int, int, int]] = set()  # joints whose motor was set: by client, body and joint
        self.far_targets: list[GivenPosition] = []  # Positions of more than a full turn
        self.queries: dict[tuple[Any, ...], ContactQuery] = {}
        self.late_links: dict[BulletCall, float] = {}  # how far getLinkState was from the present position [m]
        self.models: dict[tuple[int, int], str] = {}  # the file of a URDF, by client and body
        self.search_paths: list[str] = []
        self.before_step: Callable[[int], None] | None = None  # called with the client before each stepSimulation
        self.after_step: Callable[[int], None] | None = None  # and after it
        self.after_call: AfterCall | None = None  # called after each call
        self.change_contacts: ChangeContacts | None = None  # what getContactPoints gives the environment instead
        self.steps: collections.Counter[int] = collections.Counter()  # calls of stepSimulation by client
        self._known: set[tuple[CodeType, int]] = set()

    def note_call(self, name: str, frame: FrameType, arguments: Sequence[Any], keywords: dict[str, Any]) -> None:
        """Note a call that a frame is about to make, if it leaves the client out."""
        where = frame.f_code, frame.f_lasti
        if "physicsClientId" not in keywords and where not in self._known:
            self._known.add(where)
            has_client = bool(arguments) if name in FIRST_IS_CLIENT else CLIENT_WORDS.search(_read_arguments(frame))
            if not is_library(frame) and not has_client:
                self.without_client.add(_place(frame, name))

    def note_result(
        self, name: str, frame: FrameType, arguments: Sequence[Any], keywords: dict[str, Any], result: Any
    ) -> None:
        """Note what a call set or returned, if it loads, moves joints, or asks for contacts or a place."""
        call = _place(frame, name)
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
            one, two, link, other = _read_contact_arguments(arguments, keywords)
            key = (call, client, one, two, link, other)
            bodies = tuple(-1 if body is None else int(body) for body in (one, two))
            query = self.queries.setdefault(key, ContactQuery(call, client, bodies, (link, other)))  # type: ignore[arg-type]
            query.calls, query.contacts = query.calls + 1, query.contacts + len(result or ())
            return
        given = _read_motors(name, arguments, keywords)
        call = _place(_leave_libraries(frame), name)
        if name != "resetJointState":
            self._note_motors(client, call, given)
            self._note_strengths(client, call, given)
        if given.mode != POSITION:
            return
        forces = given.forces or itertools.repeat(math.inf)
        for joint, value, force in zip(given.joints, given.positions, forces, strict=False):
            target = GivenPosition(client, given.body, joint, value, force, call)
            if name != "resetJointState":
                self.targets[client, given.body, joint] = target
            if abs(value) > FULL_TURN and len(self.far_targets) < 1_000:
                self.far_targets.append(target)

    def _note_motors(self, client: int, call: BulletCall, given: "_GivenMotors") -> None:
        """Note which joints get a torque, or otherwise that the motors of joints are set."""
        if given.mode != TORQUE:
            self.motorized.update((client, given.body, joint) for joint in given.joints)
            return
        for joint, force in zip(given.joints, given.forces, strict=False):
            key = client, given.body, joint
            largest = self.torques.get(key)
            if force and (largest is None or abs(force) > largest.value):
                self.torques[key] = GivenTorque(abs(force), call)

    def _note_strengths(self, client: int, call: BulletCall, given: "_GivenMotors") -> None:
        """Note how strong motors with a target are at most; a force of 0 switches one off."""
        if given.mode == TORQUE:
            return
        speeds = given.speeds or itertools.repeat(0.0)
        for joint, force, speed in zip(given.joints, given.forces, speeds, strict=False):
            key = client, given.body, joint
            _, old, _ = largest = self.strengths.get(key, GivenStrength(0.0, 0.0, call))
            if force and (force > largest.value or abs(speed) > old):
                self.strengths[key] = GivenStrength(max(force, largest.value), max(abs(speed), old), call)


class _GivenMotors(NamedTuple):
    """What a call gives the motors of joints, or the joints themselves."""

    body: int
    joints: Sequence[int]
    mode: int  # That of PyBullet; `POSITION` where a call has none
    positions: Sequence[float]
    forces: Sequence[float]
    speeds: Sequence[float]


def _read_motors(name: str, arguments: Sequence[Any], keywords: Mapping[str, Any]) -> _GivenMotors:
    """Return what a call gives the motors of one joint or of several; no joint where that cannot be read."""
    many = name.endswith("Array")
    plural = "s" * many
    names = ["bodyUniqueId", "jointIndices" if many else "jointIndex"]
    position, velocity = ("targetPositions", "targetVelocities") if many else ("targetPosition", "targetVelocity")
    if name == "resetJointState":
        position = "targetValue"
        names += [position]
    else:
        names += ["controlMode", position, velocity, "force" + plural]
    named = {**dict(zip(names, arguments, strict=False)), **keywords}
    joints, positions, forces, speeds = (named.get(key) for key in (names[1], position, "force" + plural, velocity))
    if not many:
        joints, positions, forces, speeds = (None if v is None else [v] for v in (joints, positions, forces, speeds))
    if name in MANY_AXES:
        positions = forces = speeds = None  # several numbers per joint
    try:
        return _GivenMotors(
            body=int(named.get("bodyUniqueId", named.get("bodyIndex"))),  # type: ignore[arg-type]
            joints=[int(joint) for joint in joints or ()],
            mode=int(named.get("controlMode", POSITION)),
            positions=[float(value) for value in positions or ()],
            forces=[float(value) for value in forces or ()],
            speeds=[float(value) for value in speeds or ()],
        )
    except (TypeError, ValueError):  # PyBullet itself has refused or converted it
        return _GivenMotors(-1, (), POSITION, (), (), ())


def _read_arguments(frame: FrameType) -> str:
    positions = inspect.getframeinfo(frame).positions
    if positions is None or positions.lineno is None:
        return ""
    lines = linecache.getlines(frame.f_code.co_filename)[positions.lineno - 1 : positions.end_lineno]
    if lines:
        lines[-1] = lines[-1][: positions.end_col_offset]
        lines[0] = lines[0][positions.col_offset :]
    return "".join(lines).partition("(")[2]


def _read_client(arguments: Sequence[Any], keywords: Mapping[str, Any]) -> int:
    """Return the client of a function whose only argument it is."""
    return int(keywords.get("physicsClientId", arguments[0] if arguments else 0))


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
            is_step = name == "stepSimulation"
            if is_step and calls.before_step is not None:
                calls.before_step(_read_client(arguments, keywords))
            result = function(*arguments, **keywords)
            if is_step:
                client = _read_client(arguments, keywords)
                calls.steps[client] += 1
                if calls.after_step is not None:
                    calls.after_step(client)
            if calls.after_call is not None:
                place = _place(frame, name)
                calls.after_call(name, arguments, keywords, place)
            if name == "getContactPoints" and calls.change_contacts is not None:
                asked = (*_read_contact_arguments(arguments, keywords), int(keywords.get("physicsClientId", 0)))
                return calls.change_contacts(asked, result or ())
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
