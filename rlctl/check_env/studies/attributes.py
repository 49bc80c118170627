"""Looks at what wrappers and learners read from an environment, and at what two instances have in common."""

from __future__ import annotations

import ast
import inspect
import sys
import textwrap
from collections.abc import Iterator
from typing import Any

from rlctl.check_env.bullet_clients import connected
from rlctl.check_env.context import Context
from rlctl.check_env.evidence import FIRST_SEED
from rlctl.check_env.failures import describe
from rlctl.check_env.instance import Instance
from rlctl.check_env.leaves import pick
from rlctl.check_env.legacy import result
from rlctl.check_env.messages import Message
from rlctl.check_env.results import Attributes, SharedSpaces, Windows

SPACES = ("action_space", "observation_space")


def attributes(context: Context) -> Iterator[Message]:
    """Look at one instance that was reset, and at a second one beside it."""
    with context.fresh() as instance:
        yield result(Windows(_gui_clients()))
        keywords = {"seed": FIRST_SEED} if instance.accepts_seed else {}
        instance.call("reset", instance.env.reset, **keywords)
        yield result(Attributes(list(_problems(instance.env)), _truncation(_inner(instance.env))))
        with context.fresh() as other:
            yield result(_shared(instance, other))


def _inner(env: Any) -> Any:
    try:
        return env.unwrapped
    except Exception:  # is one of the problems
        return env


def _gui_clients() -> int:
    pybullet = sys.modules.get("pybullet")
    if pybullet is None:
        return 0
    methods = [pybullet.getConnectionInfo(physicsClientId=each)["connectionMethod"] for each in connected()]
    return methods.count(pybullet.GUI)


def _problems(env: Any) -> Iterator[str]:
    for name in ("unwrapped", "metadata", "render_mode", *SPACES):
        try:
            getattr(env, name)
        except Exception as error:
            yield f"{name} raises {describe(error)}"
    inner = _inner(env)
    if inner is None:
        yield "unwrapped is None"
        return
    metadata = getattr(inner, "metadata", {})
    if not isinstance(metadata, dict):
        yield f"metadata is a {type(metadata).__name__}, not a dict"
    yield from _generator_problems(inner)
    for name in SPACES:
        if getattr(env, name, None) is not getattr(env, name, None):
            yield f"{name} is a new object each time it is read, so that seeding it has no effect"


def _generator_problems(env: Any) -> Iterator[str]:
    import numpy as np

    try:
        generator = getattr(env, "np_random", None)
    except Exception as error:
        yield f"np_random raises {describe(error)}"
        return
    # Gymnasium's own older environments hand out a subclass of the Generator.
    if generator is not None and not isinstance(generator, np.random.Generator):
        kind = type(generator)
        yield f"np_random is a {kind.__module__}.{kind.__name__}, not a numpy.random.Generator"


def _shared(one: Instance, other: Instance) -> SharedSpaces:
    objects, generators = [], []
    for name in SPACES:
        a, b = getattr(one.env, name, None), getattr(other.env, name, None)
        if a is None or b is None:
            continue
        if a is b:
            objects.append(name)
        elif any(_generator(part) is _generator(twin) is not None for part, twin in _parts(one, name, a, b)):
            generators.append(name)
    return SharedSpaces(objects, generators)


def _parts(one: Instance, name: str, a: Any, b: Any) -> Iterator[tuple[Any, Any]]:
    """Yield the two spaces, and the spaces inside them, in pairs."""
    yield a, b
    for leaf in one.action_leaves if name == "action_space" else one.leaves:
        try:
            yield pick(a, leaf.path), pick(b, leaf.path)
        except (LookupError, TypeError):
            continue


def _generator(space: Any) -> Any:
    return getattr(space, "np_random", None)


def _truncation(env: Any) -> str:
    """Say whether the code of `step` computes `truncated`, or always returns False."""
    step = getattr(type(env), "step", None)
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(step)))  # type: ignore[arg-type]
    except (OSError, TypeError, SyntaxError):
        return "unknown"
    returned = [
        node.value.elts[3]
        for node in ast.walk(tree)
        if isinstance(node, ast.Return) and isinstance(node.value, ast.Tuple) and len(node.value.elts) == 5
    ]
    if not returned:
        return "unknown"
    return "never" if all(_is_false(tree, each) for each in returned) else "computed"


def _is_false(tree: ast.AST, value: ast.expr) -> bool:
    if isinstance(value, ast.Constant):
        return value.value is False
    if not isinstance(value, ast.Name):
        return False
    assigned = [
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Assign)
        and any(isinstance(each, ast.Name) and each.id == value.id for each in node.targets)
    ]
    return bool(assigned) and all(isinstance(each, ast.Constant) and each.value is False for each in assigned)
