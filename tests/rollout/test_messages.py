"""Messages and answers arrive as they were sent, infinite numbers too."""

import math

import pytest

from rlctl.environments.info import EnvInfo
from rlctl.environments.spec import EnvSpec
from rlctl.policy.file import PolicyInfo
from rlctl.policy.players.player import Exploration
from rlctl.rollout import messages

ENV = EnvInfo(observation_space={"type": "Discrete", "n": 2}, action_space={}, control_dt=math.inf)
SPEC = EnvSpec("reach", {"limit": math.inf, "name": "x"}, named_by="run")
EXPLORATION = Exploration(stochastic=True, epsilon=0.5)


@pytest.mark.parametrize(
    "message",
    [
        messages.Build(SPEC),
        messages.SetEvents(SPEC, {"every_s": 0.5}),
        messages.Attach(40),
        messages.BeginEpisodes({0: (2**31 - 1, bytes(range(256)))}, may_fail=True),
        messages.LoadPolicy(
            PolicyInfo(algo="ppo", policy="MlpPolicy", env=ENV, spec=EnvSpec("reach")), [("a", [2, 3], "float32")]
        ),
        messages.LoadPolicy(other="zero"),
        messages.LimitActions({"low": [-math.inf]}),
        messages.Play(40, {0: -1, 3: 7}, {0: 5}, run_seed=3, exploration=EXPLORATION),
        messages.ComputeRewards(b"\xff\n"),
    ],
    ids=lambda message: type(message).__name__,
)
def test_messages(message):
    assert messages.decode(messages.encode(message)) == message


@pytest.mark.parametrize(
    "answer",
    [
        messages.Answer(),
        messages.Answer(info=ENV, left=[1], rewards=[0.5, -1.0]),
        messages.Answer(ended=[messages.EpisodeResult(1, 2, -math.inf, 3, None, {"x": 1.0}, None, 4, {"calls": 2})]),
        messages.Answer(failure=messages.Failure("no", "TaskError", "Traceback", (1, 2, 3))),
    ],
)
def test_answers(answer):
    received = messages.decode(messages.encode(answer))
    assert received == answer
    assert [(each.row, each.report) for each in received.ended] == [(each.row, each.report) for each in answer.ended]
