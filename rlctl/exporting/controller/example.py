"""An episode that a controller has played, as CSV: inputs and expected outputs for the user's own test."""

import csv
import io
from collections.abc import Sequence

import numpy as np

from rlctl.exporting.controller.controllers import Controller, Inputs

ROWS = 100


def write_example(controller: Controller, measured: Sequence[Inputs]) -> str:
    """Return what a controller does, from the start of an episode on, with its first `ROWS` measurements."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    controller.begin()
    for number, inputs in enumerate(measured[:ROWS]):
        action, target = controller.step(inputs)
        columns = {**inputs, "action": action, **({} if target is None else {"target": target})}
        if not number:
            rows.writerow(f"{name}_{index}" for name, values in columns.items() for index in range(np.size(values)))
        rows.writerow(f"{value:.9g}" for values in columns.values() for value in np.ravel(values).tolist())
    return text.getvalue()
