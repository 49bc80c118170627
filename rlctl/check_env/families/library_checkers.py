"""RL2, libraries: what Gymnasium's and Stable-Baselines3's own checkers say, as plain data, never a traceback.

Which rule owns what of it is in rules.yaml; `check_env.complaints` makes findings of it.
"""

from __future__ import annotations

import inspect
import os
import re
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

from rlctl.check_env.experiment import experiment
from rlctl.check_env.failures import describe
from rlctl.check_env.families.rewards import GOALS
from rlctl.check_env.instance import Context
from rlctl.check_env.messages import GYMNASIUM, RAISED, SB3, Complaint, Message

_LIBRARIES = re.compile(r"[/\\](gymnasium|stable_baselines3|rlctl[/\\]check_env)[/\\](?!envs[/\\])")
_ANSI = re.compile(r"\x1b\[[0-9;]*m")
_LONGEST = 400  # characters


@experiment("gymnasium checker", share=10.0)
def run_gymnasium_checker(context: Context) -> Iterator[Message]:
    """Run Gymnasium's checker on an instance of its own."""
    from gymnasium.utils.env_checker import check_env

    def check(env: Any) -> None:
        spec = getattr(env, "spec", None)
        wrappers = getattr(spec, "additional_wrappers", ())
        # The check of `close` makes a second environment from the registration, wrappers included.
        again = spec is not None and all(wrapper.kwargs is not None for wrapper in wrappers)
        check_env(env, skip_render_check=True, skip_close_check=not again)

    yield from _run(GYMNASIUM, context, check)


@experiment("sb3 checker", share=10.0)
def run_sb3_checker(context: Context) -> Iterator[Message]:
    """Run Stable-Baselines3's checker on an instance of its own."""
    from rlctl.check_env.sb3_checker import load_sb3_checker

    check_env = load_sb3_checker()

    def check(env: Any) -> None:
        check_env(_without_goals(env) if _has_other_compute_reward(env) else env)

    yield from _run(SB3, context, check)


def _run(name: str, context: Context, checker: Callable[[Any], None]) -> Iterator[Message]:
    env = context.build().env
    context.progress.enter("check")
    complaints = collect_complaints(lambda env: checker(_without_gymnasiums_wrappers(env)), env)
    context.progress.leave()
    for kind, text in complaints:
        yield Complaint(name, kind, text)


def _has_other_compute_reward(env: Any) -> bool:
    """Say whether `compute_reward` is not for goals that are arrays, for which SB3's checker takes any such method."""
    compute = getattr(getattr(env, "unwrapped", env), "compute_reward", None)
    if not callable(compute):
        return False
    try:
        inspect.signature(compute).bind(*GOALS, "info")
    except (TypeError, ValueError):
        return True
    parts = getattr(getattr(env, "observation_space", None), "spaces", None)
    return isinstance(parts, dict) and any(hasattr(parts.get(name), "spaces") for name in GOALS)


def _without_goals(env: Any) -> Any:
    """Return an environment that does the same and has no `compute_reward`."""
    import gymnasium

    if not isinstance(env, gymnasium.Env):
        return env

    class WithoutGoals(gymnasium.Wrapper[Any, Any, Any, Any]):
        @property
        def unwrapped(self) -> Any:
            return self

    return WithoutGoals(env)


def _without_gymnasiums_wrappers(env: Any) -> Any:
    """Take off what `gymnasium.make` puts on: the checkers look for methods that these hide. Others stay on."""
    from gymnasium import wrappers

    while type(env) in (wrappers.TimeLimit, wrappers.OrderEnforcing, wrappers.PassiveEnvChecker):
        env = env.env
    return env


def collect_complaints(checker: Callable[[Any], None], env: Any) -> list[tuple[str, str]]:
    """Run a checker on an environment and return what it said: kind and text; warnings of other code are left out."""
    complaints: list[tuple[str, str]] = []
    home = _find_home(env)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for call in (lambda: checker(env), getattr(env, "close", lambda: None)):
            try:
                call()
            except BaseException as error:  # an environment may raise anything, SystemExit too
                complaints.append(("error", _describe(error, home)))
    texts = [str(each.message) for each in caught if _LIBRARIES.search(each.filename)]
    return [("warning", _clean(text)) for text in dict.fromkeys(texts)] + complaints


def _find_home(env: Any) -> str:
    """Return the folder of the package that the environment's class is written in, or its file."""
    try:
        file = Path(inspect.getfile(type(getattr(env, "unwrapped", env))))
    except (OSError, TypeError):
        return ""
    packages = [folder for folder in file.parents if (folder / "__init__.py").is_file()]
    return f"{packages[-1]}{os.sep}" if packages else str(file)


def _describe(error: BaseException, home: str) -> str:
    if _is_of_environment(error.__traceback__, home):
        return RAISED + describe(error)
    frames = traceback.extract_tb(error.__traceback__)
    text = _clean(str(error) or (frames[-1].line if frames else "") or "") or "no message"  # an assert's own line
    return text if isinstance(error, AssertionError) else f"{type(error).__name__}: {text}"


def _is_of_environment(trace: TracebackType | None, home: str) -> bool:
    """Say whether an exception passed through code that is neither a checker's nor a library's below it."""
    files = [frame.filename for frame in traceback.extract_tb(trace)]
    if home and not _LIBRARIES.search(home) and any(file.startswith(home) for file in files):
        return True
    return any("site-packages" not in file and not _LIBRARIES.search(file) for file in files) or any(
        re.search(r"[/\\]gymnasium[/\\]envs[/\\]", file) for file in files
    )


def _clean(text: str) -> str:
    text = " ".join(_ANSI.sub("", text).removeprefix("WARN: ").split()).removeprefix("WARN: ")
    return text if len(text) <= _LONGEST else text[: _LONGEST - 3] + "..."
