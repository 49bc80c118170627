"""Writes a lived episode as a Rerun recording (`.rrd`)."""

from __future__ import annotations

import hashlib
import json
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from rlctl import registry
from rlctl.errors import ArtifactError
from rlctl.replay.bodies import draw_scene
from rlctl.replay.curves import send_curves
from rlctl.replay.layout import blueprint
from rlctl.replay.live import Lived
from rlctl.replay.timelines import Timelines
from rlctl.replay.watching import Tell, Watched
from rlctl.run import files
from rlctl.run.episode import RecordedEpisode

_LEVEL_COLORS = {"INFO": 0xB0D0FFFF, "WARN": 0xFFC060FF, "DEBUG": 0xB0B0B0FF}


def write_rrd(path: Path, watched: Watched, *, title: str, tell: Tell) -> None:
    """Write a recording, whole or not at all. Opens no port.

    Rows are at the steps of the episode: 0 is the reset; the action, the reward and the state after it have the
    same number. The same episode always has the same recording id.
    """
    info = watched.lived.episode.info
    stream = rr.RecordingStream(
        f"rlctl_{registry.make_slug(info.task)}", recording_id=_identity(watched.lived.episode), send_properties=False
    )
    stream.set_log_time_enabled(False)

    def write(part: Path) -> None:
        try:
            with stream:
                # What is sent before `save` waits in memory: the layout is known only at the end.
                layout = _send(stream, watched, title, tell)
                stream.save(part, default_blueprint=layout)
                stream.flush()
        except RuntimeError as error:  # Rerun's word for a disk that is full
            raise ArtifactError(f"{path}: cannot be written: {error}") from error

    files.write_with(path, write)


def _identity(episode: RecordedEpisode) -> str:
    content = hashlib.sha256(episode.info.model_dump_json().encode())
    content.update(episode.actions.tobytes())
    content.update(episode.rewards.tobytes())
    return f"{registry.make_slug(episode.info.task)}-{episode.info.seed}-{content.hexdigest()[:12]}"


def _send(stream: rr.RecordingStream, watched: Watched, title: str, tell: Tell) -> rrb.Blueprint:
    lived, scene = watched.lived, watched.scene
    timelines = Timelines(stream, lived.dt)
    stream.send_recording_name(title)
    stream.send_property("episode", _properties(lived))
    followed = None if scene is None else draw_scene(scene, timelines, tell)
    plots = send_curves(lived, scene, timelines)
    _send_happenings(lived, timelines)
    if watched.pictures:
        steps, blobs = [step for step, _ in watched.pictures], [blob for _, blob in watched.pictures]
        columns = rr.EncodedImage.columns(blob=blobs, media_type=["image/jpeg"] * len(blobs))
        timelines.send("camera", steps, columns)
    return blueprint(
        plots,
        scene,
        pictures=bool(watched.pictures),
        success=lived.successes is not None,
        timeline=timelines.shown,
        followed=followed,
    )


def _properties(lived: Lived) -> rr.AnyValues:
    info = lived.episode.info
    values: dict[str, Any] = {
        "task": info.task,
        "task_parameters": json.dumps(info.task_parameters),
        "seed": info.seed,
        "length": lived.length,
        "total_reward": info.total_reward,
        "policy": info.policy,
        "robot": lived.env.robot,
        "control_dt": lived.env.control_dt,
        "versions": json.dumps({**info.versions, "rerun-sdk": version("rerun-sdk")}),
        "success": info.success,
    }
    return rr.AnyValues(**{key: value for key, value in values.items() if value is not None})


def _send_happenings(lived: Lived, timelines: Timelines) -> None:
    happenings = lived.happenings
    # All three for every row: the viewer carries a missing level or colour over from another row.
    columns = rr.TextLog.columns(
        text=[each.text for each in happenings],
        level=[each.level for each in happenings],
        color=np.array([_LEVEL_COLORS[each.level] for each in happenings], np.uint32),
    )
    timelines.send("events", [each.step for each in happenings], columns)
    if lived.successes is None:
        return
    style = rr.StateConfiguration(values=["away", "at goal"], colors=[0x8090A0FF, 0x28C85AFF])
    timelines.stream.log("goal", style, static=True)
    held = [False, *lived.successes.tolist()]
    changes = [0, *(step for step in range(1, len(held)) if held[step] != held[step - 1])]
    states = ["at goal" if held[step] else "away" for step in changes]
    timelines.send("goal", changes, rr.StateChange.columns(state=states))
