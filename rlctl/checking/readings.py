"""What an environment observed of a world, and what the engine had at the same moments."""

from collections.abc import Sequence

import numpy as np

from rlctl.checking import attitudes
from rlctl.checking.world_logs import LoggedWorld, WorldLog
from rlctl.checking.worlds import ORIENTATION, Array, Poses, WorldBody

FEWEST_LOOKS = 30
NEARLY_ALL = 0.98  # in so many of all looks: angles near a pole have larger errors
MOST_ELEMENTS = 400


def join_logs(world: LoggedWorld) -> tuple[list[WorldLog], Array] | None:
    """Return the logs of a world and the observations of all their looks, shape (looks, elements); None for few."""
    logs = [log for log in world.logs if log.observed and len({row.size for row in log.observed}) == 1]
    if sum(len(log.observed) for log in logs) < FEWEST_LOOKS or len({log.observed[0].size for log in logs}) != 1:
        return None
    observed = np.concatenate([np.stack(log.observed) for log in logs]).astype(np.float64)
    return logs, np.nan_to_num(observed[:, :MOST_ELEMENTS])


def read_features(log: WorldLog, states: Sequence[Array], poses: Poses) -> Array:
    """Return what an observation may have of a look: states, attitudes of free bodies, and positions of links."""
    parts = []
    for body, state in zip(log.world.bodies, states, strict=True):
        parts += [state] if body.joints or body.is_free else []
        if body.is_free:
            parts.append(attitudes.compute_attitudes(poses[body.id, -1][None, ORIENTATION])[0])
    parts += [np.delete(pose, ORIENTATION) for pose in poses.values()]
    return np.nan_to_num(np.concatenate(parts)) if parts else np.zeros(0)


def name_features(log: WorldLog) -> list[str]:
    """Name the numbers of `read_features`."""
    names = []
    for body in log.world.bodies:
        if body.joints or body.is_free:
            names += _name_state(body)
        names += [f"{angle} of {body.name}" for angle in attitudes.NAMES] if body.is_free else []
    return names + [f"position of {log.world.link_name(link)}" for link in log.poses[0] for _ in range(6)]


def _name_state(body: WorldBody) -> list[str]:
    parts = [f"{what} of {body.name}" for what in ("position", "velocity", "angular velocity") for _ in range(3)]
    return parts + [f"{what} of {joint.name}" for what in ("position", "speed") for joint in body.joints]
