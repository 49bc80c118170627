"""RL8: model files, whose masses and inertias decide how everything moves."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rlctl.check_env.context import Context
from rlctl.check_env.experiment import experiment
from rlctl.check_env.finding import Finding, NotApplicable
from rlctl.check_env.messages import FIRST_SEED, Message

MOST_LINKS = 5
"""Links that a finding names."""

Load = tuple[int, int, str, int]
"""A body that was loaded: client, its number, its file, the flags."""


@experiment("models", "RL809", share=0.5)
def judge_models(context: Context) -> Iterator[Message]:
    """Build an environment, reset it, and judge the URDFs that it loads."""
    with _record_loads() as loads, context.fresh() as instance:
        instance.reset(FIRST_SEED)
        if not loads:
            raise NotApplicable("no URDF is loaded")
        faults = list(dict.fromkeys(fault for load in loads for fault in _judge(*load)))
    if faults:
        more = f"; {len(faults) - 1} more links" if len(faults) > 1 else ""
        yield Finding("RL809", f"{faults[0].rstrip('.')}{more}", {"value": len(faults), "links": faults[:MOST_LINKS]})


@contextlib.contextmanager
def _record_loads() -> Iterator[list[Load]]:
    pybullet: Any = sys.modules.get("pybullet")
    if pybullet is None:
        raise NotApplicable("no PyBullet world")
    load_urdf, loads = pybullet.loadURDF, []

    def load(*arguments: Any, **keywords: Any) -> Any:
        body = load_urdf(*arguments, **keywords)
        file = str(arguments[0] if arguments else keywords.get("fileName", ""))
        loads.append((int(keywords.get("physicsClientId", 0)), int(body), file, int(keywords.get("flags", 0))))
        return body

    pybullet.loadURDF = load
    try:
        yield loads
    finally:
        pybullet.loadURDF = load_urdf


def _judge(client: int, number: int, file: str, flags: int) -> list[str]:
    from rlctl.task.body import Body
    from rlctl.task.bullet import pybullet, pybullet_data
    from rlctl.task.inertia import find_inertia_faults

    path = next((each for each in (Path(file), Path(pybullet_data.getDataPath()) / file) if each.is_file()), None)
    if path is None:
        return []
    try:
        held = pybullet.getDynamicsInfo(number, -1, physicsClientId=client)[0] == 0
        body = Body(client, 1, path.stem, number, path, fixed=held)
    except pybullet.error:  # it was removed since
        return []
    body.inertia_from_file = bool(flags & pybullet.URDF_USE_INERTIA_FROM_FILE)
    return find_inertia_faults(body)
