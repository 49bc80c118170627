"""Messages arrive as they were sent, and only plain data is read from what a child process writes."""

import collections
import dataclasses
import enum
import fractions
import math
import pickle
import sys

import numpy as np
import pytest

from rlctl.checking.records import Fact, Series
from rlctl.checking.rule import RuleFinding, Severity
from rlctl.checking.rule_index import RULES
from rlctl.environments.info import EnvInfo
from rlctl.environments.spec import EnvSpec
from rlctl.play import messages
from rlctl.policy.file import PolicyInfo
from rlctl.processes import messages as process_messages
from rlctl.processes.messages import UnreadableMessageError, decode, encode
from rlctl.processes.pool import WorkerException

ENV = EnvInfo(observation_space={"type": "Discrete", "n": 2}, action_space={}, control_dt=math.inf)
SPEC = EnvSpec("reach", {"limit": math.inf, "range": (0.5, 1)}, named_by="run")


@pytest.mark.parametrize(
    "message",
    [
        messages.SetEvents(SPEC, {"every_s": 0.5}),
        messages.LoadPolicy(
            PolicyInfo(algo="ppo", policy="MlpPolicy", env=ENV, spec=EnvSpec("reach")), [("a", (2, 3), "float32")]
        ),
        messages.Play(40, {0: -1, 3: 7}, {0: 5}, run_seed=3),
        messages.Answer(ended=[messages.EpisodeResult(1, 2, -math.inf, 3, None, {"x": 1.0}, None, 4, {"calls": 2})]),
        RuleFinding(RULES["RL001"], "message", severity=Severity.INFO),
        WorkerException("caf\udce9", "TaskError", "Traceback", (1, 2, 3)),
    ],
    ids=lambda message: type(message).__name__,
)
def test_messages_arrive_as_they_were_sent(message):
    received = decode(encode(message))
    assert received == message
    assert vars(received).keys() == vars(message).keys()


@pytest.mark.parametrize(
    "array",
    [
        np.zeros((3, 2), np.float32),
        np.array(True),
        np.zeros((0, 4), np.int64),
        np.asfortranarray(np.arange(6.0).reshape(2, 3))[:, ::2],
        np.zeros(2, [("x", np.float32), ("y", "U3")]),
        np.ma.masked_array([1.0, 2.0]),
    ],
    ids=lambda array: f"{type(array).__name__} {array.dtype} {array.shape}",
)
def test_arrays_arrive_as_they_were_sent(array):
    received = decode(encode(Fact("numbers", {1: Series(np.arange(3), array)}))).value[1].values
    assert (type(received), received.dtype, received.shape) == (np.ndarray, array.dtype, array.shape)
    np.testing.assert_array_equal(received, array)
    received[...] = received  # it can be written


class Name(enum.StrEnum):
    """A text of a plugin's own class."""

    ARM = "arm"


Pair = collections.namedtuple("Pair", "x y")


@pytest.mark.parametrize(
    ("sent", "received"),
    [
        (Name.ARM, "arm"),
        (np.float64(0.5), 0.5),
        (np.int32(3), 3),
        (np.bool_(True), True),
        (Pair(1, 2), (1, 2)),
        (collections.OrderedDict(a=1), {"a": 1}),
    ],
    ids=repr,
)
def test_numbers_and_texts_of_other_classes_arrive_as_built_in_ones(sent, received):
    answer = decode(encode([sent]))[0]
    assert answer == received
    assert type(answer) is type(received)


def test_what_is_not_plain_data_is_not_sent():
    with pytest.raises(TypeError, match=r"fractions\.Fraction cannot be sent: it is not plain data"):
        encode(fractions.Fraction(1, 2))


class Call:
    """What hostile bytes name: a function and its arguments."""

    def __init__(self, function, *arguments):
        self.called = function, arguments

    def __reduce__(self):
        return self.called


@pytest.mark.parametrize(
    "content",
    [
        pickle.dumps(Call(sys.exit, 3)),
        pickle.dumps(Call(eval, "1 / 0")),
        pickle.dumps(Call(encode, 1)),  # a function of rlctl
        pickle.dumps(fractions.Fraction(1, 2)),
        b"\x80\x05crlctl.errors\nsys.exit\n.",
        b"cthis\ns\n.",  # the module would print a poem
        b"step 7\n",
        b"",
    ],
)
def test_nothing_but_plain_data_is_read(content, capsys):
    with pytest.raises(UnreadableMessageError, match="not a message of rlctl"):
        decode(content)
    assert capsys.readouterr().out == ""


@dataclasses.dataclass(frozen=True)
class Question:
    value: float


def test_dataclasses_of_a_package_are_sent_if_it_is_trusted(monkeypatch):
    monkeypatch.setattr(process_messages, "_packages", {"rlctl"})
    with pytest.raises(TypeError, match=r"Question cannot be sent: it is not plain data"):
        encode(Question(2.0))
    process_messages.trust_package("tests")
    content = encode(Question(2.0))
    assert decode(content) == Question(2.0)
    monkeypatch.setattr(process_messages, "_packages", {"rlctl"})
    with pytest.raises(UnreadableMessageError, match=r"Question is not plain data"):
        decode(content)
