"""Logs of a robot with hidden values: identify finds these values, or explains why it cannot."""

import json
from pathlib import Path

import numpy as np
import pytest

from rlctl.environments import registry
from rlctl.environments.spec import EnvSpec
from rlctl.errors import AnswerIsNo, ArtifactError, UsageError
from rlctl.storage import yaml_text
from rlctl.task import Box
from rlctl.task.events import EventSettings
from rlctl_robot.identify.excite import write_excitation
from rlctl_robot.identify.follow import Follower, Parameter, Unknowns, open_world
from rlctl_robot.identify.identify import _estimate_values, identify, show, write_fragment
from rlctl_robot.identify.log import Expected, Log, read_log, write_log
from rlctl_robot.identify.search import Fit, SearchPoint, _choose_starts, _make_trials

ARM = f"{Path(__file__).with_name('arm.py')}:Arm"
SPEC = EnvSpec(ARM)
EXPECTED = Expected({"shoulder": (-2.5, 2.5), "elbow": (-2.5, 2.5)}, ("shoulder", "elbow"), 2, 0.02)
HIDDEN = {"mass": {"factor": 1.25}, "damping": {"factor": 0.7}}


def play(actions, hidden, delay, noise):
    """Return what an arm with hidden values does, measured with noise."""
    env = open_world(SPEC)
    try:
        env.set_events(EventSettings(False, hidden))
        env.reset(seed=0)
        arm, rows = env.sim.body("arm"), []
        for step in range(len(actions)):
            rows.append([arm.joint_positions.copy(), arm.joint_velocities.copy()])
            late = actions[step - delay] if step >= delay else np.zeros(2)
            env.task.act(late.astype(np.float32))
            env.sim.step()
    finally:
        env.close()
    positions, velocities = np.array(rows).transpose(1, 0, 2)
    rng = np.random.default_rng(1)
    return Log(
        EXPECTED.driven,
        actions,
        positions + noise * rng.normal(size=positions.shape),
        velocities + 10 * noise * rng.normal(size=velocities.shape),
    )


@pytest.fixture(scope="module")
def excitation(tmp_path_factory):
    path = tmp_path_factory.mktemp("excite") / "excite.csv"
    return write_excitation(SPEC, path, seconds=4.0, seed=0)


@pytest.fixture(scope="module")
def real(excitation, tmp_path_factory):
    """A log of an arm of another mass, with noise, and a delay of one step."""
    path = tmp_path_factory.mktemp("real") / "real.csv"
    write_log(path, play(read_log(excitation.path, EXPECTED).actions, {"mass": HIDDEN["mass"]}, 1, 0.002), EXPECTED)
    return path


def test_trajectory_stays_in_the_limits(excitation):
    log = read_log(excitation.path, EXPECTED)
    assert np.abs(log.actions).max() <= 1.0
    assert np.abs(log.positions).max() <= 2.0  # 10 % of 5 rad before the ends
    assert np.abs(log.positions).max() > 0.5
    assert np.abs(log.velocities).max() <= 20.0 * 1.05
    assert len(log.actions) == 200
    assert 0 < excitation.largest_share <= 1


def test_trajectories_that_cannot_be(tmp_path, monkeypatch):
    with pytest.raises(UsageError, match=r"--seconds 0\.3: 15 actions of .*; a log needs at least 20"):
        write_excitation(SPEC, tmp_path / "log.csv", seconds=0.3, seed=0)
    monkeypatch.setattr(registry.load(ARM), "action_space", Box(-np.inf, np.inf, (2,), np.float32))
    with pytest.raises(UsageError, match="its actions have no bounds"):
        write_excitation(SPEC, tmp_path / "log.csv", seconds=1.0, seed=0)


@pytest.mark.slow
def test_hidden_values_are_found(real, tmp_path):
    found = identify(SPEC, real, events=["mass", "late"], n_workers=1)
    (mass,) = found.values
    assert mass.known
    assert mass.value == pytest.approx(1.25, rel=0.05)
    assert (found.delay, found.delay_known) == (1, True)
    assert found.position_error[1] < 0.1 * found.position_error[0]
    show(found, str(tmp_path / "found.json"))
    assert json.loads((tmp_path / "found.json").read_text())["events"]["late"] == {"steps": [1, 1]}
    fragment = yaml_text.load(write_fragment(found), "fragment")["events"]
    EnvSpec(ARM, events=fragment).make().close()  # it is a recipe's


@pytest.mark.slow
def test_all_hidden_values_are_found_within_5_percent(tmp_path):
    excited = write_excitation(SPEC, tmp_path / "excite.csv", seconds=10.0, seed=0)
    real = tmp_path / "real.csv"
    write_log(real, play(read_log(excited.path, EXPECTED).actions, HIDDEN, 1, 0.002), EXPECTED)
    found = identify(SPEC, real, events=["mass", "damping", "late"])
    for each in found.values:
        assert each.known
        assert each.value == pytest.approx(HIDDEN[each.event]["factor"], rel=0.05)
        assert each.low < HIDDEN[each.event]["factor"] < each.high
    assert (found.delay, found.delay_known) == (1, True)
    assert found.position_error[1] < 2 * 0.002


@pytest.mark.slow
def test_values_that_the_log_cannot_tell_apart_are_named(real):
    # Torques, masses and dampings times one factor move the arm in the same way.
    found = identify(SPEC, real, events=["mass", "damping", "strength", "late"])
    assert not any(each.known for each in found.values)
    assert found.values[0].note == "this log cannot tell mass.factor from damping.factor and strength.factor"
    assert found.events() == {"late": {"steps": [1, 1]}}


@pytest.mark.slow
def test_a_log_without_information_is_an_error(real, tmp_path):
    # Nothing is touched, so friction leaves no trace.
    with pytest.raises(
        AnswerIsNo, match=r"none of the values: this log contains no information about friction\.friction"
    ):
        identify(SPEC, real, events=["friction"], n_workers=1)
    still = tmp_path / "still.csv"
    write_log(still, Log(EXPECTED.driven, *(np.zeros((40, 2)) for _ in range(3))), EXPECTED)
    with pytest.raises(
        AnswerIsNo, match=r"nothing moves in .*, so it contains no information about mass\.factor, late"
    ):
        identify(SPEC, still, events=["mass", "late"])


@pytest.mark.parametrize(
    ("task", "events", "message"),
    [
        (ARM, ["mas"], r"no event 'mas'\. Did you mean 'mass'\?"),
        (ARM, ["noise"], "noise has no physical value that holds for an episode"),
        ("quadruped", [], "no body with a fixed base has joints"),
        ("Pendulum-v1", [], "plain Gymnasium environment"),
    ],
)
def test_what_cannot_be_identified(task, events, message, tmp_path):
    with pytest.raises(UsageError, match=message):
        identify(EnvSpec(task), tmp_path / "log.csv", events=events)


def edit(path, change):
    rows = [line.split(",") for line in path.read_text().splitlines()]
    change(rows)
    path.write_text("\n".join(",".join(row) for row in rows))


def remove_rows(rows):
    del rows[10:15]


def turn_back(rows):
    rows[10][0] = "0.001"


def write_degrees(rows):
    for row in rows[1:]:
        row[3] = str(float(row[3]) * 180 / np.pi)


def drop_column(rows):
    for row in rows:
        del row[5]


def rename_joint(rows):
    rows[0][3] = "position_sholder"


def write_text(rows):
    rows[7][4] = "off"


def slow_down(rows):
    for index, row in enumerate(rows[1:]):
        row[0] = str(0.002 * index)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (remove_rows, r"line 11: a gap of 0\.12 s"),
        (turn_back, r"line 11: time does not increase: 0\.16 s, then 0\.001 s"),
        (write_degrees, r"position_shoulder reaches .*if the log is in degrees, multiply by pi / 180"),
        (drop_column, "no column 'velocity_shoulder'"),
        (rename_joint, r"no joint 'sholder'\. Did you mean 'shoulder'\?|no column 'position_shoulder'"),
        (write_text, "line 8: position_elbow is 'off', not a finite number"),
        (slow_down, r"a row every 0\.002 s, but the task acts every 0\.02 s"),
        (lambda rows: rows.__delitem__(slice(5, None)), "4 rows; a log needs at least 20"),
        (lambda rows: rows.__delitem__(0), "no column 'time'"),
        (lambda rows: rows[3].pop(), "line 4: 6 values for 7 columns"),
    ],
)
def test_logs_that_cannot_be_used(change, message, real, tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(real.read_text())
    edit(path, change)
    with pytest.raises(ArtifactError, match=message):
        read_log(path, EXPECTED)


def test_semicolons_and_decimal_commas(real, tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(real.read_text().replace(",", ";").replace(".", ","))
    np.testing.assert_array_equal(read_log(path, EXPECTED).positions, read_log(real, EXPECTED).positions)


def test_columns_that_are_not_used_may_hold_anything(real, tmp_path):
    header, *rows = real.read_text().splitlines()
    path = tmp_path / "log.csv"
    path.write_text("\n".join([f"{header},state", *(f"{row},running" for row in rows)]))
    np.testing.assert_array_equal(read_log(path, EXPECTED).actions, read_log(real, EXPECTED).actions)


@pytest.mark.slow
def test_command_line(rlctl, real, tmp_path):
    (tmp_path / "bad.csv").write_text("time\n0\n")
    done = rlctl("identify", ARM, "--log", "bad.csv")
    assert done.returncode == 5
    assert len(done.stderr.splitlines()) == 1
    assert "Traceback" not in done.stderr
    done = rlctl("identify", ARM, "--excite", "out.csv", "--seconds", "2", "--json", "-")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["seconds"] == 2.0
    assert (tmp_path / "out.csv").read_text().startswith("time,action_shoulder,action_elbow,position_shoulder")


@pytest.mark.slow
def test_the_peaks_of_quick_torques_are_not_smoothed():
    actions = np.sign(np.sin(1.3 * np.arange(100)))[:, None] * [1.0, -1.0]
    env = open_world(SPEC)
    errors = Follower(env, play(actions, {}, 0, 0.0), Unknowns(())).compare(None, 0)
    env.close()
    assert np.abs(errors).max() < 1e-6  # the log is of this very world: smoothed states were 0.3 rad/s off


def test_a_value_without_a_trace_is_not_known_in_a_log_without_noise():
    parameters = tuple(Parameter(name, "factor", 0.5, 2.0) for name in ("mass", "friction"))
    errors = np.full(4, 1e-9)
    fit = Fit(np.full(2, 0.5), 0, 1e-12, np.diag([1e4, 0.0]), errors, 50.0)
    mass, friction = _estimate_values(Unknowns(parameters), fit)
    assert mass.known
    assert (friction.known, friction.note) == (False, "this log contains no information about friction.factor")


@pytest.mark.slow
def test_the_built_world_is_tried_first():
    mass = Parameter("mass", "factor", 0.5, 2.0, 1.0)
    unknown = Parameter("friction", "friction", 0.1, 2.0)
    trials = _make_trials(Unknowns((mass, unknown), "late", 1), 0)
    assert trials[:2] == [SearchPoint([pytest.approx(0.5), 0.5], delay) for delay in (0, 1)]
    assert _choose_starts(trials[0], trials[1:])[-1] == trials[0]
