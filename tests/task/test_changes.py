"""What events change: read back from PyBullet, always around nominal, and gone with the episode."""

import numpy as np
import pytest

from rlctl.task import Box, Event, Sim, Task, events
from rlctl.task.env import TaskEnv
from rlctl.task.events import EventSettings
from rlctl.task.pybullet.library import pybullet
from rlctl_manipulation.reach import Reach

pytestmark = pytest.mark.pybullet


class Arm(Task):
    """An arm that holds still above a cube, with every kind of change."""

    control_dt, substeps, episode_s = 1 / 60, 4, 1.0
    action_space = Box(-1.0, 1.0, (7,), np.float32)
    reward_weights = {"nothing": 0.0}
    events = {
        "mass": Event("reset", events.scale_mass, body="arm", factor=(0.8, 1.2), links=["lbr_iiwa_link_7"]),
        "friction": Event("reset", events.set_friction, body="plane", friction=(0.3, 1.5)),
        "gravity": Event("reset", events.shift_gravity, change=(-0.5, 0.5)),
        "damping": Event("reset", events.scale_joint_damping, body="arm", factor=(0.5, 1.5)),
        "stiff": Event("reset", events.set_joint_damping, body="arm", damping=(0.1, 0.2), joints=["lbr_iiwa_joint_1"]),
        "color": Event("reset", events.set_color, body="cube", red=(0.2, 0.9), green=(0.2, 0.9), blue=(0.2, 0.9)),
        "motors": Event("reset", events.scale_motor_strength, body="arm", factor=(0.7, 1.0)),
        "start": Event("start", events.offset_joints, body="arm", position=(-0.1, 0.1), velocity=(-0.2, 0.2)),
        "push": Event("interval", events.push, every_s=0.5, body="cube", force=(1.0, 2.0), duration_s=0.05),
        "kick": Event("interval", events.kick, every_s=0.5, body="cube", speed=(0.5, 1.0)),
    }

    def build(self, sim: Sim) -> None:
        sim.load("plane", "plane.urdf", fixed=True)
        self.arm = sim.load("arm", "kuka_iiwa.urdf", fixed=True)
        self.cube = sim.load("cube", "cube_small.urdf", position=(1.0, 1.0, 0.5), inertia="shape")

    def reset(self, rng):
        self.arm.set_joints(np.full(7, 0.5))

    def act(self, action):
        arm = self.arm
        arm.drive_to(np.full(7, 0.5), max_speed=[1.0] * 7, max_force=arm.joint_max_force.tolist())

    def observe(self):
        return {"joints": self.arm.joint_positions}

    def rewards(self, action):
        return {"nothing": 0.0}


class Read:
    """Values of a world as PyBullet reports them."""

    def __init__(self, env):
        self.client, self.task = env.sim.client, env.task

    def dynamics(self, body, link=-1):
        return pybullet.getDynamicsInfo(body.id, link, physicsClientId=self.client)

    @property
    def hand_mass(self):
        return self.dynamics(self.task.arm, 6)[0]

    @property
    def friction(self):
        return self.dynamics(self.task.sim.body("plane"))[1]

    @property
    def gravity(self):
        return pybullet.getPhysicsEngineParameters(physicsClientId=self.client)["gravityAccelerationZ"]

    @property
    def damping(self):
        pybullet.syncBodyInfo(physicsClientId=self.client)  # else it reports what was loaded
        return [pybullet.getJointInfo(self.task.arm.id, i, physicsClientId=self.client)[6] for i in range(7)]

    @property
    def color(self):
        return pybullet.getVisualShapeData(self.task.cube.id, physicsClientId=self.client)[0][7]

    @property
    def joints(self):
        return [pybullet.getJointState(self.task.arm.id, i, physicsClientId=self.client)[:2] for i in range(7)]

    @property
    def everything(self):
        return self.hand_mass, self.friction, self.gravity, self.damping, self.color, self.task.arm.motor_strength


@pytest.mark.slow
def test_a_thousand_resets_stay_around_nominal(make):
    env = make(Arm(), randomize=True)
    read = Read(env)
    hand, joint_damping = read.hand_mass, read.damping
    assert (hand, joint_damping, read.friction) == (0.3, [0.5] * 7, 1.0)
    seen = []
    for seed in range(1000):
        drawn = env.reset(seed=seed)[1]["events"]
        assert read.hand_mass == pytest.approx(hand * drawn["mass"]["factor"])
        assert read.friction == pytest.approx(drawn["friction"]["friction"])
        assert read.gravity == pytest.approx(-9.81 + drawn["gravity"]["change"])
        # "stiff" comes after "damping" and sets the first joint
        stiff, factor = drawn["stiff"]["damping"], drawn["damping"]["factor"]
        assert read.damping == pytest.approx([stiff, *[0.5 * factor] * 6])
        assert read.color == pytest.approx([*drawn["color"].values(), 1.0])
        assert list(env.task.arm.motor_strength) == [drawn["motors"]["factor"]] * 7
        offsets = list(drawn["start"].values())
        assert read.joints == [
            pytest.approx(pair) for pair in zip(0.5 + np.array(offsets[:7]), offsets[7:], strict=True)
        ]
        seen.append([read.hand_mass / hand, read.friction, read.gravity, read.damping[1], read.color[0], *offsets])
    low, high = np.min(seen, axis=0), np.max(seen, axis=0)
    wanted_low = np.array([0.8, 0.3, -10.31, 0.25, 0.2, *[-0.1] * 7, *[-0.2] * 7])
    wanted_high = np.array([1.2, 1.5, -9.31, 0.75, 0.9, *[0.1] * 7, *[0.2] * 7])
    # Inside the ranges, and of a thousand draws some are in the first and the last hundredth of them.
    width = wanted_high - wanted_low
    assert (low >= wanted_low - 1e-6).all()
    assert (high <= wanted_high + 1e-6).all()
    assert (low < wanted_low + 0.01 * width).all()
    assert (high > wanted_high - 0.01 * width).all()


@pytest.mark.parametrize("when", ["reset", "start", "interval"])
def test_everything_ends_with_the_episode(when):
    class Once(Arm):
        events = {
            name: Event(when, event.function, every_s=1 / 60, **event.parameters)
            for name, event in Arm.events.items()
            if name not in ("start", "push", "kick")
        }

    env = TaskEnv(Once(), events=EventSettings(randomize=True))
    plain = TaskEnv(Arm())
    read, nominal = Read(env), Read(plain).everything
    assert read.everything == nominal  # it has tried its events out, and put the world back
    for seed in range(3):
        env.reset(seed=seed)
        env.step(np.zeros(7))
        assert all(now != built for now, built in zip(read.everything, nominal, strict=True) if built is not None)
        env.sim.restore()
        assert read.everything == nominal
    env.close()
    plain.close()


def test_a_part_of_the_links_and_joints(make):
    env = make(Arm(), mass={"factor": 2.0}, stiff={"damping": 3.0})
    read = Read(env)
    other = read.dynamics(env.task.arm, 5)[0]
    env.reset(seed=0)
    assert read.hand_mass == pytest.approx(0.6)
    assert read.dynamics(env.task.arm, 5)[0] == other
    assert read.damping == [3.0, *[0.5] * 6]


def test_weak_motors_give_a_part_of_their_torque(make):
    def torque(**changes):
        env = make(Arm(), **changes)
        env.reset(seed=0)
        env.task.arm.drive_to(np.full(7, 0.6), max_speed=[1.0] * 7, max_force=[4.0] * 7)
        env.sim.step()
        states = pybullet.getJointStates(env.task.arm.id, range(7), physicsClientId=env.sim.client)
        return np.abs([state[3] for state in states])

    # 4 N m are too little to move the first three joints so far, so these give all they have. PyBullet reports the
    # motor's impulse of a substep over the time of the step, with 4 substeps: 1 and 0.5 N m.
    np.testing.assert_allclose(torque()[:3], 1.0)
    np.testing.assert_allclose(torque(motors={"factor": 0.5})[:3], 0.5)


def test_a_push_changes_momentum_by_force_times_time(make):
    env = make(Arm(), push={"force": 1.5, "duration_s": 0.05, "every_s": 0.1})
    env.reset(seed=0)
    cube = env.task.cube
    velocities = []
    for step in range(1, 13):
        info = env.step(np.zeros(7))[4]
        if step == 6:
            drawn = info["events"]["push"]
        velocities.append(pybullet.getBaseVelocity(cube.id, physicsClientId=cube.client)[0])
    # At 0.1 s = step 6; 0.05 s at 60 Hz: in steps 7, 8, 9. 1.5 N x 0.05 s / 0.1 kg = 0.75 m/s
    mass = pybullet.getDynamicsInfo(cube.id, -1, physicsClientId=cube.client)[0]
    assert drawn["force"] == 1.5
    direction = np.array([np.cos(drawn["direction"]), np.sin(drawn["direction"])])
    change = np.array(velocities)[:, :2] @ direction
    assert change[5] == pytest.approx(0.0, abs=1e-9)
    for step, part in [(7, 1 / 3), (8, 2 / 3), (9, 1.0), (10, 1.0)]:
        # PyBullet damps linear velocity by 4 % a second
        assert change[step - 1] == pytest.approx(part * 1.5 * 0.05 / mass, rel=5e-3)


def test_a_push_ends_with_the_episode(make):
    env = make(Arm(), push={"force": 5.0, "duration_s": 10.0, "every_s": 0.1})
    for seed in (0, 1):
        env.reset(seed=seed)
        for _ in range(5):
            env.step(np.zeros(7))
        assert np.hypot(*pybullet.getBaseVelocity(env.task.cube.id, physicsClientId=env.sim.client)[0][:2]) < 1e-9
        env.step(np.zeros(7))
        env.step(np.zeros(7))
        assert np.hypot(*pybullet.getBaseVelocity(env.task.cube.id, physicsClientId=env.sim.client)[0][:2]) > 0.1


def test_a_kick_changes_the_velocity_at_once(make):
    env = make(Arm(), kick={"speed": 0.8, "every_s": 1 / 60})
    env.reset(seed=0)
    env.step(np.zeros(7))
    velocity = pybullet.getBaseVelocity(env.task.cube.id, physicsClientId=env.sim.client)[0]
    assert np.hypot(velocity[0], velocity[1]) == pytest.approx(0.8)


def test_offsets_stay_inside_the_joint_limits(make):
    env = make(Arm(), start={"position": 9.0})
    env.reset(seed=0)
    np.testing.assert_allclose(env.task.arm.joint_positions, env.task.arm.joint_high)


@pytest.mark.slow
def test_reach_with_all_of_its_events_repeats(make):
    def episode(env, seed):
        observation, info = env.reset(seed=seed)
        assert set(info["events"]) == set(Reach.events)
        rng = np.random.default_rng(seed)
        down = np.array([0.0, 1.0, 0.0, -1.0, 0.0, 1.0, 0.0])  # along the plane: with contacts
        rows = [np.append(observation, 0.0)]
        for _ in range(env.max_steps):
            observation, reward, *_ = env.step(down + rng.uniform(-1, 1, 7))
            rows.append(np.append(observation, reward))
        return np.array(rows)

    used = make(Reach(), randomize=True)
    for seed in range(5):
        episode(used, 100 + seed)
        np.testing.assert_array_equal(episode(used, seed), episode(make(Reach(), randomize=True), seed))
    assert make(Reach()).reset(seed=0)[1] == {}


class SoftGround(Task):
    """A cube of 1 kg lies on ground of 2,000 N/m."""

    control_dt, substeps, episode_s = 1 / 60, 4, 2.0
    action_space = Box(-1.0, 1.0, (1,), np.float32)
    reward_weights = {"nothing": 0.0}
    events = {"soft": Event("reset", events.set_contact_stiffness, body="plane", stiffness=(2e3, 2e3))}

    def build(self, sim: Sim) -> None:
        sim.load("plane", "plane.urdf", fixed=True)
        self.cube = sim.load("cube", "cube_small.urdf", position=(0.0, 0.0, 0.03), inertia="shape")
        self.cube.scale_mass(1.0 / self.cube.total_mass())

    def reset(self, rng):
        pass

    def act(self, action):
        pass

    def observe(self):
        return {"height": self.cube.base_position[2:]}

    def rewards(self, action):
        return {"nothing": 0.0}


def test_a_soft_ground_is_a_spring_until_the_next_reset(make):
    soft, plain = make(SoftGround(), randomize=True), make(SoftGround())
    resting = []
    for env in (soft, plain):
        env.reset(seed=0)
        for _ in range(120):
            height = env.step(np.zeros(1))[0][0]
        resting.append(height)
    # 1 kg on four corners of 2,000 N/m: 9.81 / 8000 = 1.2 mm
    assert resting[1] - resting[0] == pytest.approx(9.81 / 8000, rel=0.05)
    soft.sim.restore()
    for _ in range(120):
        soft.sim.step()
    assert soft.task.cube.base_position[2] == pytest.approx(resting[1], abs=1e-5)


def test_stiffness_is_drawn_evenly_in_its_logarithm(make):
    env = make(SoftGround(), soft={"stiffness": [1e3, 1e5]})
    drawn = [env.reset(seed=seed)[1]["events"]["soft"]["stiffness"] for seed in range(200)]
    assert 1e3 <= min(drawn) < 1.2e3 < 8e4 < max(drawn) <= 1e5
    assert np.mean(np.array(drawn) < 1e4) == pytest.approx(0.5, abs=0.1)
