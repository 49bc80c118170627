"""`rlctl robot`: a program that is correct scores as its policy does; what goes wrong is counted and named."""

import contextlib
import dataclasses
import socket
import sys
from pathlib import Path

import numpy as np
import pytest

from rlctl.environments.info import describe
from rlctl.environments.spec import UNCHANGED, EnvChanges, EnvSpec
from rlctl.errors import AnswerIsNo, EpisodeFailed, UsageError
from rlctl.evaluation.eval_request import NO_GATES, Gates
from rlctl.limits.limits import Limits
from rlctl_robot.robot import packets
from rlctl_robot.robot.packets import Kind, Packet
from rlctl_robot.robot.report import as_json, describe_failures
from rlctl_robot.robot.robot import run_robot
from rlctl_robot.robot.robot_request import RobotRequest
from rlctl_robot.serve.session import Session, load_served_policy
from tests.exporting import controlled
from tests.play.policies import linear
from tests.robot.robot.programs import Answers, Started, control_by_udp, control_by_websocket
from tests.task import tasks

SLIDER = f"{Path(tasks.__file__)}:Slider"  # 5 steps of 0.1 s; moves by the first element of the action


def play(program, act, *, task=SLIDER, episodes=2, options=None, **request):
    """Let a program control the robot of a task; return the report and what the program was started with."""
    start = Started(program, act, **(options or {}))
    settings = {"port": 0, "episodes": episodes, "timeout_s": 20.0, **request}
    report = run_robot(RobotRequest(task, **settings), start, changes=UNCHANGED, gates=NO_GATES)
    start.join()
    return report


def step_down(values):
    """Move from the start, 1 m, to 0: values are place, steps, 7."""
    return np.array([-0.25 if values[0] > 0.1 else 0.0, 0.0], np.float32)


def answer(request):
    return {"actions": step_down(request["place"])[None], "sequence": request["sequence"]}


@pytest.mark.parametrize(
    ("program", "act", "name"), [(control_by_udp, step_down, "udp 127"), (control_by_websocket, answer, "ws 127")]
)
def test_a_program_in_lock_step(program, act, name):
    report = play(program, act)
    [score] = report.scores
    assert score.outcome.success_rate == 1.0
    # Places 0.75, 0.5, 0.25, 0, 0, each -2 per metre.
    assert [episode.total_reward for episode in score.episodes] == [pytest.approx(-3.0)] * 2
    counts = score.commands
    assert (len(counts.response_s), counts.held, counts.lost, counts.refused, counts.unanswered) == (10, 0, 0, 0, 0)
    assert report.controller.startswith(name)
    report.check(Gates(min_success=1.0))
    with pytest.raises(AnswerIsNo, match=r"^gate missed: mean return -3.000 is below 0$"):
        report.check(Gates(min_return=0.0))


def test_without_success_it_says_how_episodes_ended():
    score = play(control_by_udp, lambda values: np.zeros(2, np.float32)).scores[0]
    assert score.outcome.success_rate == 0
    assert (score.commands.terminated, score.commands.tilted) == (0, None)
    text = describe_failures(score)
    assert text.startswith("no episode succeeded: none ended early; rlctl diagnose LOG searches")
    score.commands.tilted = 1
    assert "the robot was not upright at the end of 1 of 2;" in describe_failures(score)


def write_policy(file, weight, frames=1, task=SLIDER):
    """Write a linear policy of a task; return its file's name."""
    spec = EnvSpec(task, frame_stack=frames)
    with contextlib.closing(spec.make()) as env:
        policy = linear(describe(env), weight, log_std=0.0)
    info = policy.info.model_copy(update={"spec": spec})
    dataclasses.replace(policy, info=info).write(file)
    return str(file)


def test_commands_are_compared_with_the_policy(tmp_path):
    policy = write_policy(tmp_path / "policy.safetensors", [[-0.25, 0, 0], [0, 0, 0.01]])

    def act(values):  # 0.125 more than the policy's first action wherever the place is above 0.5
        return np.array([-0.25 * values[0] + 0.125 * (values[0] > 0.5), 0.07], np.float32)

    report = play(control_by_udp, act, policy=policy)
    first, second = report.scores[0].commands.differences
    places = [1.0, 0.875, 0.78125, 0.7109375, 0.658203125]  # each is 3/4 of the one before plus 0.125: all above 0.5
    assert all(place > 0.5 for place in places)
    assert first.mean == pytest.approx(0.125)
    assert first.largest == pytest.approx(0.125)
    assert (second.name, second.largest) == ("action 1", pytest.approx(0.0, abs=1e-6))
    assert report.scores[0].commands.compared == 10


def test_a_policy_file_is_played_in_its_own_task(tmp_path):
    policy = write_policy(tmp_path / "policy.safetensors", [[-0.25, 0, 0], [0, 0, 0]])
    report = play(control_by_udp, step_down, task=policy)
    assert (report.spec.task, report.policy) == (SLIDER, Path(policy))
    assert report.scores[0].commands.compared == 10
    with pytest.raises(UsageError, match="a policy file; leave out --policy and --pretrained"):
        run_robot(RobotRequest(policy, policy=policy), lambda _: None, changes=UNCHANGED, gates=NO_GATES)


@pytest.mark.slow
def test_a_policy_with_a_stack_of_frames_is_compared_with_single_observations(tmp_path):
    # The place is 1, and from the second step on the older of two frames has one step less than the newer.
    weight = [[0, -0.1, 0, 0, 0, 0], [0, 0, 0, 0, 0.1, 0]]
    policy = write_policy(tmp_path / "policy.safetensors", weight, frames=2)

    def act(values):
        return np.array([-0.1 * max(values[1] - 1, 0), 0.1 * values[1]], np.float32)

    differences = play(control_by_udp, act, policy=policy).scores[0].commands.differences
    assert [difference.largest for difference in differences] == [pytest.approx(0.0, abs=1e-6)] * 2


def test_a_policy_server_answers_what_the_robot_sends(tmp_path):
    policy = write_policy(tmp_path / "policy.safetensors", [[-0.25, 0, 0], [0, 0, 0.01]])
    served = load_served_policy(Path(policy))
    session = Session(1, lambda: served, Limits(watchdog_periods=0))
    resets = []

    def act(request):
        resets.append(request.get("reset", False))
        return session.answer(request)

    counts = play(control_by_websocket, act, policy=policy).scores[0].commands
    assert (counts.compared, counts.refused, counts.held) == (10, 0, 0)
    assert max(difference.largest for difference in counts.differences) == 0.0
    assert resets == [True, False, False, False, False] * 2


def test_a_delay_of_the_commands():
    # 0.2 s are two steps: the place stays 1, 1 and then is 0.75, 0.5, 0.25, for which the program knew 1, 1, 0.75.
    report = play(control_by_udp, step_down, fault=["delay=0.2"])
    late = report.scores[1]
    assert [episode.total_reward for episode in late.episodes] == [pytest.approx(-2 * (1 + 1 + 0.75 + 0.5 + 0.25))] * 2
    assert late.commands.held == 2 * 2
    assert late.outcome.success_rate == 0.0
    with pytest.raises(AnswerIsNo, match=r"^gate missed: success rate 0.000 is below 0.5 with delay=0.2$"):
        report.check(Gates(min_success=0.5))


CART = f"{Path(controlled.__file__)}:Cart"  # 120 steps of 0.1 s; two joints, an action steps by 0.05


def test_a_controller_gets_what_is_measured_and_sends_targets(tmp_path):
    # Inputs: places (2), goal (2). The policy observes places three times, goal - places, last action.
    weight = np.zeros((2, 10))
    weight[:, 6:8] = 10 * np.eye(2)  # by the vector to the goal
    weight[:, 8:] = 0.25 * np.eye(2)
    policy = write_policy(tmp_path / "policy.safetensors", weight.tolist(), task=CART)
    seen, last = [], [np.zeros(2)]

    def act(packet):
        if packet.step == 0:
            last[0] = np.zeros(2)
        places, goal = packet.values[:2], packet.values[2:]
        last[0] = np.clip(10 * (goal - places) + 0.25 * last[0], -1, 1)
        seen.append((packet.kind, packet.time_s, packet.age_s, *packet.values))
        return np.clip(places + 0.05 * last[0], -2, 2).astype(np.float32)

    report = play(control_by_udp, act, task=CART, episodes=1, policy=policy, controller=True, fault=["delay=0.2"],
                  options={"reads": "packets"})  # fmt: skip
    healthy, late = report.scores
    assert report.command == "joint position [m]"
    assert (healthy.outcome.success_rate, healthy.commands.held) == (1.0, 0)
    assert (healthy.commands.compared, late.commands.compared) == (120, 120)
    for score in report.scores:
        assert max(difference.largest for difference in score.commands.differences) < 1e-6
    assert seen[1][:3] == (Kind.MEASUREMENT, pytest.approx(0.1), 0.0)
    assert {row[2] for row in seen[120:]} == {0.2}
    # A target stays where it is: the joint stands while late commands have not come. One step moves it by 0.05.
    places = np.array(seen)[:, 3]
    assert places[:120][1] - places[0] == pytest.approx(0.05 * np.sign(places[1] - places[0]), abs=1e-6)
    assert places[120] == places[121] == places[122] != places[123]


@pytest.mark.slow
def test_a_controller_that_commands_nothing():
    report = play(control_by_udp, lambda packet: Kind.NO_COMMAND, task=CART, episodes=1, controller=True,
                  options={"reads": "packets"})  # fmt: skip
    counts = report.scores[0].commands
    assert (counts.held, counts.refused, len(counts.response_s)) == (120, 0, 120)


def test_udp_needs_no_package_for_websockets(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rlctl_robot.robot.websocket", None)
    monkeypatch.setitem(sys.modules, "aiohttp", None)
    report = play(control_by_udp, step_down)
    assert report.scores[0].outcome.success_rate == 1.0
    assert capsys.readouterr().err.splitlines()[0].startswith("only UDP: a WebSocket needs ")
    request = RobotRequest("CartPole-v1", port=0, episodes=1)
    with pytest.raises(UsageError, match=r"^a WebSocket needs .*: pip install .rlctl.serve..; images and discrete"):
        run_robot(request, lambda addresses: None, changes=UNCHANGED, gates=NO_GATES)


def test_faults_repeat_with_the_seed():
    reports = [play(control_by_udp, step_down, fault=["drop=0.4,jitter=0.3"], seed=seed) for seed in (3, 3, 4)]
    returns = [[episode.total_reward for episode in report.scores[1].episodes] for report in reports]
    assert returns[0] == returns[1] != returns[2]
    assert reports[0].scores[1].commands.lost == reports[1].scores[1].commands.lost > 0


@pytest.mark.slow
def test_sensors_that_freeze_or_fail():
    seen = []

    def act(values):
        seen.append(values.copy())
        return np.zeros(2, np.float32)

    play(control_by_udp, act, episodes=3, fault=["frozen=counters", "nan=place"])
    healthy, frozen, failed = np.split(np.array(seen), 3)
    assert healthy[:, 1].tolist() == [0, 1, 2, 3, 4] * 3
    for steps in np.split(frozen[:, 1], 3):
        begin = int(steps[-1])
        assert steps.tolist() == np.minimum(np.arange(5), begin).tolist()
    for places in np.split(failed[:, 0], 3):
        bad = np.isnan(places)
        assert bad[-1]
        assert (np.diff(bad.astype(int)) >= 0).all()  # once it fails, it stays so


@pytest.mark.slow_except(first=1)
@pytest.mark.parametrize(
    ("action", "problem"),
    [
        ([np.nan, 0.0], "the action is not finite: [nan, 0.0]"),
        ([0.0, 0.0, 0.0], "[0.0, 0.0, 0.0] is not an action of 2 numbers"),
        ({"left": 1}, "{'left': 1} is not an action of 2 numbers"),
    ],
)
def test_what_is_no_action_is_refused_and_the_last_one_acts(action, problem):
    actions = iter([[-0.25, 0.0], action, [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    report = play(control_by_websocket, lambda request: {"actions": next(actions)}, episodes=1)
    counts = report.scores[0].commands
    assert (counts.refused, counts.first_problem, counts.held) == (1, problem, 1)
    # -0.25 twice: 0.75, then 0.5 four times.
    assert report.scores[0].episodes[0].total_reward == pytest.approx(-2 * (0.75 + 4 * 0.5))


def test_discrete_actions_have_no_udp():
    start = Started(control_by_websocket, lambda request: {"actions": [request["sequence"] % 3]})
    request = RobotRequest("CartPole-v1", port=0, episodes=1)
    counts = run_robot(request, start, changes=UNCHANGED, gates=NO_GATES).scores[0].commands
    start.join()
    assert [address[:5] for address in start.addresses] == ["ws://"]
    assert counts.first_problem == "2 is not in Discrete(2)"
    assert counts.refused == len(counts.response_s) // 3  # every third


def test_actions_beyond_their_bounds_are_clipped():
    report = play(control_by_udp, lambda values: np.array([-3.0, 0.0], np.float32), episodes=1)
    # -1 each time: places 0, -1, -2, -3, -4.
    assert report.scores[0].episodes[0].total_reward == pytest.approx(-20.0)


@pytest.mark.slow
def test_a_program_that_answers_twice_or_not_at_all():
    report = play(control_by_udp, step_down, options={"repeats": 2})
    assert report.scores[0].commands.held == 0
    assert len(report.scores[0].commands.response_s) == 10
    report = play(control_by_udp, lambda values: None, timeout_s=0.3)
    assert report.problem == "the program has sent nothing for 0.3 s, in episode 0, step 0"


def test_a_program_that_disconnects():
    def leave(port):
        with contextlib.closing(Answers(f"ws://127.0.0.1:{port}")) as client:
            for _ in range(3):
                client.ask({"actions": [[0.0, 0.0]]})

    start = Started(leave)
    report = run_robot(RobotRequest(SLIDER, port=0, fault=["drop=0"]), start, changes=UNCHANGED, gates=NO_GATES)
    start.join()
    with pytest.raises(AnswerIsNo, match=r"^the program has disconnected in episode 0, step \d$"):
        report.check(NO_GATES)
    assert report.scores == []
    assert as_json(report)["problem"] == report.problem


def test_real_time():
    def act(values):
        return None if values[1] == 2 else step_down(values)  # the third command never comes

    report = play(control_by_udp, act, realtime=True)
    [score] = report.scores
    assert score.seconds >= 2 * 0.5
    assert score.commands.unanswered >= 2
    # Without the third command the second acts again, so nothing changes; on a busy machine others may be late too.
    assert score.commands.held >= 2
    assert len(score.commands.robot_late_s) == 10


@pytest.mark.slow
def test_a_program_that_goes_away_in_real_time():
    answers = iter([step_down] * 7)  # it is gone in the second episode, whose 0.5 s are shorter than the timeout
    report = play(control_by_udp, lambda values: next(answers, lambda values: None)(values), episodes=9, realtime=True,
                  timeout_s=0.7)  # fmt: skip
    with pytest.raises(AnswerIsNo, match=r"^the program has sent nothing for 0.7 s, in episode [23], step \d$"):
        report.check(NO_GATES)


@pytest.mark.slow
def test_a_simulation_that_is_slower_than_the_clock():
    report = play(
        control_by_udp, step_down, task=f"{Path(__file__).with_name('slow.py')}:SlowSlider", episodes=1, realtime=True
    )
    counts = report.scores[0].commands
    assert (len(counts.response_s), counts.unanswered) == (5, 0)  # the program has time to answer nevertheless
    assert min(counts.robot_late_s[1:]) > 0.1


def test_a_task_that_fails_names_the_episode():
    start, request = Started(control_by_udp, step_down), RobotRequest(SLIDER, port=0)
    with pytest.raises(EpisodeFailed, match=r"reward term 'effort' is nan at step 3\nin environment 0, episode seed"):
        run_robot(request, start, changes=EnvChanges({"fault": "nan term"}), gates=NO_GATES)


def test_who_may_control_it(tmp_path):
    key = tmp_path / "key"
    key.write_text("secret\n")
    report = play(control_by_udp, step_down, options={"key": b"secret"}, key_file=key)
    assert report.scores[0].outcome.success_rate == 1.0

    def knock(port):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.sendto(packets.pack(Packet(Kind.HELLO, key=b"wrong")), ("127.0.0.1", port))

    start, request = Started(knock), RobotRequest(SLIDER, port=0, timeout_s=0.3, key_file=key)
    with pytest.raises(AnswerIsNo, match=r"^no program has connected for 0.3 s; 1 UDP packets were refused; --timeo"):
        run_robot(request, start, changes=UNCHANGED, gates=NO_GATES)
    start.join()


@pytest.mark.slow
def test_clients_that_are_none_do_not_lock_a_program_out():
    def control(port, act):
        with contextlib.ExitStack() as stack:
            idle = [stack.enter_context(socket.create_connection(("127.0.0.1", port))) for _ in range(100)]
            first = idle[0]
            first.settimeout(10)
            assert first.recv(1) == b""  # it has given its place to a later one
            request = f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\r\n"
            idle[-1].settimeout(10)
            idle[-1].sendall(request.encode())  # a handshake without its key
            assert idle[-1].recv(12) == b"HTTP/1.1 400"
            return control_by_websocket(port, act)

    report = play(control, answer)
    assert report.scores[0].outcome.success_rate == 1.0
