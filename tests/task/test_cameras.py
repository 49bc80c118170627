"""Cameras of a task: where they look, what changes their pictures, and that worlds of a batch do not differ."""

import ctypes.util
import math

import numpy as np
import pytest
from gymnasium import spaces

from rlctl.errors import RecipeError, TaskError, UsageError
from rlctl.task import Camera, Event, events
from rlctl.task.camera import Distractor, check_cameras
from rlctl.task.events import EventSettings
from rlctl.task.mujoco.cameras import MOST_DISTRACTORS
from rlctl.task.mujoco.sim import MujocoSim
from rlctl.task.observation import Observing
from rlctl.task.worlds import TaskWorlds
from tests.task.batches import SeenStool
from tests.task.tasks import Cart

pytest.importorskip("mujoco")
needs_egl = pytest.mark.skipif(ctypes.util.find_library("EGL") is None, reason="needs libEGL")

RED = (1.0, 0.0, 0.0)
LOOKS = {"light": {}, "color": {}, "pose": {}, "things": {}}
SEEN = Observing(["front", "seat", "hips"])


@pytest.fixture
def make_worlds():
    made = []

    def make(count, *, observing=SEEN, settings=LOOKS):
        worlds = TaskWorlds(
            SeenStool(), count, visuals=False, observing=observing, events=EventSettings(False, settings)
        )
        made.append(worlds)
        return worlds

    yield make
    for worlds in made:
        worlds.close()


@pytest.fixture(scope="module")
def empty():
    """An empty world before a camera 1 m from the z axis."""
    sim = MujocoSim(control_dt=0.02, substeps=1)
    sim.cameras = {"front": Camera(eye=(1.0, 0.0, 0.3), target=(0.0, 0.0, 0.3), field_of_view=40.0, size=(96, 64))}
    sim.load("ground", "plane.urdf", fixed=True)
    sim.save()
    yield sim
    sim.close()


@pytest.fixture
def watched(empty):
    empty.restore()
    return empty


def find_red(picture):
    """Return the middle of what is red: row and column [pixels]."""
    rows, columns = np.nonzero((picture[..., 0] > 60) & (picture[..., 1] < 30))
    assert len(rows)
    return rows.mean() + 0.5, columns.mean() + 0.5


@needs_egl
def test_points_are_where_perspective_has_them(watched):
    watched.set_distractors([Distractor("ball", (0.0, 0.1, 0.2), (0.02,) * 3, 0.0, RED)])
    row, column = find_red(watched.take_pictures("front")[0])
    # f = 32 pixels / tan 20 degrees = 87.9; 0.1 m to the right and 0.1 m below, at 1 m: 8.8 pixels from the middle
    assert (row, column) == pytest.approx((32 + 8.8, 48 + 8.8), abs=0.3)


@needs_egl
@pytest.mark.parametrize(
    ("shift", "turn", "expected"),
    [
        ((0.05, 0.0, 0.0), (0, 0, 0), (0.0, -4.4)),  # 0.05 m to the right: 0.05 * 87.9 pixels to the left
        ((0.0, 0.05, 0.0), (0, 0, 0), (4.4, 0.0)),
        ((0.0, 0.0, 0.0), (0, math.radians(5), 0), (0.0, 7.7)),  # to the left about its up: 87.9 tan 5 degrees
        ((0.0, 0.0, 0.0), (math.radians(5), 0, 0), (7.7, 0.0)),  # up about its right
    ],
)
def test_a_moved_camera_sees_points_elsewhere(watched, shift, turn, expected):
    watched.set_distractors([Distractor("ball", (0.0, 0.0, 0.3), (0.02,) * 3, 0.0, RED)])
    watched.move_camera("front", shift, turn)
    row, column = find_red(watched.take_pictures("front")[0])
    assert (row - 32, column - 48) == pytest.approx(expected, abs=0.4)
    watched.restore()
    watched.set_distractors([Distractor("ball", (0.0, 0.0, 0.3), (0.02,) * 3, 0.0, RED)])
    assert find_red(watched.take_pictures("front")[0]) == pytest.approx((32, 48), abs=0.3)


@needs_egl
def test_light_is_as_bright_as_it_is_set(watched):
    usual = watched.take_pictures("front")[0, -1].mean()
    watched.set_light(0.25, (0.0, 0.0, -1.0))
    quarter = watched.take_pictures("front")[0, -1].mean()
    watched.set_light(0.5, (0.0, 0.0, -1.0))
    assert watched.take_pictures("front")[0, -1].mean() == pytest.approx(2 * quarter, rel=0.05)
    watched.restore()
    assert watched.take_pictures("front")[0, -1].mean() == usual


@needs_egl
@pytest.mark.slow
def test_pictures_depend_on_the_seed_only(make_worlds):
    many, one = make_worlds(3), make_worlds(1)
    seeds, actions = [5, 6, 7], np.random.default_rng(0).uniform(-1, 1, (4, 3, 2))
    many.reset(np.arange(3), [1, 2, 3])
    many.step(actions[0])
    seen = [many.reset(np.arange(3), seeds)] + [many.step(action).observation for action in actions]
    assert seen[0]["front"].shape == (3, 36, 40, 3)
    for world, seed in enumerate(seeds):
        alone = [one.reset(np.zeros(1, int), [seed])]
        alone += [one.step(action[world : world + 1]).observation for action in actions]
        for camera in ("front", "seat"):
            own = [step[camera][world] for step in seen]
            np.testing.assert_array_equal(own, [step[camera][0] for step in alone])
    assert (seen[0]["front"][0] != seen[0]["front"][1]).any()
    assert (seen[0]["front"][0] != seen[-1]["front"][0]).any()  # the stool falls


@pytest.mark.slow
@needs_egl
def test_some_worlds_begin_again_while_others_play(make_worlds):
    worlds = make_worlds(3)
    first = worlds.reset(np.arange(3), [5, 6, 7])
    worlds.step(np.zeros((3, 2)))
    again = worlds.reset(np.array([2]), [7])
    assert again["front"].shape == (1, 36, 40, 3)
    np.testing.assert_array_equal(again["front"][0], first["front"][2])


def test_only_what_is_named_is_drawn(make_worlds):
    worlds = make_worlds(2, observing=Observing())
    assert isinstance(worlds.observation_space, spaces.Box)
    assert "front" not in worlds.view.sizes
    worlds.reset(np.arange(2), [1, 2])
    assert not worlds.sim._camera_pictures
    seen = make_worlds(2, observing=Observing(["front"]))
    assert seen.observation_space["front"] == spaces.Box(0, 255, (36, 40, 3), np.uint8)
    with pytest.raises(RecipeError, match=r"no observation 'frnt'\. Did you mean 'front'"):
        make_worlds(1, observing=Observing(["frnt"]))


@pytest.mark.slow
@needs_egl
def test_noise_and_delay_act_on_pictures(make_worlds):
    class Late(SeenStool):
        events = {"late": Event("observation", events.delay, of="front", steps=(2, 2), enabled=True)}

    late = TaskWorlds(Late(), 2, visuals=False, observing=Observing(["front"]))
    exact = make_worlds(2, observing=Observing(["front"]), settings={})
    seen = [[worlds.reset(np.arange(2), [1, 2])["front"]] for worlds in (late, exact)]
    for _ in range(4):
        for worlds, pictures in zip((late, exact), seen, strict=True):
            pictures.append(worlds.step(np.ones((2, 2))).observation["front"])
    np.testing.assert_array_equal(seen[0][4], seen[1][2])
    assert seen[0][4].dtype == np.uint8
    late.close()


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        ("front", "write Camera"),
        (Camera((0, 0, 1), (0, 0, 0)), "along `up`"),
        (Camera((0, 0, 1), (0, 0, 1)), "along `up`"),
        (Camera((1, 0, 1), (0, 0, 0), size=(0, 64)), "from 1 to 1024 pixels"),
        (Camera((1, 0, 1), (0, 0, 0), field_of_view=180), "between 0 and 180 degrees"),
        (Camera((1, 0, 1), (0, 0, 0), link="hand"), "without its body"),
    ],
)
def test_mistakes_in_a_camera(camera, message):
    with pytest.raises(TaskError, match=message):
        check_cameras("Task", {"camera": camera})


def test_a_camera_needs_a_body_and_a_link_of_the_world(monkeypatch):
    for camera, message in (
        (Camera((1, 0, 1), (0, 0, 0), body="table"), "cameras: no body 'table'"),
        (Camera((1, 0, 1), (0, 0, 0), body="stool", link="hnd"), "hnd"),
    ):
        monkeypatch.setattr(SeenStool, "cameras", {"camera": camera})
        with pytest.raises(TaskError, match=message):
            TaskWorlds(SeenStool(), 2)


def test_too_many_distractors_are_refused(watched):
    thing = Distractor("box", (0, 0, 0), (0.1, 0.1, 0.1), 0.0, RED)
    with pytest.raises(TaskError, match="9 things; at most 8 fit"):
        watched.set_distractors([thing] * (MOST_DISTRACTORS + 1))
    with pytest.raises(TaskError, match="no camera 'side'"):
        watched.move_camera("side", (0, 0, 0), (0, 0, 0))


@pytest.mark.pybullet
def test_a_task_in_pybullet_has_cameras_and_no_lights():
    class SeenCart(Cart):
        cameras = {"side": Camera(eye=(0.5, 0.0, 0.1), target=(0.0, 0.0, 0.1), size=(32, 24))}
        events = {}

    worlds = TaskWorlds(SeenCart(), observing=Observing(["side", "cube"]))
    first = worlds.reset(np.zeros(1, int), [0])["side"]
    assert first.shape == (1, 24, 32, 3)
    with pytest.raises(UsageError, match="set_light: not in PyBullet"):
        worlds.sim.set_light(1.0, (0, 0, -1))
    worlds.close()
