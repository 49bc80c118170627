"""Limits that are valid, but probably in another unit than the policy's."""

from rlctl.environments.info import EnvInfo
from rlctl.limits.limits import Limits

_TOO_FAST = 5.0  # times the top speed of the fastest joint


def list_doubts(limits: Limits, info: EnvInfo) -> list[str]:
    """Return a warning for each limit of speed that is far above what the robot's model can do, such as in degrees."""
    fastest = max(info.joints.max_speed, default=0.0) if info.joints is not None else 0.0
    where = "limits" if limits.file is None else str(limits.file)
    return [
        f"warning: {where}: {name}.speed: {joint.speed:g} is more than {_TOO_FAST:g} times the top speed of the "
        f"fastest joint, {fastest:.3g} rad/s or m/s; is it in degrees per second?"
        for name, joint in limits.limits.items()
        if fastest > 0.0 and joint.speed is not None and joint.speed > _TOO_FAST * fastest
    ]
