"""Describes an environment that was built: its spaces, and what it says about itself."""

from __future__ import annotations

import inspect
from typing import Any

from rlctl.check_env.bullet_clients import connected
from rlctl.check_env.instance import Instance
from rlctl.check_env.messages import Built
from rlctl.check_env.own_code import find_author, is_task

WAIVERS = "rlctl_ignore"
"""The class attribute that waives rules: rule id -> reason."""


def describe_built(instance: Instance) -> Built:
    """Return what is known of an environment before it is used."""
    env = instance.env
    inner = getattr(env, "unwrapped", env)
    spec = getattr(env, "spec", None)
    author = type(find_author(env))
    file, line = _place(author)
    return Built(
        leaves=instance.leaves,
        action_leaves=instance.action_leaves,
        observation_space=_short(getattr(env, "observation_space", None)),
        action_space=_short(env.action_space),
        names=dict(inner.observation_sizes) if is_task(env) else {},
        events={name: name in inner.events for name in inner.task.events} if is_task(env) else {},
        max_steps=inner.max_steps if is_task(env) else getattr(spec, "max_episode_steps", None),
        nondeterministic=bool(getattr(spec, "nondeterministic", False)),
        accepts_seed=instance.accepts_seed,
        is_env=instance.is_env,
        is_old_gym=any(base.__module__.partition(".")[0] == "gym" for base in type(inner).__mro__),
        metadata=_metadata(inner),
        uses_pybullet=bool(connected()),
        waivers=_waivers(author),
        file=file,
        line=line,
    )


def _metadata(env: Any) -> dict[str, Any]:
    metadata = getattr(env, "metadata", None)
    if not isinstance(metadata, dict):
        return {}
    return {
        str(key): value if isinstance(value, (int, float, str)) else [str(each) for each in value]
        for key, value in metadata.items()
        if isinstance(value, (int, float, str, list, tuple))
    }


def _waivers(author: type) -> Any:
    """Return the waivers as they are written; whether they are good is judged where they are used."""
    waivers = getattr(author, WAIVERS, {})
    if isinstance(waivers, dict):
        return {str(rule): reason if isinstance(reason, str) else "" for rule, reason in waivers.items()}
    return {repr(waivers)[:40]: ""}


def _place(author: type) -> tuple[str | None, int | None]:
    """Return file and line of the class that somebody wrote."""
    try:
        return inspect.getsourcefile(author), inspect.getsourcelines(author)[1]
    except (OSError, TypeError):
        return None, None


def _short(space: Any) -> str:
    text = " ".join(str(space).split())
    if len(text) <= 100:
        return text
    shape = getattr(space, "shape", None)
    return f"{type(space).__name__}{shape or ''}"
