"""Takes part in how an environment calls MuJoCo: code before and after steps and resets, other names for its parts."""

import contextlib
import dataclasses
import sys
from collections.abc import Callable, Iterator
from typing import Any

from rlctl.environments.bullet_calls import LIBRARIES, is_library

STEPS, RESETS = ("mj_step", "mj_step2"), ("mj_resetData", "mj_resetDataKeyframe")
FORWARD = "mj_forward"
FORCES = "mj_rnePostConstraint"  # computes forces from what a step left
CONTACTS = ("ncon", "contact")  # of MjData
LOOKUPS = ("body", "geom", "site")  # methods of MjModel and MjData that find a part by its name


def _nothing(*_: Any) -> None:
    pass


@dataclasses.dataclass
class MujocoCalls:
    """What to do around the environment's calls, and what it asked for."""

    before_step: Callable[[Any, Any, int], None] = _nothing  # with model, data and the number of steps
    after_step: Callable[[Any, Any], None] = _nothing
    after_reset: Callable[[Any, Any], None] = _nothing  # of the data, as by mj_resetData
    after_forward: Callable[[Any, Any], None] = _nothing
    as_stepped: Callable[[], contextlib.AbstractContextManager[None]] = contextlib.nullcontext
    """Gives back, for a `with` block, what a step left and `after_step` changed."""
    other_names: dict[tuple[str, str], str] = dataclasses.field(default_factory=dict)
    """Other names that a look-up finds, by kind (of `LOOKUPS`) and asked name."""
    reads_contacts: bool = False  # whether the environment ever looked at data.ncon or data.contact
    asked: dict[tuple[str, str], None] = dataclasses.field(default_factory=dict)  # kind and name of every look-up

    def rename(self, kind: str, name: Any) -> Any:
        """Note a look-up by name, and return the name to find."""
        if not isinstance(name, str):
            return name
        self.asked[kind, name] = None
        return self.other_names.get((kind, name), name)


@contextlib.contextmanager
def join_calls(calls: MujocoCalls) -> Iterator[None]:
    """Call the functions of `calls` around those of MuJoCo inside the `with` block, and rename what is looked up."""
    library = sys.modules["mujoco"]
    functions = {name: getattr(library, name) for name in (*STEPS, *RESETS, FORWARD, FORCES, "mj_name2id")}
    with contextlib.ExitStack() as stack:
        for name, function in functions.items():
            for holder in (library, *_find_importers(name, function)):
                stack.callback(setattr, holder, name, function)
                setattr(holder, name, _join(calls, name, function))
        for owner in (library.MjModel, library.MjData):
            for kind in LOOKUPS:
                stack.callback(setattr, owner, kind, getattr(owner, kind))
                setattr(owner, kind, _rename(calls, kind, getattr(owner, kind)))
        for field in CONTACTS:
            stack.callback(setattr, library.MjData, field, getattr(library.MjData, field))
            setattr(library.MjData, field, _watch(calls, getattr(library.MjData, field)))
        yield


def _watch(calls: MujocoCalls, field: property) -> property:
    """Return a property like another one, which notes that the environment read it."""

    def read(data: Any) -> Any:
        if not calls.reads_contacts and not is_library(sys._getframe(1)):
            calls.reads_contacts = True
        return field.__get__(data)

    return property(read, field.__set__)


def _find_importers(name: str, function: Any) -> list[Any]:
    """Return the modules, libraries left out, that imported a function by its name."""
    known = (*LIBRARIES, *sys.stdlib_module_names, "mujoco", "scipy")
    own = [module for key, module in list(sys.modules.items()) if key.partition(".")[0] not in known]
    return [module for module in own if getattr(module, "__dict__", {}).get(name) is function]


def _join(calls: MujocoCalls, name: str, function: Any) -> Any:
    def step(*arguments: Any, **keywords: Any) -> Any:
        model, data = _read_arguments(arguments, keywords)
        count = keywords.get("nstep", arguments[2] if len(arguments) > 2 else 1)
        calls.before_step(model, data, count)
        result = function(*arguments, **keywords)
        calls.after_step(model, data)
        return result

    def forward(*arguments: Any, **keywords: Any) -> Any:
        result = function(*arguments, **keywords)
        (calls.after_forward if name == FORWARD else calls.after_reset)(*_read_arguments(arguments, keywords))
        return result

    def find(*arguments: Any, **keywords: Any) -> Any:
        named = dict(zip(("m", "type", "name"), arguments, strict=False)) | keywords
        objects = sys.modules["mujoco"].mjtObj
        kinds = {int(getattr(objects, f"mjOBJ_{word.upper()}")): word for word in LOOKUPS}
        if word := kinds.get(int(named["type"])):
            named["name"] = calls.rename(word, named["name"])
        return function(*named.values())

    def compute(*arguments: Any, **keywords: Any) -> Any:
        with calls.as_stepped():
            return function(*arguments, **keywords)

    if name == FORCES:
        return compute
    if name in STEPS:
        return step
    return find if name == "mj_name2id" else forward


def _read_arguments(arguments: tuple[Any, ...], keywords: dict[str, Any]) -> tuple[Any, Any]:
    named = dict(zip(("m", "d"), arguments, strict=False)) | keywords
    return named["m"], named["d"]


def _rename(calls: MujocoCalls, kind: str, method: Any) -> Any:
    def find(self: Any, *arguments: Any, **keywords: Any) -> Any:
        if arguments:
            arguments = (calls.rename(kind, arguments[0]), *arguments[1:])
        elif "name" in keywords:
            keywords = {**keywords, "name": calls.rename(kind, keywords["name"])}
        return method(self, *arguments, **keywords)

    return find
