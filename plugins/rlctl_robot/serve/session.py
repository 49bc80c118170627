"""A served policy, and one client of a server: its episode, its filter, and the answer to each of its requests."""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.environments.info import EnvInfo
from rlctl.errors import ArtifactError, short_repr
from rlctl.limits.limited import Limited
from rlctl.limits.limits import Limits
from rlctl.limits.observation import WHOLE, ObservationError
from rlctl.policy.actor import Actor, Rows, as_rows
from rlctl.policy.file import DETERMINISTIC, PolicyFile, PolicyInfo
from rlctl.policy.load import check_playable
from rlctl.policy.network import Network
from rlctl.policy.numpy_actor import NumpyActor
from rlctl.storage import files, untrusted


@dataclasses.dataclass(frozen=True, eq=False)
class ServedPolicy:
    """The policy of a server."""

    file: Path
    info: PolicyInfo
    sha256: str  # of the file
    make_actor: Callable[[], Actor]  # returns the policy of one client, with its own recurrent state
    network: Network | None = None  # None for an ONNX file, which outputs only the action

    def measure_spread(self, observation: Any) -> float | None:
        """Return the mean standard deviation of the stochastic policy's actions; None if the policy has none."""
        network, algo = self.network, self.info.algo
        if network is None or algo in (*DETERMINISTIC, "dqn") or self.info.policy_kwargs.get("use_sde"):
            return None
        if network.log_std is not None:
            return float(np.exp(network.log_std).mean())
        if network.lstm is not None or self.info.env.action_space["type"] != "Box":
            return None
        return float(network.compute_std(network.compute_latent(as_rows(observation))).mean())

    def check_replaces(self, other: EnvInfo) -> None:
        """Raise `ArtifactError` if this policy cannot replace a policy for the environment `other`."""
        own = self.info.env
        difference = own.find_difference(other, "the served policy's")
        if difference is None and list(own.observation_sizes.items()) != list(other.observation_sizes.items()):
            difference = "its observations have other names"
        if difference is None and own.control_dt != other.control_dt:
            difference = f"its control_dt is {own.control_dt} s, the served policy's {other.control_dt} s"
        if difference is not None:
            raise ArtifactError(f"{self.file.name}: this policy cannot replace the served one: {difference}")


def load_served_policy(file: Path) -> ServedPolicy:
    """Load a `.safetensors` or `.onnx` file and act once; raises `ArtifactError` for an invalid policy."""
    sha256 = files.digest(untrusted.read_bytes(file))
    if file.suffix == ".onnx":
        from rlctl.policy.onnx_policy import OnnxActor  # only here: it imports onnxruntime

        exported = OnnxActor.load(file)
        info, session = exported.info, exported.session
        return ServedPolicy(file, info, sha256, lambda: OnnxActor(info, session))
    actor = check_playable(PolicyFile.read(file)).actor_only()
    return ServedPolicy(file, actor.info, sha256, lambda: NumpyActor(actor), Network(actor))


_MAX_AGE_S = 1e9
_SAME = 1e-6  # difference of two actions by rounding


class Session:
    """The episodes of one client. A new policy that `policy` returns takes over at the next step, with a blend."""

    def __init__(self, number: int, policy: Callable[[], ServedPolicy], limits: Limits | None) -> None:
        self.number = number
        self._policy = policy
        self._served = policy()
        self._limited = Limited(self._served.make_actor(), self._served.info.env, limits, holds_on_errors=True)
        self._row = Rows.one()
        (self.safety,) = self._limited.filters
        periods, dt = self.safety.limits.watchdog_periods, self.safety.control_dt
        self._watchdog_s = periods * dt if periods and dt else None
        self._last_s: float | None = None
        self._by_watchdog = False
        self.episode = 0  # how many episodes the client has begun with `reset`
        self.action: NDArray[Any] | None = None  # the last action
        self.is_limited = False  # whether the last action is another one than the policy's
        self.observation: Any = None  # the last observation, in the policy's form

    def check_watchdog(self, now_s: float) -> None:
        """Stop if no observation arrived for too long while running; `now_s` is a `time.monotonic()`."""
        if self._watchdog_s is None or self._last_s is None or self.safety.state != "running":
            return
        if (waited := now_s - self._last_s) > self._watchdog_s:
            self._by_watchdog = True
            self.safety.stop(f"watchdog: no observation for {waited:.3g} s; POST /resume, or send reset: true")

    def answer(self, request: Any) -> dict[str, Any]:
        """Return the answer to a request: an action within the limits, the state, and any error."""
        self.check_watchdog(time.monotonic())
        self._adopt_policy()
        error = ""
        infer_s = 0.0
        try:
            observation, age_s = self._read(request)
        except ObservationError as problem:
            error = str(problem)
            self.safety.fail("invalid observation", short_repr(error, 200))
            action = self.safety.limit(None)
        else:
            self.observation = observation
            self._limited.ages_s = [age_s]
            action = self._limited.act(as_rows(observation), self._row)[1][0]
            infer_s = self._limited.acting_s
            if (failure := self._limited.error) is not None:
                error = f"the policy cannot act: {short_repr(str(failure), 200)}"
            self._row.step[0] += 1
        self.is_limited = bool(error) or self._is_changed(action)
        self.action = action
        answer: dict[str, Any] = {
            "actions": action.reshape(1, -1) if action.ndim < 2 else action[None],
            "server_timing": {"infer_ms": infer_s * 1000.0},
            "state": self.safety.state,
        }
        if self.safety.reason:
            answer["reason"] = self.safety.reason
        if error:
            answer["error"] = error
        if isinstance(request, dict) and isinstance(number := request.get("sequence"), int):
            answer["sequence"] = number  # `rlctl robot` numbers its observations
        self._last_s = time.monotonic()  # the watchdog measures the client, not this answer
        return answer

    def _is_changed(self, action: NDArray[Any]) -> bool:
        """Return whether the filter returned another action than the policy."""
        (requested,) = self._limited.requested
        return requested is None or not np.allclose(action, requested, atol=_SAME)

    def _read(self, request: Any) -> tuple[Any, float]:
        """Return the observation of a request and its age [s]; reset if it asks for that."""
        if not isinstance(request, dict):
            raise ObservationError("a request is a map: observations by name, or observation: the flat vector")
        fields = {key: value for key, value in request.items() if key != "sequence"}
        reset, age_s = fields.pop("reset", False), fields.pop("age_s", 0.0)
        if not isinstance(reset, bool | int | np.bool_):
            raise ObservationError(f"reset is {short_repr(reset)}, not true or false")
        if reset:
            self.reset()
        is_number = isinstance(age_s, int | float | np.number) and not isinstance(age_s, bool)
        if not is_number or abs(age_s) > _MAX_AGE_S:
            raise ObservationError(f"age_s is {short_repr(age_s)}, not a number of seconds")
        reader = self.safety.reader
        is_flat = list(fields) == [WHOLE] and WHOLE not in reader.shapes
        return reader.read(fields[WHOLE] if is_flat else fields), float(age_s)

    def _adopt_policy(self) -> None:
        if (policy := self._policy()) is not self._served:
            self._served, self._limited.actor = policy, policy.make_actor()
            self.safety.begin_blend()

    def reset(self) -> None:
        """Begin an episode: forget the recurrent state. A stop by the watchdog ends; other stops stay."""
        if self._by_watchdog and self.safety.state == "stopped":
            self.safety.resume()
        self._by_watchdog = False
        self.episode += 1
        self._row = Rows.one()
        self._limited.actor.begin(self._row)
        self.safety.reset()

    def order(self, order: str) -> None:
        """Obey an operator's order: stop, home, hold or resume."""
        self._by_watchdog = False  # only the operator ends an operator's order
        if order == "resume":
            self._last_s = None
        getattr(self.safety, order)()
