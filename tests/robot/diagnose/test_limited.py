"""Actions at a limit are found in a log, whatever the policy wanted."""

import numpy as np
import pytest

from rlctl.deploy import Limits, SafetyFilter
from rlctl.errors import ArtifactError, UsageError
from rlctl_robot.diagnose.limited import find_limited_rows
from rlctl_robot.diagnose.signals import LoggedSignals
from tests.limits.conftest import make_arm

LIMITS = {
    "command": "position",
    "scale": 0.5,
    "measured": {"position": "positions"},
    "limits": {"all": {"speed": 1.0}},
    "blend_in_s": 0.3,
}


def make_log(limits, wanted):
    """The arm follows the filtered actions; return its log, and whether a limit changed the row's action."""
    info = make_arm(low=-2.0, high=2.0)
    safety = SafetyFilter(info, limits)
    position, rows, actions = np.zeros(2), [], []
    for action in wanted:
        rows.append([*position, 0.0, 0.0, 0.0])
        safety.observe(np.array(rows[-1], np.float32))
        actions.append(safety.limit(action))
        position = 0.5 * actions[-1]
    actions = np.array(actions, np.float64)
    signals = LoggedSignals(np.array(rows), actions, (len(wanted),), {"positions": 2, "goal": 3})
    return info, signals, (np.abs(actions - wanted) > 1e-6).any(axis=1)


def test_rows_at_a_limit_and_in_the_blend():
    limits = Limits.model_validate(LIMITS)
    rng = np.random.default_rng(0)
    wanted = np.clip(np.cumsum(rng.normal(scale=0.15, size=(300, 2)), axis=0), -2.0, 2.0).astype(np.float32)
    info, signals, changed = make_log(limits, wanted)
    limited = find_limited_rows(limits, info, signals, 5)
    assert 30 < changed.sum() < 270
    assert (limited | ~changed).all()  # every action that differs from the policy's
    assert limited[:3].all()  # the blend
    assert limited.mean() < changed.mean() + 0.05


def test_logs_that_cannot_be_compared():
    limits = Limits.model_validate(LIMITS)
    info, signals, _ = make_log(limits, np.tile(np.float32([[2.0, 2.0], [-2.0, -2.0]]), (50, 1)))
    with pytest.raises(ArtifactError, match="the limits act in all but 0 of 90 rows"):
        find_limited_rows(limits, info, signals, 5)
    with pytest.raises(UsageError, match="a low-pass changes every action"):
        find_limited_rows(limits.model_copy(update={"lowpass_hz": 5.0}), info, signals, 5)
