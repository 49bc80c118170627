"""The Python API of what acts: one observation in, an action out, both as NumPy arrays."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import join, map_parts, split, split_space
from rlctl.environments.spec import EnvSpec
from rlctl.policy.actor import Actor, Exploration, Rows
from rlctl.policy.file import PolicyInfo

_MEAN, _SAMPLE = Exploration(), Exploration(stochastic=True)


class FileActor(Actor):
    """An actor that was read from a file, which describes it."""

    info: PolicyInfo


class Policy:
    """A policy that acts in one environment: the first row of an actor."""

    def __init__(self, actor: FileActor) -> None:
        self.actor, info = actor, actor.info
        self.info = info
        self.observation_space, self.action_space = info.env.spaces()
        parts = split_space(self.observation_space)
        self._parts = {key: (space.shape or (), space.dtype) for key, space in parts.items()}
        self._is_deterministic = True
        self.reset()

    def __repr__(self) -> str:
        info = self.info
        return f"{type(self).__name__}({info.spec.task}, {info.algo}, {info.training_steps:,} steps)"

    def predict(self, observation: Any, *, deterministic: bool = True) -> NDArray[Any]:
        """Return the action for one observation, in the environment's action space.

        Call `reset` when an episode begins: a recurrent policy keeps a state. `deterministic=False` samples the action,
        with new noise in every episode. Raises `ValueError` for an observation of another shape, `UsageError` if an
        exported policy shall sample.
        """
        rows = self._read_row(observation)
        if deterministic is not self._is_deterministic:
            self.actor.explore(_MEAN if deterministic else _SAMPLE)
            self._is_deterministic = deterministic
        row = self._row
        action: NDArray[Any] = np.asarray(self.actor.act(rows, row)[1][0])
        row.step[0] += 1
        return action

    def reset(self) -> None:
        """Begin an episode: forget the recurrent state."""
        self._row = Rows.one(seed=int(np.random.SeedSequence().generate_state(1)[0]))
        self.actor.prepare()
        self.actor.begin(self._row)

    def _read_row(self, observation: Any) -> Any:
        """Return an observation as a batch of one row, in its dtypes; raises `ValueError` for another shape."""
        raw_parts, parts = split(observation), {}
        for key, (shape, dtype) in self._parts.items():
            value = np.asarray(raw_parts[key], dtype) if key in raw_parts else None
            if value is not None and value.dtype.kind == "u" and (changed := value != raw_parts[key]).any():
                number = np.asarray(raw_parts[key])[changed][0]
                raise ValueError(f"observation has {number:g}, the policy expects {dtype}")
            if value is None or value.shape != shape:
                expected = join({key: shape for key, (shape, _) in self._parts.items()})
                problem = f"observation of shape {map_parts(np.shape, observation)}, the policy expects {expected}"
                raise ValueError(problem + _describe_additions(self.info.spec))
            parts[key] = value[None]
        return join(parts)

    def try_once(self, *, deterministic: bool = True) -> None:
        """Act once on an observation of zeros; raises `ValueError` for an action that does not fit the action space.

        For a file that does not fit its description, this raises other exceptions, too.
        """
        spaces = split_space(self.observation_space).items()
        zeros = {key: np.full(space.shape or (), getattr(space, "start", 0), space.dtype) for key, space in spaces}
        action = self.predict(join(zeros), deterministic=deterministic)
        self.reset()
        if action.shape != (self.action_space.shape or ()):
            raise ValueError(f"its actions have shape {action.shape}, its action space has {self.action_space.shape}")
        if not np.isfinite(action).all():
            raise ValueError("its actions are not finite")


def _describe_additions(spec: EnvSpec) -> str:
    """Return what rlctl adds to the task's observation, and how to get it."""
    added = ["the remaining fraction of the episode"] if spec.time_feature else []
    if spec.frame_stack > 1:
        added.append(f"{spec.frame_stack} frames")
    return f", including {' and '.join(added)}; policy.info.spec.make() returns these observations" if added else ""
