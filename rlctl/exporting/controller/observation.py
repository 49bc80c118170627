"""The policy's observation, computed from the inputs of a controller, step by step."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.exporting.controller.plan import ControllerPlan
from rlctl.task.history import TermHistory


class ControllerObservation:
    """Computes terms and histories as an exported controller does."""

    def __init__(self, plan: ControllerPlan) -> None:
        self._plan = plan
        self._history = TermHistory(1, plan.env.observation_history, plan.env.history_start)

    def begin(self) -> None:
        """Begin an episode: the histories are empty."""
        self._history.begin(slice(None))

    def observe(
        self, inputs: Mapping[str, NDArray[Any]], step: int, last_action: NDArray[Any]
    ) -> dict[str, NDArray[Any]]:
        """Return the parts of the observation by name, for the inputs of a step of the episode."""
        newest = {}
        for part in self._plan.observed:
            if part.term is None:
                newest[part.name] = inputs[part.name]
            elif part.term.internal == "last_action":
                newest[part.name] = last_action
            else:
                given = [inputs[name] for name in part.term.inputs]
                if part.term.internal == "time":
                    given.append(np.array([step * (self._plan.env.control_dt or 0.0)]))
                newest[part.name] = part.term(tuple(given))
        rows = {name: np.asarray(value)[None] for name, value in newest.items()}
        return {name: value[0] for name, value in self._history.add(rows, slice(None)).items()}
