"""The layout in a recording: what the viewer shows where."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from rlctl.replay.bodies import WORLD_FRAME, bounds, start_bounds
from rlctl.replay.curves import Plot
from rlctl.replay.scene import Scene

_EYE_DIRECTION = np.array([1.0, 0.75, 0.5])  # from the front left, looking down
_ROWS = (("reward",), ("action",), ("joints", "observation"))  # by kind; those of a row are tabs


def blueprint(
    plots: Sequence[Plot],
    scene: Scene | None,
    *,
    pictures: bool,
    success: bool,
    timeline: str,
    followed: str | None = None,
) -> rrb.Blueprint:
    """Return the layout: the world on the left, its numbers on the right; the camera goes along with `followed`."""
    left: list[rrb.Container | rrb.View] = []
    if scene is not None:
        left.append(_world(scene, followed))
    if pictures:
        left.append(rrb.Spatial2DView(name="camera", origin="/camera"))
    left += [rrb.Spatial2DView(name=plot.title, origin=f"/{plot.entity}") for plot in plots if plot.kind == "image"]
    columns = rrb.TextLogColumns(
        timeline_columns=["step"] if timeline == "step" else ["step", timeline], text_log_columns=["body"]
    )
    log = rrb.TextLogView(name="events", origin="/events", columns=columns)
    below = rrb.Horizontal(log, rrb.StateTimelineView(name="goal", origin="/goal")) if success else log
    right = _curves(plots)
    if left:
        content: rrb.Container = rrb.Horizontal(
            rrb.Vertical(rrb.Vertical(*left), below, row_shares=[4, 1]), right, column_shares=[3, 2]
        )
    else:
        content = rrb.Vertical(right, below, row_shares=[4, 1])
    return rrb.Blueprint(
        content,
        rrb.TimePanel(state="collapsed", timeline=timeline),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def _curves(plots: Sequence[Plot]) -> rrb.Container:
    rows = [[_plot(plot) for plot in plots if plot.kind in kinds] for kinds in _ROWS]
    return rrb.Vertical(*(rrb.Tabs(*views) if len(views) > 1 else views[0] for views in rows if views))


def _plot(plot: Plot) -> rrb.TimeSeriesView:
    legend = rrb.PlotLegend(rrb.Corner2D.RightTop, visible=True)
    return rrb.TimeSeriesView(name=plot.title, origin=f"/{plot.entity}", plot_legend=legend)


def _world(scene: Scene, followed: str | None) -> rrb.Spatial3DView:
    low, high = bounds(scene) if followed is None else start_bounds(scene)
    center = (low + high) / 2
    margin = 1.15 if followed is None else 1.5  # what is followed is in the middle, its feet are far below
    distance = max(1.0, margin * float(np.linalg.norm(high - low)))
    eye = center + distance * _EYE_DIRECTION / np.linalg.norm(_EYE_DIRECTION)
    start, end = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.cursor_relative()
    so_far = [rrb.VisibleTimeRange(name, start=start, end=end) for name in ("step", "sim_time")]
    return rrb.Spatial3DView(
        name="world",
        origin="/",
        contents=["/world/**", "/tf/**"],
        overrides={
            rr.new_entity_path(["world", "paths", body.name]): rrb.VisibleTimeRanges(so_far) for body in scene.robots()
        },
        eye_controls=rrb.EyeControls3D(position=eye, look_target=center, eye_up=(0, 0, 1), tracking_entity=followed),
        spatial_information=rrb.SpatialInformation(target_frame=WORLD_FRAME),
        line_grid=rrb.LineGrid3D(visible=True, spacing=0.25, plane=rr.components.Plane3D.XY),
    )
