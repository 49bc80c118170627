"""Commands that last for one of several steps of the physics in a step of the environment."""

import collections
import dataclasses
import linecache
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiments.worlds import WatchedWorlds
from rlctl.checking.instance import EnvironmentRaised
from rlctl.checking.mujoco_calls import MujocoCalls
from rlctl.checking.records import FIRST_SEED
from rlctl.environments.bullet_calls import TORQUE, BulletCall

Array = NDArray[np.float64]
FORCES = ("applyExternalForce", "applyExternalTorque")
MOTORS = ("setJointMotorControl2", "setJointMotorControlArray", "setJointMotorControlMultiDof")
FIELDS = ("ctrl", "qfrc_applied", "xfrc_applied")
"""What MuJoCo keeps until it is set again."""
IMPULSES = re.compile(r"impuls|kick|strike|\bhit|skip|repeat|sub_?steps|n_sub|decimation", re.IGNORECASE)
"""What a line says that gives an impulse on purpose, or multiplies a force by the number of steps."""
STEPS, COMPARED = 30, 4  # of an episode; of those that show whether a command follows from the action
NEARLY_ALL, FEWEST = 0.9, 6  # steps


@dataclasses.dataclass(frozen=True)
class ShortCommand:
    """A command that acts in one of several steps of the physics, in each step of the environment."""

    name: str  # `applyExternalForce`, `data.ctrl`
    place: BulletCall | None  # of PyBullet
    steps: int  # of the physics in a step of the environment


@dataclasses.dataclass
class _StepLog:
    """What was commanded in one step of the environment."""

    physics: collections.Counter[int] = dataclasses.field(default_factory=collections.Counter)  # by client
    commands: dict[tuple[Any, ...], list[tuple[int, Array, BulletCall | None]]] = dataclasses.field(
        default_factory=lambda: collections.defaultdict(list)
    )
    """By client, function, body and link: before which step of the physics, and the numbers."""

    def read_values(self, key: tuple[Any, ...]) -> list[Array]:
        """Return what was given."""
        return [values for _, values, _ in self.commands.get(key, ())]

    def is_short(self, key: tuple[Any, ...]) -> bool:
        """Say whether a command acts in one step of the physics only, of several."""
        return self.physics[key[0]] > 1 and len({place for place, values, _ in self.commands[key] if values.any()}) == 1


class _Logger:
    """Logs the steps of an environment."""

    def __init__(self, watched: WatchedWorlds) -> None:
        self._watched = watched
        self._log = _StepLog()

    def play(self, *, action_seed: int, steps: int) -> list[_StepLog]:
        """Play an episode; its seed is always the same."""
        calls, mujoco_calls = self._watched.calls, self._watched.mujoco_calls
        calls.after_call, mujoco_calls.before_step = self._note_call, self._note_mujoco
        player = EpisodePlayer(self._watched.instance, FIRST_SEED, action_seed=action_seed, max_steps=steps)
        logs: list[_StepLog] = []
        try:
            player.reset()
            while not player.ended:
                self._log = _StepLog()
                player.step()
                logs.append(self._log)
        except EnvironmentRaised:  # an episode that was logged raised it too
            pass
        finally:
            calls.after_call, mujoco_calls.before_step = None, MujocoCalls.before_step
        return logs

    def _note_call(self, name: str, arguments: Sequence[Any], keywords: Mapping[str, Any], place: BulletCall) -> None:
        client = int(keywords.get("physicsClientId", 0))
        if name == "stepSimulation":
            self._log.physics[int(keywords.get("physicsClientId", arguments[0] if arguments else 0))] += 1
        elif name in FORCES or name in MOTORS:
            given = _read_command(name, arguments, keywords)
            if given is not None:
                what, values = given
                self._log.commands[client, name, place.line, *what].append((self._log.physics[client], values, place))

    def _note_mujoco(self, _: Any, data: Any, count: int) -> None:
        client = id(data)
        for name in FIELDS:
            values = np.array(getattr(data, name), np.float64).ravel()
            if values.any():
                # MuJoCo keeps it for all `count` steps.
                for place in range(self._log.physics[client], self._log.physics[client] + min(count, 2)):
                    self._log.commands[client, f"data.{name}"].append((place, values, None))
        self._log.physics[client] += count


def _read_command(name: str, arguments: Sequence[Any], keywords: Mapping[str, Any]) -> tuple[list[Any], Array] | None:
    """Return the body and the link or joints of a call, and its numbers; None for another mode of a motor."""
    if name in FORCES:
        names = ["objectUniqueId", "linkIndex", "forceObj" if name == "applyExternalForce" else "torqueObj"]
        body, link, values = (_find(names, arguments, keywords, one) for one in names)
    else:
        many = name.endswith("Array")
        plural = "s" * many
        names = ["bodyUniqueId", "jointIndices" if many else "jointIndex", "controlMode", f"targetPosition{plural}"]
        names += [f"targetVelocity{plural}", f"force{plural}"]
        if _find(names, arguments, keywords, "controlMode") != TORQUE:
            return None
        body, link = (_find(names, arguments, keywords, one) for one in names[:2])
        values = _find(names, arguments, keywords, names[-1])
    try:
        numbers = np.asarray(values, np.float64).ravel()
        return [int(body), str(np.ravel(link).tolist())], numbers
    except (TypeError, ValueError):  # PyBullet has its own ways to read numbers
        return None


def _find(names: Sequence[str], arguments: Sequence[Any], keywords: Mapping[str, Any], name: str) -> Any:
    return {**dict(zip(names, arguments, strict=False)), **keywords}.get(name)


def find_short_commands(watched: WatchedWorlds) -> Iterator[ShortCommand]:
    """Yield the commands that come in each step, follow from the action, and act in one step of the physics only."""
    if not watched.instance.accepts_seed or watched.instance.context.budget.is_over():
        return
    logger = _Logger(watched)
    logs = logger.play(action_seed=FIRST_SEED, steps=STEPS)
    keys = {key for log in logs for key in log.commands}
    short = [key for key in keys if _is_short(logs, key)]
    if not short:
        return
    again, other = (logger.play(action_seed=FIRST_SEED + number, steps=COMPARED) for number in (0, 1))
    for key in sorted(short, key=str):
        one, same, changed = (
            [log.read_values(_name(key, log)) for log in each[:COMPARED]] for each in (logs, again, other)
        )
        if _are_equal(one, same) and not _are_equal(one, changed):
            place = next(place for log in logs for _, _, place in log.commands.get(key, ()))
            if place is None or not IMPULSES.search(linecache.getline(place.file, place.line)):
                yield ShortCommand(key[1], place, max(log.physics[key[0]] for log in logs))


def _name(key: tuple[Any, ...], log: _StepLog) -> tuple[Any, ...]:
    """Return the key of the same command in another episode, whose reset may have loaded bodies again."""
    if key in log.commands:
        return key
    alike = [one for one in log.commands if one[1:3] == key[1:3]]
    return alike[0] if len(alike) == 1 else key


def _is_short(logs: Sequence[_StepLog], key: tuple[Any, ...]) -> bool:
    given = [log for log in logs if any(values.any() for values in log.read_values(key))]
    return len(given) >= max(FEWEST, NEARLY_ALL * len(logs)) and all(log.is_short(key) for log in given)


def _are_equal(one: Sequence[Sequence[Array]], other: Sequence[Sequence[Array]]) -> bool:
    pairs = list(zip(one, other, strict=False))
    return bool(pairs) and all(
        len(a) == len(b) and all(np.array_equal(x, y) for x, y in zip(a, b, strict=True)) for a, b in pairs
    )
