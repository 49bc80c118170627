import json
import resource

import numpy as np
import pytest

from rlctl.environments.dict_spaces import split_names
from rlctl.errors import ArtifactError
from rlctl.replaying.curves import Plot
from rlctl.replaying.rrd import _LEVEL_COLORS, write_rrd
from rlctl.task import rough_heights
from tests.replaying.conftest import play, reach
from tests.replaying.reading import column, entities, properties, reader, static

pytestmark = pytest.mark.pybullet


def observed_by_name(rollout):
    return split_names(rollout.episode.observations, rollout.env.observation_sizes)


@pytest.fixture(scope="module")
def recording(reached, tmp_path_factory):
    path = tmp_path_factory.mktemp("rrd") / "reach.rrd"
    warnings = []
    write_rrd(path, reached, title="reach / by hand", warn=warnings.append)
    assert warnings == []
    return path


@pytest.fixture(scope="module")
def tumble(tmp_path_factory):
    rollout, _ = play("Tumble")
    path, warnings = tmp_path_factory.mktemp("rrd") / "tumble.rrd", []
    write_rrd(path, rollout, title="tumble", warn=warnings.append)
    return path, rollout, warnings


def test_joint_curves_are_those_of_the_episode(recording, reached):
    steps, positions = column(recording, "/joints/position/arm")
    assert steps.tolist() == list(range(121))
    # Float64 goes through a recording bit by bit; the observation is its float32.
    np.testing.assert_array_equal(positions.astype(np.float32), reached.episode.observations[:, :7])
    np.testing.assert_array_equal(positions, reached.scene.robots()[0].joint_positions)
    assert static(recording, "/joints/position/arm", "SeriesLines:names")[0] == "lbr_iiwa_joint_1"


def test_weighted_terms_have_a_curve_each_and_add_up(recording, reached):
    terms = {name: column(recording, f"/reward/terms/{name}")[1].ravel() for name in reached.episode.info.term_names}
    assert list(terms) == ["distance", "reached", "action", "smoothness"]
    steps, total = column(recording, "/reward/total")
    assert steps.tolist() == list(range(1, 121))
    np.testing.assert_allclose(sum(terms.values()), total.ravel(), atol=1e-12)
    np.testing.assert_array_equal(total.ravel(), reached.episode.rewards)
    # The weight of the distance is -1: the curve is the raw term with the other sign.
    np.testing.assert_array_equal(terms["distance"], -reached.episode.terms[:, 0])
    colors = {static(recording, f"/reward/terms/{name}", "SeriesLines:colors")[0] for name in terms}
    assert len(colors) == 4


def test_goal_and_hand_are_where_they_were(recording, reached):
    observed = observed_by_name(reached)
    goal = (observed["hand"] + observed["hand_to_goal"])[0]
    _, drawn = column(recording, "/world/markers/goal", "Points3D:positions")
    np.testing.assert_allclose(drawn[:, 0], np.broadcast_to(goal, (121, 3)), atol=1e-6)
    _, path = column(recording, "/world/paths/arm", "LineStrips3D:strips")
    np.testing.assert_allclose(path[:, 0, 1], observed["hand"][1:], rtol=2e-7)  # both are rounded to float32


def test_actions_and_observations_by_name(recording, reached):
    steps, actions = column(recording, "/action")
    assert steps[0] == 1
    np.testing.assert_array_equal(actions, reached.episode.actions)
    _, hand = column(recording, "/observation/hand")
    np.testing.assert_array_equal(hand, observed_by_name(reached)["hand"])


def test_robot_has_meshes_where_its_links_are(recording, reached):
    found = entities(recording)
    assert {f"/world/arm/lbr_iiwa_link_{link}/shape_0" for link in range(8)} <= found
    arm = reached.scene.robots()[0]
    for link, name in enumerate(arm.links):
        steps, positions = column(recording, f"/world/arm/{name}", "Transform3D:translation")
        _, turns = column(recording, f"/world/arm/{name}", "Transform3D:quaternion")
        # What does not move, the base, has one row.
        assert len(steps) == (1 if link == 0 else 121)
        np.testing.assert_allclose(positions[:, 0], arm.positions[: len(steps), link], atol=1e-6)
        np.testing.assert_allclose(turns[:, 0], arm.orientations[: len(steps), link], atol=1e-6)


def test_two_timelines_of_equal_length(recording):
    steps, _ = column(recording, "/action")
    times, _ = column(recording, "/action", timeline="sim_time")
    nanoseconds = times.astype("timedelta64[ns]").astype(np.int64)
    # 60 Hz, to the nearest nanosecond.
    assert nanoseconds.tolist() == [round(step * 1e9 / 60) for step in steps.tolist()]


def test_no_wall_clock(recording):
    timelines = {name for chunk in reader(recording).stream() for name in chunk.timeline_names}
    assert timelines <= {"step", "sim_time"}
    assert "/__properties" not in entities(recording)


def test_log_says_what_happened(recording):
    steps, texts = column(recording, "/events", "TextLog:text")
    log = [(step, text[0]) for step, text in zip(steps.tolist(), texts.tolist(), strict=True)]
    assert log[0] == (0, "reset with seed 5")
    assert log[1][1] == "goal reached"
    assert log[-2:] == [(120, "truncated: time limit"), (120, "success")]
    steps, states = column(recording, "/goal", "StateChange:state")
    assert states.ravel().tolist() == ["away", "at goal"]
    assert steps[1] == log[1][0]


def test_properties_say_what_it_is(recording):
    known = properties(recording)
    assert known["task"] == "reach"
    assert (known["seed"], known["length"], known["success"]) == (5, 120, True)
    assert known["policy"] == "inverse kinematics"
    assert json.loads(known["versions"]).keys() >= {"rlctl", "pybullet", "rerun-sdk"}


def test_layout_is_in_the_file(recording):
    assert len(reader(recording).blueprints()) == 1


@pytest.mark.slow
def test_same_episode_same_recording_id(recording, tmp_path):
    write_rrd(tmp_path / "again.rrd", reach(5), title="again", warn=print)
    write_rrd(tmp_path / "other.rrd", reach(6), title="other", warn=print)
    ids = [
        reader(path).recordings()[0].recording_id
        for path in (recording, tmp_path / "again.rrd", tmp_path / "other.rrd")
    ]
    assert ids[0] == ids[1] != ids[2]


def test_a_full_disk_is_an_error_of_one_line(reached, tmp_path):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
    try:
        with pytest.raises(ArtifactError, match=r"reach\.rrd: cannot be written: File too large"):
            write_rrd(tmp_path / "reach.rrd", reached, title="reach", warn=print)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(tmp_path.iterdir()) == []


def test_actions_are_named_by_joints(recording, reached):
    assert static(recording, "/action", "SeriesLines:names") == list(reached.env.joints.names)


@pytest.mark.parametrize(
    ("values", "corner"),
    [
        (np.linspace(0, 1, 90)[:, None], "RightBottom"),
        (np.linspace(1, 0, 90)[:, None], "RightTop"),
        (np.random.default_rng(0).normal(size=(90, 7)), None),
        (np.full((5, 2), 3.0), None),
        (np.zeros((0, 2)), None),
        (np.full((3, 1), np.nan), None),
    ],
)
def test_a_legend_covers_no_curve(values, corner):
    chosen, (low, high) = Plot("p", "p", "action", values).legend
    assert corner in (None, chosen)
    assert low < high
    if not np.isfinite(values).all() or not values.size:
        return
    height, third = (high - low) * min(0.1 * values.shape[1], 0.6), len(values) // 3
    near = values[-third:] if chosen.startswith("Right") else values[:third]
    assert near.max() <= high - height + 1e-9 if chosen.endswith("Top") else near.min() >= low + height - 1e-9


def luminance(color: int) -> float:
    """Return the relative luminance of 0xRRGGBBAA, by WCAG 2."""
    channels = [(color >> shift & 0xFF) / 255 for shift in (24, 16, 8)]
    linear = [value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4 for value in channels]
    return float(np.dot(linear, (0.2126, 0.7152, 0.0722)))


@pytest.mark.parametrize("background", [0xFFFFFFFF, 0x0D1011FF], ids=["light", "dark"])
def test_events_are_readable_in_both_themes(background):
    for color in _LEVEL_COLORS.values():
        low, high = sorted([luminance(color), luminance(background)])
        assert (high + 0.05) / (low + 0.05) > 3.9


@pytest.mark.slow
def test_free_body_moves_by_its_link_frame(tumble):
    path, rollout, _ = tumble
    cube = next(body for body in rollout.scene.bodies if body.name == "cube")
    _, positions = column(path, "/world/cube/baseLink", "Transform3D:translation")
    np.testing.assert_allclose(positions[:, 0], cube.positions[:, 0], rtol=1e-6)
    assert cube.positions[0, 0, 2] == pytest.approx(0.4, abs=1e-6)
    assert cube.positions[-1, 0, 2] < 0.3


def test_every_shape_of_a_robot_is_drawn(tumble):
    path, rollout, warnings = tumble
    assert warnings == []
    car = next(body for body in rollout.scene.bodies if body.name == "car")
    drawn = [entity for entity in entities(path) if entity.startswith("/world/car/") and "shape" in entity]
    assert len(drawn) == len(car.shapes) > 3


def test_ground_is_a_box_and_no_mesh(tumble):
    path, _, _ = tumble
    assert "/world/ground/planeLink/shape_0" not in entities(path)
    assert static(path, "/world/ground", "Boxes3D:half_sizes")


@pytest.mark.slow
def test_rough_ground_is_a_mesh_of_its_heights(tmp_path):
    rollout, warnings = play("Rough", car="r2d2.urdf")
    write_rrd(tmp_path / "rough.rrd", rollout, title="rough", warn=warnings.append)
    assert warnings == []
    # 4 m x 3 m in cells of 0.5 m: 9 x 7 points, 8 x 6 cells of two triangles.
    points = np.array(static(tmp_path / "rough.rrd", "/world/hills", "Mesh3D:vertex_positions"))
    triangles = np.array(static(tmp_path / "rough.rrd", "/world/hills", "Mesh3D:triangle_indices"))
    assert (points.shape, triangles.shape) == ((9 * 7, 3), (2 * 8 * 6, 3))
    np.testing.assert_allclose(points[0, :2], (-2.0, -1.5))
    np.testing.assert_allclose(points[1, :2], (-2.0, -1.0))
    heights = rough_heights(0, size=(4, 3), cell=0.5, roughness=0.1)
    np.testing.assert_allclose(points[:, 2], heights.ravel(), atol=1e-6)
    # Every triangle is half a cell, seen from above: 0.5 * 0.5 / 2 = 0.125 m^2.
    first, second, third = (points[triangles[:, corner], :2] for corner in range(3))
    (x1, y1), (x2, y2) = (second - first).T, (third - first).T
    np.testing.assert_allclose((x1 * y2 - x2 * y1) / 2, 0.125, atol=1e-6)


def test_moving_goal_moves(tumble):
    path, _, _ = tumble
    _, positions = column(path, "/world/markers/goal", "Points3D:positions")
    # It moves 1 m/s along x: half a second, 30 steps.
    np.testing.assert_allclose(positions[:, 0, 0], np.arange(31) / 60, atol=1e-6)


def test_drawn_events_and_lost_goals_are_logged(tumble):
    path, _, _ = tumble
    steps, texts = column(path, "/events", "TextLog:text")
    log = list(zip(steps.tolist(), texts[:, 0].tolist(), strict=True))
    assert any(step == 0 and text.startswith("event mass: factor ") for step, text in log)
    assert [step for step, text in log if text.startswith("event grip: friction ")] == [15, 30]
    texts = [text for _, text in log]
    assert texts.index("goal reached") < texts.index("goal lost")
    assert texts[-1] == "no success"
    # A term of weight 0 is a metric: its curve is 0.
    _, metric = column(path, "/reward/terms/metric")
    assert not metric.any()
