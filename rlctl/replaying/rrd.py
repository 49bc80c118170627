"""Writes a rollout as a Rerun recording (`.rrd`), with the layout for the viewer."""

import hashlib
import json
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from rlctl.environments import registry
from rlctl.errors import ArtifactError
from rlctl.play.episode import RecordedEpisode
from rlctl.replaying.bodies import bounds, draw_scene
from rlctl.replaying.curves import Plot, Timelines, send_curves, send_pictures
from rlctl.replaying.recorder import Rollout
from rlctl.replaying.scene import BodyMotion, Scene, Warn
from rlctl.storage import files

Followed = dict[str, tuple[str, BodyMotion]]  # what the camera of a world follows: an entity, and its body

_LEVEL_COLORS = {"INFO": 0x3D7DD8FF, "WARN": 0xC06A00FF, "DEBUG": 0x787878FF}  # readable on white and on black
_EYE_DIRECTION = np.array([1.0, 0.75, 0.5])  # from the front left, looking down
_GOAL_MARGIN = 2.5  # distance of the eye / distance of the goal; from 1.9 on a view of 55 degrees contains the goal
_PLOT_ROWS = (("reward",), ("action",), ("joints", "observation"))  # by kind; the plots of a row are tabs


def write_rrd(path: Path, rollout: Rollout, *, title: str, warn: Warn, several: bool = False) -> None:
    """Write a recording atomically; the same episode always has the same recording id.

    Step 0 is the reset; an action, its reward and the state after it have the same step. `warn` receives messages about
    what cannot be drawn. If `several` recordings are opened together, the viewer shows a list of them.
    """
    application = f"rlctl_{registry.make_slug(rollout.episode.info.spec.task)}"
    stream = rr.RecordingStream(application, recording_id=_make_id(rollout.episode), send_properties=False)
    stream.set_log_time_enabled(False)
    with stream:
        layout = _send(stream, rollout, title, warn, several)
        # Into memory: Rerun's own file writer can hang if the disk is full.
        recording = stream.memory_recording()
        stream.send_blueprint(layout, make_active=False, make_default=True)
        content = recording.drain_as_bytes()
    try:
        files.write_bytes(path, content)
    except OSError as error:
        raise ArtifactError(f"{path}: cannot be written: {error.strerror or error}") from error


def _make_id(episode: RecordedEpisode) -> str:
    content = hashlib.sha256(episode.info.model_dump_json().encode())
    content.update(episode.actions.tobytes())
    content.update(episode.rewards.tobytes())
    return f"{registry.make_slug(episode.info.spec.task)}-{episode.info.seed}-{content.hexdigest()[:12]}"


def _send(stream: rr.RecordingStream, rollout: Rollout, title: str, warn: Warn, several: bool) -> rrb.Blueprint:
    timelines, scene = Timelines(stream, rollout.dt), rollout.scene
    stream.send_recording_name(title)
    stream.send_property("episode", _properties(rollout))
    followed = draw_scene(scene, timelines, warn)
    plots = send_curves(rollout, timelines)
    _send_log(rollout, timelines)
    if scene.pictures:
        send_pictures(timelines, "camera", scene.pictures)
    return _layout(rollout, plots, timelines.default, followed, several)


def _properties(rollout: Rollout) -> rr.AnyValues:
    info = rollout.episode.info
    values: dict[str, Any] = {
        "task": info.spec.task,
        "parameters": json.dumps(dict(info.spec.parameters)),
        "seed": info.seed,
        "length": rollout.length,
        "total_reward": info.total_reward,
        "policy": info.policy,
        "robot": rollout.env.robot,
        "control_dt": rollout.env.control_dt,
        "versions": json.dumps({**info.versions, "rerun-sdk": version("rerun-sdk")}),
        "success": info.success,
    }
    return rr.AnyValues(**{key: value for key, value in values.items() if value is not None})


def _send_log(rollout: Rollout, timelines: Timelines) -> None:
    log = rollout.log
    # Every row has all three: the viewer takes a missing level or colour from another row.
    columns = rr.TextLog.columns(
        text=[entry.text for entry in log],
        level=[entry.level for entry in log],
        color=np.array([_LEVEL_COLORS[entry.level] for entry in log], np.uint32),
    )
    timelines.send("events", [entry.step for entry in log], columns)
    if rollout.successes is None:
        return
    style = rr.StateConfiguration(values=["away", "at goal"], colors=[0x8090A0FF, 0x28C85AFF])
    timelines.stream.log("goal", style, static=True)
    held = [False, *rollout.successes.tolist()]
    changes = [0, *(step for step in range(1, len(held)) if held[step] != held[step - 1])]
    states = ["at goal" if held[step] else "away" for step in changes]
    timelines.send("goal", changes, rr.StateChange.columns(state=states))


def _layout(rollout: Rollout, plots: Sequence[Plot], timeline: str, followed: Followed, several: bool) -> rrb.Blueprint:
    """Return the layout: the world on the left, its numbers on the right; the camera follows `followed`."""
    scene = rollout.scene
    left: list[rrb.Container | rrb.View] = []
    if worlds := [_world(scene, world, followed) for world in scene.worlds()]:
        left.append(rrb.Tabs(*worlds) if len(worlds) > 1 else worlds[0])
    if scene.pictures:
        left.append(rrb.Spatial2DView(name="camera", origin="/camera"))
    left += [rrb.Spatial2DView(name=plot.title, origin=f"/{plot.entity}") for plot in plots if plot.kind == "image"]
    names = ["step"] if timeline == "step" else ["step", timeline]
    columns = rrb.TextLogColumns(timeline_columns=names, text_log_columns=["body"])
    below: rrb.Container | rrb.View = rrb.TextLogView(name="events", origin="/events", columns=columns)
    if rollout.successes is not None:
        below = rrb.Horizontal(below, rrb.StateTimelineView(name="goal", origin="/goal"))
    rows = [[_arrange_plot(plot) for plot in plots if plot.kind in kinds] for kinds in _PLOT_ROWS]
    curves = rrb.Vertical(*(rrb.Tabs(*views) if len(views) > 1 else views[0] for views in rows if views))
    content: rrb.Container = rrb.Vertical(rrb.Vertical(*left) if left else curves, below, row_shares=[4, 1])
    if left:
        content = rrb.Horizontal(content, curves, column_shares=[3, 2])
    return rrb.Blueprint(
        content,
        rrb.TimePanel(state="collapsed", timeline=timeline),
        rrb.BlueprintPanel(state="expanded" if several else "hidden"),  # the list of recordings is in it
        rrb.SelectionPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def _arrange_plot(plot: Plot) -> rrb.TimeSeriesView:
    corner, span = plot.legend
    return rrb.TimeSeriesView(
        name=plot.title,
        origin=f"/{plot.entity}",
        plot_legend=rrb.PlotLegend(rrb.Corner2D.auto(corner), visible=True),
        axis_y=rrb.ScalarAxis(range=span),
    )


def _world(scene: Scene, world: str, followed: Followed) -> rrb.Spatial3DView:
    entity, body = followed.get(world, (None, None))
    low, high = bounds(scene, world) if body is None else body.box
    center, size = (low + high) / 2, float(np.linalg.norm(high - low))
    distance = max(1.0, 1.15 * size)
    if body is not None:
        # The followed body is in the middle of the picture: leave room for its feet below, and a goal to one side.
        goals = [float(np.linalg.norm(positions[0] - center)) for positions in scene.markers.values()]
        distance = max(1.0, 1.5 * size, *(_GOAL_MARGIN * goal for goal in goals))
    eye = center + distance * _EYE_DIRECTION / np.linalg.norm(_EYE_DIRECTION)
    start, end = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.cursor_relative()
    so_far = [rrb.VisibleTimeRange(name, start=start, end=end) for name in ("step", "sim_time")]
    robots = [body for body in scene.bodies if body.has_path and body.world == world]
    paths = [rr.new_entity_path([world, "paths", body.name]) for body in robots]
    return rrb.Spatial3DView(
        name=world,
        origin="/",
        contents=[f"{rr.new_entity_path([world])}/**"],
        overrides={path: rrb.VisibleTimeRanges(so_far) for path in paths},
        eye_controls=rrb.EyeControls3D(position=eye, look_target=center, eye_up=(0, 0, 1), tracking_entity=entity),
        line_grid=rrb.LineGrid3D(visible=True, spacing=0.25, plane=rr.components.Plane3D.XY),
    )
