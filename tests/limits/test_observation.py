"""Observations by name, flat, or of a Dict space with a picture."""

import numpy as np
import pytest
from gymnasium import spaces

from rlctl.environments.info import EnvInfo, space_to_json
from rlctl.limits.observation import ObservationError, ObservationReader
from tests.limits.conftest import make_filter, observe_at, run_filter

ACTION = space_to_json(spaces.Box(-1, 1, (1,)))
DICT = spaces.Dict(
    {
        "camera": spaces.Box(0, 255, (4, 4, 3), np.uint8),
        "pose": spaces.Box(-1, 1, (2,), np.float32),
        "mode": spaces.Discrete(3, start=1),
    }
)


def layout(space, **options):
    return ObservationReader(EnvInfo(observation_space=space_to_json(space), action_space=ACTION, **options))


def test_names_in_any_order():
    named = layout(spaces.Box(-1, 1, (3,), np.float32), observation_sizes={"a": 1, "b": 2})
    observation = named.read({"b": [2, 3], "a": 1})
    assert observation.tolist() == [1.0, 2.0, 3.0]
    assert observation.dtype == np.float32
    np.testing.assert_array_equal(named.read([1, 2, 3]), observation)


def test_a_dict_space_with_a_picture():
    parts = layout(DICT)
    observation = parts.read({"mode": 2, "camera": np.ones((4, 4, 3), np.uint8), "pose": [0.5, 1]})
    assert DICT.contains({**observation, "mode": int(observation["mode"])})
    assert parts.flatten(observation).tolist() == [2.0, 0.5, 1.0]  # in the order of the space, without the picture
    assert parts.layout.columns == {"mode": slice(0, 1), "pose": slice(1, 3)}
    with pytest.raises(ObservationError, match="takes observations by name: "):
        parts.read([1.0, 2.0])


def test_stacked_observations_have_no_names():
    stacked = layout(spaces.Box(-1, 1, (2, 3), np.float32), observation_sizes={"a": 1, "b": 2})
    assert stacked.shapes == {"observation": (2, 3)}
    assert stacked.read(np.arange(6) / 6).shape == (2, 3)


@pytest.mark.parametrize(
    ("picture", "message"),
    [
        (np.full((4, 6, 3), 0.5), "observation 'camera' has 0.5, the policy takes uint8"),  # it was all black
        (np.full((4, 6, 3), 300), "observation 'camera' has 300, the policy takes uint8"),  # it was 44
        (np.ones((6, 4, 3), np.uint8), r"observation 'camera' has shape \(6, 4, 3\), the policy takes \(4, 6, 3\)"),
    ],
)
def test_pictures_of_another_scale_or_on_their_side(picture, message):
    camera = layout(spaces.Dict({"camera": spaces.Box(0, 255, (4, 6, 3), np.uint8)}))
    with pytest.raises(ObservationError, match=message):
        camera.read({"camera": picture})
    for same in (np.full((1, 4, 6, 3), 7.0), np.full(72, 7)):
        assert camera.read({"camera": same})["camera"].tolist() == np.full((4, 6, 3), 7).tolist()


class Hostile:
    def __array__(self, *args, **kwargs):
        raise ZeroDivisionError


@pytest.mark.parametrize(
    "value",
    [
        *(
            1 + 2j,
            np.array([1, 2j, 0, 0, 0]),
            "1",
            ["1"] * 5,
            [10**400] * 5,
            [[1], [2, 3]],
            {1, 2},
            {"positions": [0, 0]},
        ),
        *(Hostile(), [], np.zeros(4), np.zeros(6), np.ma.array(np.zeros(5), mask=True), np.zeros(5, "datetime64[s]")),
    ],
    ids=lambda value: type(value).__name__,
)
def test_what_is_not_an_observation_is_a_fault(arm, value):
    safety = make_filter(arm)
    assert run_filter(safety, observe_at(0, 0), [1, 1]) == pytest.approx([1, 1])
    assert not safety.observe(value)
    assert not safety.trusts_observation
    assert safety.limit([1, 1]) == pytest.approx([0, 0])
    assert safety.state == "holding"


@pytest.mark.parametrize("age", [None, "1", [], [0, 0], 1j, np.nan, 1e9, -1e9], ids=repr)
def test_what_is_not_an_age_is_a_fault(arm, age):
    safety = make_filter(arm)
    assert not safety.observe(observe_at(0, 0), age)
    assert safety.limit([1, 1]) == pytest.approx([0, 0])


@pytest.mark.parametrize(
    "action",
    [np.array([1j, 0]), ["1", "2"], Hostile(), np.ma.array([1, 2], mask=[True, False]), np.zeros(2, "datetime64[s]")],
    ids=lambda value: type(value).__name__,
)
def test_what_is_not_an_action_is_a_fault(arm, action):
    safety = make_filter(arm)
    assert run_filter(safety, observe_at(0, 0), action) == pytest.approx([0, 0])
    assert safety.state == "holding"
