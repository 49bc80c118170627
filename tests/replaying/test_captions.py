"""What is written into films: rings around markers, the time, commanded velocities; sky and floor."""

import contextlib

import numpy as np
import pytest

from rlctl.engine import MUJOCO
from rlctl.environments.spec import EnvSpec
from rlctl.replaying.captions import CameraPose, Caption, annotate
from rlctl.replaying.views import look_at, make_filmable
from rlctl.task.commands import name_for_people


def test_a_point_in_the_picture_by_hand():
    look = CameraPose((0.0, 0.0, 1.0), (2.0, 0.0, 1.0))
    # 2 m away a picture of 100 rows is 2 * 2 tan(22.5 degrees) = 1.657 m high: 60.36 pixels per metre.
    column, row, scale = look.project(np.array([2.0, 0.1, 1.2]), (200, 100))
    assert scale == pytest.approx(60.36, abs=0.01)
    assert (column, row) == (pytest.approx(100 - 6.036, abs=0.01), pytest.approx(50 - 12.07, abs=0.01))
    assert look.project(np.array([-1.0, 0.0, 1.0]), (200, 100)) is None  # behind the camera


def test_a_ring_is_seen_where_a_hand_hides_the_marker():
    picture = np.full((240, 320, 3), 90, np.uint8)
    look = CameraPose((1.0, 0.0, 0.5), (0.0, 0.0, 0.5))
    ringed = annotate(picture, {"goal": np.array([0.0, 0.0, 0.5])}, look)
    changed = (ringed != picture).any(axis=2)
    assert changed[105, 160] or changed[106, 160]  # 0.05 m above the middle: 14.5 pixels
    assert not changed[120, 160]
    assert annotate(picture, {}, look) is picture


def test_a_walking_robot_names_commanded_and_measured_velocities():
    with contextlib.closing(EnvSpec("quadruped").make()) as env:
        env.reset(seed=1)
        inner = env.unwrapped
        caption = Caption(inner)
        caption.begin()
        time_line, command_line = caption.list_lines(1.5)
        command = float(inner.commands()["lin_vel_x"].value)
        headroom = caption.find_headroom(480)
    assert time_line == "1.50 s"
    assert headroom == pytest.approx(2 * 1.3 * 18 / 480)  # two lines of 18 pixels
    assert command_line.startswith(f"velocity forwards: commanded {command:+.2f}, measured ")
    assert command_line.endswith(" m/s")


def test_names_of_commands_are_written_for_people():
    assert name_for_people("ang_vel_z") == "turning left"
    assert name_for_people("body_height") == "body height"


def test_coordinates_of_a_marker_are_drawn_and_not_written():
    with contextlib.closing(EnvSpec("reach").make("rgb_array")) as env:
        env.reset(seed=1)
        assert Caption(env.unwrapped).list_lines(0.25) == ["0.25 s"]
        assert Caption(env.unwrapped).find_headroom(480) == 0.0


def test_lines_are_in_the_corner():
    picture = np.full((240, 320, 3), 90, np.uint8)
    look = CameraPose((1.0, 0.0, 0.5), (0.0, 0.0, 0.5))
    written = (annotate(picture, {}, look, ["1.50 s", "two"]) != picture).any(axis=2)
    assert written[:40, :80].any()
    assert not written[60:].any()
    assert not written[:, 160:].any()


@pytest.mark.pybullet
def test_a_world_without_a_ground_gets_a_floor_and_a_sky():
    with contextlib.closing(make_filmable(EnvSpec("kuka-grasp"))) as env:
        env.reset(seed=0)
        view = look_at(env, 160, 120)
        view.begin()
        corners = view.draw()[[0, -1], :8].astype(int)
    assert (corners.min(axis=(1, 2)) > 150).all()
    assert (corners != 255).any(axis=2).all()  # PyBullet's empty white
    assert np.ptp(corners[1].mean(axis=0)) > 2  # bluish squares, not grey


@pytest.mark.slow
def test_mujoco_draws_a_floor_of_squares_too():
    with contextlib.closing(make_filmable(EnvSpec("reach", sim=MUJOCO))) as env:
        env.reset(seed=0)
        sim = env.unwrapped.sim
        look = {"eye": (1.0, 1.0, 0.8), "target": (0.0, 0.0, 0.2), "field_of_view": 45.0, "sun": True}
        below, without = (sim.render(64, 48, floor=floor, **look) for floor in (0.3, None))
        away = {**look, "eye": (4.0, 4.0, 0.8), "target": (7.0, 7.0, 0.2)}  # only the floor is seen
        squares = sim.render(64, 48, floor=0.3, **away)[36].astype(int).mean(axis=1)
    assert (below != without).any(axis=2).mean() > 0.3
    assert np.ptp(squares) > 15
