"""Pickles are read as plain data: nothing in them is run."""

import pickle

import numpy as np
import pytest
from gymnasium import spaces

from rlctl.importing import pickle_data
from rlctl.importing.pickle_data import NotPlainData, read_array
from rlctl.importing.sb3_model import read_space


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize(
    "value", [np.arange(6.0).reshape(2, 3), np.asfortranarray(np.arange(6, dtype=np.float32).reshape(2, 3)),
              np.float32(3.5), np.zeros((0, 3)), np.array([True, False]), np.arange(3, dtype=">i4")],
)  # fmt: skip
def test_arrays_of_every_protocol(protocol, value):
    read = read_array(pickle_data.read(pickle.dumps(value, protocol)))
    assert read.dtype == value.dtype
    np.testing.assert_array_equal(read, value)


@pytest.mark.parametrize(
    "content",
    [b"", b"garbage", b"]", b"\x80\x04.", pickle.dumps([1, 2])[:-1], b"cos\nsystem\n(S'true'\ntRb.", b"0.", b"h\x01.",
     b"t.", b"(b.", b"R.", b"N}s."],
)  # fmt: skip
def test_damaged_pickles_are_refused(content):
    with pytest.raises(NotPlainData):
        pickle_data.read(content)


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-2.0, np.array([1.0, 3.0], np.float32), (2,)),
        spaces.Discrete(4),
        spaces.MultiDiscrete([2, 3]),
        spaces.Dict({"a": spaces.Box(0, 255, (2, 2), np.uint8), "b": spaces.Discrete(2)}),
    ],
    ids=lambda space: type(space).__name__,
)
def test_spaces_of_the_old_gym_and_of_an_older_numpy(space):
    space.seed(0)  # its generator, which is in the pickle too, is not looked at
    content = pickle.dumps(space, 2)  # names of this protocol are plain text
    old = content.replace(b"gymnasium.spaces", b"gym.spaces").replace(b"numpy._core", b"numpy.core")
    assert old != content
    assert read_space(pickle_data.read(old)) == space


class Greeting:
    def __reduce__(self):
        return len, ("hello",)


def test_objects_are_data():
    read = pickle_data.read(pickle.dumps({"call": Greeting(), "list": [1, (2.5, "x")], "none": None}))
    assert str(read["call"].function) == "builtins.len"
    assert read["call"].arguments == ("hello",)
    assert read["list"] == [1, (2.5, "x")]


def make_bomb(grow: bytes, last: bytes) -> bytes:
    """A pickle of 40 values, each of which has the one before twice: 2^40 in all."""
    steps = b"".join(b"h%c" % k + b"h%c" % k + grow + b"q%c" % (k + 1) for k in range(40))
    return b"(tq\x00" + steps + last


@pytest.mark.parametrize(
    "content",
    [
        make_bomb(b"\x86", b"."),  # tuples of tuples
        make_bomb(b"\x86", b"}h\x28Ns."),  # as the key of a dict, whose hash would take forever
        make_bomb(b"\x86", b"\x8f(h\x28\x90."),  # in a set
        make_bomb(b"\x86", b"h\x28\x8c\x01a\x93."),  # as a name, whose text would
        b"]q\x00h\x00a.",  # a list in itself
    ],
)
def test_what_is_small_in_the_file_only_is_refused(content):
    with pytest.raises(NotPlainData):
        pickle_data.read(content)


def test_a_value_that_is_mentioned_twice():
    shared = [1, 2]
    assert pickle_data.read(pickle.dumps({"a": shared, "b": (shared, shared)})) == {"a": [1, 2], "b": ([1, 2], [1, 2])}
