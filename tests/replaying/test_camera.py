"""The camera of films: it holds what moves, follows stairs and not a gait, and looks from where it is told to."""

import itertools
import math

import numpy as np
import pytest

from rlctl.errors import UsageError
from rlctl.replaying.camera import FIELD_OF_VIEW, FilmCamera, Viewpoint, read_viewpoint
from rlctl.replaying.captions import CameraPose
from rlctl.replaying.replay import run_replay
from rlctl.replaying.replay_request import ReplayRequest

SIZE = (400, 300)
LOW, HIGH = np.array([-0.2, -0.2, 0.0]), np.array([0.2, 0.2, 0.5])


def is_seen(point, eye, target):
    forward = np.subtract(target, eye)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    way = np.subtract(point, eye)
    slope = math.tan(math.radians(FIELD_OF_VIEW) / 2) * (way @ forward)
    return abs(way @ np.cross(right, forward)) < slope and abs(way @ right) < slope * SIZE[0] / SIZE[1]


@pytest.mark.parametrize("text", [None, "90", "0,70", "-130,10,1"])
def test_all_that_moves_stays_in_the_picture(text):
    camera = FilmCamera(LOW, HIGH, SIZE, read_viewpoint(text))
    for reach in np.linspace(0.0, 0.6, 20):  # an arm that stretches out and lifts its load
        high = HIGH + np.array([reach, 0.0, reach])
        eye, target = camera.aim(LOW, high)
        assert is_seen(LOW, eye, target)
        assert is_seen(high, eye, target)
    away = math.dist(eye, target)
    assert math.dist(*camera.aim(LOW, HIGH)) == away  # it comes no nearer again: a film that breathes is hard to watch


@pytest.mark.parametrize("headroom", [0.0, 0.1, 0.25])
def test_text_has_room_above_what_is_seen(headroom):
    size, box = (640, 480), np.array([[-0.2, -0.2, 0.0], [0.2, 0.2, 1.6]])
    pose = CameraPose(*FilmCamera(*box, size, Viewpoint(headroom=headroom)).aim(*box))
    corners = np.array(list(itertools.product(*box.T)))
    rows = [pose.project(corner, size)[1] for corner in corners]
    assert headroom * size[1] < min(rows)
    assert min(rows) < headroom * size[1] + 0.15 * size[1]
    assert max(rows) < size[1]


def test_what_falls_for_ever_is_not_followed():
    camera = FilmCamera(LOW, HIGH, SIZE, Viewpoint())
    first = math.dist(*camera.aim(LOW, HIGH))
    assert math.dist(*camera.aim(LOW - np.array([0.0, 0.0, 100.0]), HIGH)) == pytest.approx(3 * first)


def test_a_robot_is_followed_upstairs_and_its_gait_is_not():
    camera = FilmCamera(LOW, HIGH, SIZE, Viewpoint())
    heights = []
    for step in range(100):
        lift = np.array([0.05 * step, 0.0, 0.02 * math.sin(step)])  # a trunk of 0.5 m that goes up and down by 2 cm
        _, target = camera.aim(LOW + lift, HIGH + lift, (LOW + HIGH) / 2 + lift)
        heights.append(target[2])
        assert target[0] == pytest.approx(0.05 * step)
    assert np.ptp(heights) == 0.0
    lift = np.array([5.0, 0.0, 1.0])
    eye, target = camera.aim(LOW + lift, HIGH + lift, (LOW + HIGH) / 2 + lift)
    assert target[2] == pytest.approx(1.25 - 0.05)
    assert is_seen(HIGH + lift, eye, target)


def test_the_viewpoint():
    assert Viewpoint(90.0, 0.0).direction == pytest.approx([0.0, 1.0, 0.0])
    far = FilmCamera(LOW, HIGH, SIZE, Viewpoint()).aim(LOW, HIGH)
    near = FilmCamera(LOW, HIGH, SIZE, read_viewpoint("-42,22,2")).aim(LOW, HIGH)
    assert math.dist(*far) == pytest.approx(2 * math.dist(*near))


@pytest.mark.parametrize("text", ["left", "", "1,2,3,4", "nan", "0,95", "0,20,0"])
def test_a_viewpoint_that_cannot_be(text):
    with pytest.raises(UsageError, match=r"^--camera .*: give AZIMUTH\[,ELEVATION\[,ZOOM\]\], degrees from the x axis"):
        read_viewpoint(text)


def test_a_camera_is_for_films():
    with pytest.raises(UsageError, match=r"^--camera is for films: add --video FILE.mp4$"):
        run_replay(ReplayRequest("reach", camera="90"))
