"""`set_motors`: what a real motor does, on a pendulum and on a wheel whose answers are known by hand."""

from contextlib import closing
from dataclasses import dataclass, replace

import numpy as np
import pytest

from rlctl.engine import MUJOCO
from rlctl.errors import TaskError, UsageError
from rlctl.task import BatchTask, Box, Event, events
from rlctl.task.events import EventSettings
from rlctl.task.motors import Motor
from rlctl.task.mujoco.sim import MujocoSim
from rlctl.task.named_motors import TABLE, find_motor
from rlctl.task.pybullet.sim import PybulletSim
from rlctl.task.worlds import TaskWorlds
from rlctl_locomotion.walk import Walk

pytest.importorskip("mujoco")
GRAVITY = 9.81
PENDULUM = """
<mujoco>
  <worldbody>
    <body name="base">
      <geom type="sphere" size="0.01" mass="1"/>
      <body name="rod">
        <joint name="hinge" axis="0 1 0"/>
        <geom type="sphere" size="0.01" pos="0.2 0 0" mass="0.5"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
WEIGHT = 0.5 * GRAVITY * 0.2  # [N m], of the rod where it is level: 0.981
SERVO = Motor(
    stiffness_nm_per_rad=20.0,
    regulates="voltage",
    torque_constant_nm_per_a=0.5,
    resistance_ohm=2.0,
    voltage_v=12.0,
    armature_kgm2=0.01,
)
IDEAL = Motor(stiffness_nm_per_rad=50.0, damping_nms_per_rad=1.0, max_torque_nm=30.0, armature_kgm2=0.01)
DT = 0.005  # [s], of a physics step


@pytest.fixture
def pendulum(tmp_path):
    """Return a function that builds a pendulum with a motor, in one world (None) or in many."""
    (tmp_path / "pendulum.xml").write_text(PENDULUM)
    open_worlds = []

    def build(motor, worlds=None, gravity=GRAVITY, **changes):
        sim = MujocoSim(control_dt=0.02, substeps=4, worlds=worlds)
        open_worlds.append(closing(sim))
        sim.set_gravity(gravity)
        body = sim.load("arm", tmp_path / "pendulum.xml", fixed=True)
        body.set_motors(motor, **changes)
        sim.save()
        return sim, body

    yield build
    for world in open_worlds:
        world.__exit__(None, None, None)


def play(sim, body, target, steps):
    """Drive the joint to a target for some control steps; return its positions."""
    rows = []
    for _ in range(steps):
        body.drive_to(np.full_like(body.joint_positions, target))
        sim.step()
        rows.append(body.joint_positions)
    return np.array(rows)


@pytest.mark.parametrize("worlds", [None, 2])
@pytest.mark.parametrize("regulates", ["voltage", "torque"])
def test_a_motor_without_load_turns_at_its_no_load_speed(pendulum, worlds, regulates):
    sim, body = pendulum(replace(SERVO, regulates=regulates), worlds, gravity=0.0)
    play(sim, body, 1000.0, 100)  # so far away that the controller asks for all of its voltage
    assert SERVO.no_load_speed_rad_per_s == 24.0  # 12 V / 0.5 V s/rad
    assert body.joint_velocities == pytest.approx(24.0, rel=1e-3)


def test_friction_makes_it_slower(pendulum):
    sim, body = pendulum(SERVO, gravity=0.0, coulomb_friction_nm=0.3, viscous_friction_nms_per_rad=0.01)
    play(sim, body, 1000.0, 100)
    # 0.5 * (12 - 0.5 w) / 2 = 0.3 + 0.01 w, so 2.7 = 0.135 w
    assert body.joint_velocities == pytest.approx(20.0, rel=0.01)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, 3.0),  # 0.5 N m/A * 12 V / 2 Ohm
        ({"current_limit_a": 4.0}, 2.0),
        ({"max_torque_nm": 1.5}, 1.5),
        ({"gear_ratio": 2.0}, 6.0),
        ({"gear_ratio": 2.0, "current_limit_a": 4.0}, 4.0),
    ],
)
def test_a_motor_that_stalls_gives_its_stall_torque(pendulum, changes, expected):
    sim, body = pendulum(replace(SERVO, armature_kgm2=1e4), gravity=0.0, **changes)
    play(sim, body, 1000.0, 1)
    assert body.joint_torques == pytest.approx(expected, rel=1e-3)
    assert body.motors["hinge"].stall_torque_nm == pytest.approx(expected)
    assert body.describe_joints(["hinge"]).max_torque == pytest.approx((expected,))


@pytest.mark.parametrize("worlds", [None, 2])
@pytest.mark.parametrize(("share", "moves"), [(1.05, False), (0.8, True)])
def test_dry_friction_holds_a_load_below_it(pendulum, worlds, share, moves):
    sim, body = pendulum(replace(IDEAL, stiffness_nm_per_rad=0.0, coulomb_friction_nm=share * WEIGHT), worlds)
    moved = play(sim, body, 0.0, 50)[-1]
    assert (np.abs(moved) > 0.1).all() == moves
    assert moves or (np.abs(moved) < 1e-3).all()  # [rad], in a second


@pytest.mark.parametrize("worlds", [None, 2])
def test_a_link_moves_within_its_play(pendulum, worlds):
    play_rad = 0.05
    sim, body = pendulum(IDEAL, worlds, backlash_rad=play_rad)
    angles = []
    for gravity in (1.0, -1.0):
        sim.shift_gravity((gravity - 1.0) * -GRAVITY)
        settled = play(sim, body, 0.0, 100)[-1]
        turned = body.link_orientation("rod")
        angles.append(2 * np.arctan2(turned[..., 1], turned[..., 3]) - settled)
    assert angles[0] - angles[1] == pytest.approx(play_rad, rel=0.02)


@pytest.mark.parametrize("worlds", [None, 2])
@pytest.mark.parametrize("steps", [0, 1, 3])
def test_a_delay_is_counted_in_physics_steps(pendulum, worlds, steps):
    sim, body = pendulum(IDEAL, worlds, gravity=0.0, delay_s=steps * DT)
    sim.world.substeps = 1
    positions = play(sim, body, 0.3, 6).reshape(6, -1)
    assert (positions[:steps] == 0.0).all()
    assert (positions[steps:] > 0.0).all()


def test_until_the_first_command_arrives_a_motor_holds_its_joint(pendulum):
    sim, body = pendulum(IDEAL, gravity=0.0, delay_s=2 * DT)
    body.set_joints(np.array([1.0]))
    sim.world.substeps = 1
    positions = play(sim, body, 1.2, 4)[:, 0]
    assert positions[:2] == pytest.approx(1.0, abs=1e-9)
    assert positions[3] > 1.001


@pytest.mark.parametrize("worlds", [None, 2])
@pytest.mark.parametrize("changes", [{}, {"integral_nm_per_rads": 50.0}, {"encoder_bias_rad": 0.1}])
def test_without_a_command_a_motor_holds_its_joint_where_it_was_placed(pendulum, worlds, changes):
    sim, body = pendulum(IDEAL, worlds, gravity=0.0, **changes)
    body.set_joints(np.full_like(body.joint_positions, 1.0))
    if worlds is not None:
        body.set_joints(np.array([[0.5]]), worlds=np.array([1]))
    sim.step()
    expected = [1.0] if worlds is None else [1.0, 0.5]
    assert body.joint_positions.ravel() == pytest.approx(expected, abs=1e-9)


def test_an_encoder_bias_shifts_what_is_read_and_what_is_driven_to(pendulum):
    sim, body = pendulum(IDEAL, gravity=0.0, encoder_bias_rad=0.1)
    body.set_joints(np.array([0.5]))
    assert body.joint_positions == pytest.approx(0.5)
    assert sim.data.qpos == pytest.approx(0.4)
    assert play(sim, body, 0.7, 100)[-1] == pytest.approx(0.7, abs=1e-6)
    assert sim.data.qpos == pytest.approx(0.6, abs=1e-6)


def test_an_integral_removes_what_a_load_leaves(pendulum):
    without = play(*pendulum(IDEAL), 0.0, 300)[-1]
    with_integral = play(*pendulum(IDEAL, integral_nm_per_rads=50.0), 0.0, 300)[-1]
    assert without == pytest.approx(WEIGHT / 50.0, rel=0.01)  # [rad], by which its spring gives way
    assert np.abs(with_integral) < 0.01 * without


def test_a_servo_is_weaker_and_slower_with_less_voltage(pendulum):
    sim, body = pendulum(SERVO, gravity=0.0)
    body.set_voltage(6.0)
    play(sim, body, 1000.0, 100)
    assert body.joint_velocities == pytest.approx(12.0, rel=1e-3)
    sim, body = pendulum(SERVO)
    sag = play(sim, body, 0.0, 200)[-1]
    body.set_voltage(6.0)
    assert play(sim, body, 0.0, 200)[-1] == pytest.approx(2 * sag, rel=0.02)


def test_a_weaker_magnet_turns_faster_and_stalls_earlier(pendulum):
    sim, body = pendulum(SERVO, gravity=0.0, current_limit_a=4.0)
    body.scale_torque_constant(0.5)
    body.drive_to(np.array([1000.0]))
    sim.step()
    assert body.joint_torques <= 1.0 + 1e-9  # 0.25 N m/A * 4 A
    play(sim, body, 1000.0, 400)
    assert body.joint_velocities == pytest.approx(48.0, rel=1e-2)


FULL = replace(
    SERVO,
    damping_nms_per_rad=0.1,
    current_limit_a=3.0,
    coulomb_friction_nm=0.1,
    viscous_friction_nms_per_rad=0.02,
    backlash_rad=0.03,
    delay_s=2 * DT,
    encoder_bias_rad=0.02,
)


def change(body, factor):
    """Set everything that events set, in a world."""
    body.set_joint_friction(0.1 * factor)
    body.set_backlash(0.03 * factor)
    body.set_voltage(12.0 * factor)
    body.scale_torque_constant(factor)
    body.set_encoder_bias(0.02 * factor)
    body.set_motor_delay(DT)


def test_one_world_is_a_row_of_a_batch_to_the_bit(pendulum):
    factors = [0.8, 1.0, 1.2]
    targets = np.random.default_rng(0).uniform(-1.0, 1.0, 40)
    together, _ = pendulum(FULL, 3)
    for world, factor in enumerate(factors):
        change(together.one(world).body("arm"), factor)
    rows = [play(together, together.body("arm"), target, 1)[0] for target in targets]
    for world, factor in enumerate(factors):
        sim, body = pendulum(FULL, 1)
        change(sim.one(0).body("arm"), factor)
        alone = [play(sim, body, target, 1)[0, 0] for target in targets]
        assert np.array_equal(np.array(rows)[:, world], alone)


@pytest.mark.parametrize("worlds", [None, 2])
def test_a_motor_has_its_own_inertia_whatever_its_joint_had_before(tmp_path, worlds):
    (tmp_path / "pendulum.xml").write_text(PENDULUM)
    speeds = []
    for armature in (None, 0.05):
        with closing(MujocoSim(control_dt=0.02, substeps=4, worlds=worlds)) as sim:
            body = sim.load("arm", tmp_path / "pendulum.xml", fixed=True)
            if armature is not None:
                body.set_drives(50.0, 1.0, armature=armature)
            body.set_motors(SERVO)
            sim.save()
            body.drive_to(np.full_like(body.joint_positions, 1.0))
            sim.step()
            speeds.append(body.joint_velocities.copy())
    assert speeds[0].min() > 0.1
    assert speeds[0].tolist() == speeds[1].tolist()


@pytest.mark.parametrize("worlds", [None, 3])
def test_a_reset_restores_all(pendulum, worlds):
    sim, body = pendulum(FULL, worlds)
    before = play(sim, body, 0.5, 30)
    change(body if worlds is None else sim.one(1).body("arm"), 1.3)
    play(sim, body, -0.5, 10)
    sim.restore()
    assert np.array_equal(play(sim, body, 0.5, 30), before)


def test_a_reset_of_some_worlds_leaves_the_others(pendulum):
    sim, body = pendulum(FULL, 3)
    play(sim, body, 0.5, 10)
    expected = play(sim, body, -0.5, 10)
    sim.restore()
    play(sim, body, 0.5, 10)
    sim.restore(np.array([1]))
    rows = play(sim, body, -0.5, 10)
    assert np.array_equal(rows[:, [0, 2]], expected[:, [0, 2]])
    assert not np.array_equal(rows[:, 1], expected[:, 1])


def test_pybullet_says_that_it_has_none():
    with closing(PybulletSim(control_dt=0.02, substeps=4)) as sim:
        arm = sim.load("arm", "kuka_iiwa.urdf", fixed=True)
        with pytest.raises(UsageError, match=r"real motors .* are in MuJoCo only: use --sim mujoco"):
            arm.set_motors(IDEAL)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"voltage_v": [6.0, 7.0]}, "voltage_v has 2 values for 1 joints"),
        ({"voltage": 6.0}, "a motor has no value 'voltage'"),
        ({"resistance_ohm": None}, "need each other"),
        ({"voltage_v": None}, "a controller that regulates the voltage needs voltage_v"),
        ({"gear_ratio": 0.0}, "gear_ratio is 0"),
        ({"backlash_rad": -0.1}, "backlash_rad is -0.1; it cannot be negative"),
        ({"delay_s": float("nan")}, "delay_s is nan; give a finite number"),
        ({"backlash_rad": 0.1, "armature_kgm2": None}, "'hinge' has backlash and no armature"),
    ],
)
def test_values_that_cannot_be(pendulum, changes, message):
    with pytest.raises(TaskError, match=message):
        pendulum(SERVO, **changes)


def test_what_a_motor_cannot_do(pendulum):
    _, body = pendulum(SERVO)
    with pytest.raises(TaskError, match="no play that could change; call set_motors"):
        body.set_backlash(0.01)
    with pytest.raises(TaskError, match="set_motors made room for 0 s"):
        body.set_motor_delay(0.01)
    with pytest.raises(TaskError, match="its speed follows from its voltage"):
        body.drive_to(np.zeros(1), max_speed=1.0)


def test_joints_have_the_gain_that_is_written_into_the_servo(pendulum):
    _, body = pendulum("sts3215")
    joints = body.describe_joints(["hinge"])
    assert joints.drive_gain == pytest.approx((32.0,))
    assert joints.drive_voltage == (7.4,)
    # Open Duck Mini writes the same two into its model: 17.8 N m/rad and 3.35 N m.
    assert joints.stiffness == pytest.approx((17.8,), rel=1e-3)
    assert joints.max_torque == pytest.approx((3.35,), rel=1e-3)
    _, weaker = pendulum(find_motor("sts3215").at_gain(16.0))
    assert weaker.describe_joints(["hinge"]).stiffness == pytest.approx((8.9,), rel=1e-3)


def test_a_drive_without_a_gain_of_its_own_has_neither(pendulum):
    _, body = pendulum(SERVO)
    joints = body.describe_joints(["hinge"])
    assert (joints.stiffness, joints.drive_gain, joints.drive_voltage) == ((20.0,), (), ())


def test_a_motor_whose_stiffness_nobody_knows(pendulum):
    with pytest.raises(TaskError, match="motor 'mg90s': its stiffness is unknown; pass stiffness_nm_per_rad="):
        pendulum("mg90s")
    _, body = pendulum("mg90s", stiffness_nm_per_rad=2.0)
    assert body.motors["hinge"].stiffness_nm_per_rad == 2.0


def test_a_name_that_is_not_in_the_table(pendulum):
    with pytest.raises(TaskError, match=r"no motor .sts3251.\. Did you mean .sts3215."):
        pendulum("sts3251")


@pytest.mark.parametrize("name", TABLE)
def test_motors_of_the_table(pendulum, name):
    entry = TABLE[name]
    assert entry.source
    assert entry.unknown
    changes = {} if entry.motor.stiffness_nm_per_rad else {"stiffness_nm_per_rad": 1.0}
    sim, body = pendulum(name, gravity=0.0, armature_kgm2=entry.motor.armature_kgm2 or 0.01, **changes)
    play(sim, body, 1000.0, 150)
    speed = body.motors["hinge"].no_load_speed_rad_per_s
    assert 0.7 * speed < body.joint_velocities[0] < 1.001 * speed  # friction makes it slower


class Pendulums(BatchTask):
    """Pendulums that are told to hold still, with every event of motors."""

    control_dt, substeps, solver_iterations, episode_s = 0.02, 4, 3, 1.0
    action_space = Box(-1.0, 1.0, (1,), np.float32)
    reward_weights = {"nothing": 0.0}
    events = {
        "friction": Event("reset", events.motor_friction, body="arm", coulomb_nm=(0.0, 0.3)),
        "backlash": Event("reset", events.backlash, body="arm", backlash_rad=(0.0, 0.05)),
        "voltage": Event("reset", events.voltage, body="arm", voltage_v=(9.0, 12.0)),
        "constant": Event("reset", events.torque_constant, body="arm", factor=(0.8, 1.2)),
        "bias": Event("reset", events.motor_bias, body="arm", bias_rad=(-0.1, 0.1)),
        "delay": Event("reset", events.motor_delay, body="arm", delay_s=(0.0, 0.01)),
    }
    model = ""

    def build(self, sim):
        self.arm = sim.load("arm", self.model, fixed=True)
        self.arm.set_motors(FULL)

    def reset(self, rng, worlds):
        self.arm.set_joints(np.zeros((len(worlds), 1)), worlds=worlds)

    def act(self, action):
        self.arm.drive_to(action.astype(float))

    def observe(self):
        return {"joints": self.arm.joint_positions}

    def rewards(self, action):
        return {"nothing": np.zeros(self.worlds)}


def test_events_change_each_world_and_the_critic_sees_them(tmp_path):
    (tmp_path / "pendulum.xml").write_text(PENDULUM)
    Pendulums.model = tmp_path / "pendulum.xml"
    worlds = TaskWorlds(Pendulums(), count=3, sim=MUJOCO, events=EventSettings(randomize=True))
    with closing(worlds):
        worlds.show_critic(task=True, events=True)
        rows = worlds.reset(np.arange(3), np.array([1, 2, 3]))
        assert rows.shape[0] == 3
        model = worlds.sim.world
        drawn = worlds.drawn
        for world in range(3):
            assert model.model("dof_frictionloss")[world, 0] == drawn[world]["friction"]["hinge"]
            assert model.model("jnt_range")[world, 1, 1] == pytest.approx(drawn[world]["backlash"]["hinge"] / 2)
            assert model.model("actuator_gainprm")[world, 0, 7] == drawn[world]["voltage"]["voltage_v"]
            assert model.model("actuator_gainprm")[world, 0, 1] == 0.5 * drawn[world]["constant"]["hinge"]
            assert model.model("encoder bias")[world, 0] == drawn[world]["bias"]["hinge"]
        seen = worlds.observe_privileged(np.arange(3))
        assert seen.shape == (3, 6)
        assert np.unique(seen[:, 0]).size == 3


def test_a_delay_that_events_make_longer(pendulum):
    sim, body = pendulum(IDEAL, gravity=0.0, delay_s=2 * DT)
    sim.world.substeps = 1
    body.set_motor_delay(4 * DT)
    positions = play(sim, body, 0.3, 6)[:, 0]
    assert (positions[:4] == 0.0).all()
    assert (positions[4:] > 0.0).all()
    with pytest.raises(TaskError, match=r"set_motors made room for 0.02 s: call set_motors\(.., delay_s=0.03\)"):
        body.set_motor_delay(6 * DT)


def test_motors_by_joint(pendulum):
    _, body = pendulum({"hinge": {"stiffness_nm_per_rad": 5.0, "coulomb_friction_nm": 0.1}}, armature_kgm2=0.02)
    assert body.motors == {"hinge": Motor(stiffness_nm_per_rad=5.0, coulomb_friction_nm=0.1, armature_kgm2=0.02)}
    with pytest.raises(TaskError, match=r"no joint 'hinges'\. Did you mean 'hinge'"):
        pendulum({"hinges": SERVO})
    with pytest.raises(TaskError, match="a motor has no value 'stiffness'"):
        pendulum({"hinge": {"stiffness": 5.0}})
    with pytest.raises(TaskError, match="motors by joint and joints= exclude each other"):
        pendulum({"hinge": SERVO}, joints=["hinge"])


@dataclass
class MotorWalk(Walk):
    """The walking A1 with the torque and speed of its motors, friction, play and delay; its events vary them all."""

    events = {
        "friction": Event("reset", events.motor_friction, body="robot", coulomb_nm=(0.0, 1.0)),
        "backlash": Event("reset", events.backlash, body="robot", backlash_rad=(0.0, 0.05)),
        "voltage": Event("reset", events.voltage, body="robot", voltage_v=(0.6, 1.0)),
        "bias": Event("reset", events.motor_bias, body="robot", bias_rad=(-0.05, 0.05)),
        "delay": Event("reset", events.motor_delay, body="robot", delay_s=(0.0, 0.03)),
    }

    def build(self, sim):
        super().build(sim)
        self.body.set_motors(
            "unitree-a1",
            stiffness_nm_per_rad=35.0,
            damping_nms_per_rad=0.7,
            armature_kgm2=0.01,
            backlash_rad=0.02,
            delay_s=0.03,
        )


def walk(seeds, actions):
    """Return the observations of worlds with these seeds."""
    worlds = TaskWorlds(MotorWalk(), len(seeds), sim=MUJOCO, events=EventSettings(randomize=True))
    with closing(worlds):
        rows = [worlds.reset(np.arange(len(seeds)), seeds)]
        return np.array(rows + [worlds.step(action).observation for action in actions])


def test_a_robot_on_the_ground_is_a_row_of_a_batch_to_the_bit():
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (12, 2, 12)).astype(np.float32)
    together = walk([5, 6], actions)
    for world, seed in enumerate([5, 6]):
        assert np.array_equal(walk([seed], actions[:, world : world + 1])[:, 0], together[:, world])
