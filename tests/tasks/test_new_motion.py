"""`rlctl tasks new --motion`: the plugin of a robot that follows clips."""

import contextlib
import json

import numpy as np
import pytest

from rlctl.environments.info import describe
from rlctl.environments.spec import EnvSpec
from rlctl.errors import UsageError
from rlctl.task.clip_options import ClipOptions
from rlctl.task.motion import read_motion
from rlctl.task.worlds import TaskWorlds
from rlctl.tasks import new
from tests.tasks.test_motion_faults import BENT
from tests.tasks.test_new import run
from tests.tasks.test_new_walk import read_task, write_dog

WORLDS = 4


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with a dog, and clips in which it bends its knees and nods."""
    monkeypatch.chdir(tmp_path)
    write_dog(tmp_path)
    for name, frames in (("bend", 90), ("nod", 60)):
        bent = 0.15 * (1 - np.cos(2 * np.pi * np.arange(frames) / frames))
        joints = np.tile(BENT, (frames, 1))
        joints[:, 1:12:3] += bent[:, None]
        joints[:, 2:12:3] -= 2 * bent[:, None]
        root = np.tile([0.0, 0.0, 0.33, 0.0, 0.0, 0.0, 1.0], (frames, 1))
        root[:, 2] -= 0.15 * (np.cos(0.5) - np.cos(0.5 + bent)) * 2
        np.savetxt(tmp_path / f"{name}_30hz.csv", np.column_stack([root, joints]), delimiter=",")
    return tmp_path


def create(name: str, *clips: str, **options) -> new.NewPlugin:
    """Write a plugin, of another name in each test: its module stays imported."""
    return new.create(name, model="dog.xml", motions=clips, clip=ClipOptions(**options))


@pytest.mark.slow
def test_a_plugin_of_a_clip(folder):
    plugin = create("dog-bends", "bend_30hz.csv")
    assert "follows a clip of 2.97 s" in plugin.summary
    assert "bend_30hz.csv: 90 frames at 30 Hz (its name)" in plugin.summary
    assert "bend_30hz: no findings" in plugin.summary
    task = read_task(plugin)
    assert len(task.joints) == 13
    assert task.reference.duration == pytest.approx(2.96)
    assert set(task.links) >= {"front_left_shank", "rear_right_shank"}
    with contextlib.closing(EnvSpec(plugin.target).make()) as env:
        info = describe(env)
        assert list(info.observation_terms["joints"].inputs) == []
        assert info.joints.reference == "joints"
        env.reset(seed=0)
        for _ in range(200):
            *_, terminated, truncated, _ = env.step(env.action_space.sample() * 0)
            if terminated or truncated:
                break
        assert truncated
        assert env.unwrapped.task.rows == task.reference.ends


def test_two_clips_and_a_command_that_chooses(folder):
    plugin = create("dog-chooses", "bend_30hz.csv", "nod_30hz.csv")
    with contextlib.closing(EnvSpec(plugin.target).make()) as env:
        info = describe(env)
        assert info.observation_terms["joints"].inputs == ("clip_time",)
        assert info.command_ranges == {"clip": (0.0, 1.0)}
        env.reset(seed=0)
        task = env.unwrapped.task
        task.set_commands({"clip": np.array([1.0])})
        starts = env.unwrapped.task.rows
        assert float(task.commands()["clip"].value[0]) == 1.0
        task.set_commands({"clip": np.array([1.0])})
        assert task.rows == starts


def test_a_robot_that_walks_in_the_style_of_a_clip(folder):
    plugin = new.create("dog-minds", model="dog.xml", walk=True, motions=["bend_30hz.csv"])
    assert "walks in the style of bend_30hz" in plugin.summary
    assert "bend_30hz: no findings" in plugin.summary
    assert not plugin.follows
    with contextlib.closing(EnvSpec(plugin.target).make()) as env:
        task = env.unwrapped.task
        env.reset(seed=0)
        env.step(env.action_space.sample() * 0)
        rows = read_motion(folder / "dog-minds" / "dog_minds" / "bend_30hz.csv").take_joints(task.body.joint_names)
        task.body.set_joints(rows[:1], worlds=np.zeros(1, np.int64))
        near = task.rewards(np.zeros((1, 12)))
        task.body.set_joints(rows[:1] + 0.4, worlds=np.zeros(1, np.int64))
        far = task.rewards(np.zeros((1, 12)))
    # The clip is at rest in its first row. exp(-(0.4 / 0.25)^2) is 0.08; a mirror image may be nearer.
    assert near["style_error"] == pytest.approx(0.0, abs=0.02)
    assert near["style"] > 0.98
    assert far["style"] < 0.2


def test_worlds_begin_in_rows_of_their_seeds(folder):
    plugin = create("dog-starts", "bend_30hz.csv")
    cls = EnvSpec(plugin.target).constructor()
    with contextlib.closing(TaskWorlds(cls(), WORLDS)) as worlds:
        worlds.reset(np.arange(WORLDS), [0, 1, 2, 3])
        rows = worlds.task.rows
        assert len(set(rows)) == WORLDS
        worlds.reset(np.arange(WORLDS), [3, 2, 1, 0])
        assert worlds.task.rows.tolist() == rows[::-1].tolist()
        worlds.task.fallen = np.ones(WORLDS, bool)
        assert worlds.next_level(0) == round((int(rows[3]) + 0.5) / 149, 9)


def test_what_is_wrong_with_a_clip_is_printed(folder):
    plugin = create("dog-hurries", "bend_30hz.csv", rate=3000.0)
    assert "finding: bend_30hz: faster than the motors: " in plugin.summary


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"motions": ["bend_30hz.csv"]}, "--motion needs --model"),
        (
            {"model": "dog.xml", "motions": ["bend_30hz.csv"], "hand": ["pick"]},
            "--pick and --motion exclude each other",
        ),
        ({"motions": ["bend_30hz.csv"], "walk": True}, "--walk needs --model"),
        ({"model": "dog.xml", "motions": ["bend_30hz.csv"], "link": "head"}, "--motion and --link exclude each other"),
        ({"model": "dog.xml", "walk": True, "clip": ClipOptions(rate=30.0)}, "need --motion"),
        ({"model": "dog.xml", "motions": ["other.csv"]}, "no file other.csv"),
        (
            {"model": "kuka_iiwa.urdf", "motions": ["bend_30hz.csv"]},
            "cannot be free without mass; for an arm leave out",
        ),
    ],
)
def test_options_that_do_not_fit(folder, options, problem):
    with pytest.raises(UsageError, match=problem):
        new.create("dog-refuses", **options)
    assert not (folder / "dog-refuses").exists()


def test_a_model_whose_base_is_fixed(folder):
    write_dog(folder, free="")
    with pytest.raises(
        UsageError, match="its base is fixed, and a clip moves it; add <freejoint/> to the body 'trunk'"
    ):
        create("dog-hangs", "bend_30hz.csv")


@pytest.mark.slow
def test_the_command_line_and_the_plugins_own_tests(folder):
    options = ("--model", "dog.xml", "--motion", "bend_30hz.csv", "--frames", "0:80", "--json", "-")
    content = json.loads(run("rlctl", "tasks", "new", "dog-asks", *options, cwd=folder))
    assert content["target"] == "dog-asks/dog_asks/task.py:DogAsks"
    run("pytest", "-q", "-n", "0", "dog-asks", cwd=folder, path=folder / "dog-asks")


def add_to_joints(folder, attributes: str, more: str = "") -> None:
    """Give all joints of the dog attributes, and its file further sections."""
    defaults = f"<default><joint {attributes}/></default><worldbody>"
    text = (folder / "dog.xml").read_text().replace("<worldbody>", defaults)
    (folder / "dog.xml").write_text(text.replace("</mujoco>", f"{more}</mujoco>"))


def test_what_takes_time_and_is_not_needed_is_left_out(folder):
    sensors = '<sensor><framepos objtype="body" objname="trunk"/></sensor>'
    add_to_joints(folder, 'frictionloss="0.1"', sensors)
    plugin = create("dog-is-fast", "bend_30hz.csv")
    assert "leaves out dry friction of the joints, up to 0.1 N m" in plugin.summary
    assert "The copy of dog.xml has no sensors" in plugin.summary
    cls = EnvSpec(plugin.target).constructor()
    with contextlib.closing(TaskWorlds(cls(), WORLDS)) as worlds:
        assert worlds.task.sim.model.nsensor == 0
        assert not worlds.task.body._sim.world.model("dof_frictionloss").any()


def test_dry_friction_that_motors_notice_is_kept(folder):
    add_to_joints(folder, 'frictionloss="2"')
    plugin = create("dog-creaks", "bend_30hz.csv")
    assert "dry friction" not in plugin.summary
    assert not hasattr(read_task(plugin), "friction")
