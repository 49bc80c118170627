"""`rlctl runs compare A B --vary`: where one policy is better than another, as a map of the difference."""

import dataclasses
from collections.abc import Sequence
from typing import Any

from rlctl import output
from rlctl.errors import UsageError
from rlctl.evaluation.eval_request import EvalRequest
from rlctl.evaluation.players import find_player
from rlctl.evaluation.robustness import Axis, Cell, Robustness
from rlctl.evaluation.vary import measure_robustness
from rlctl.runs.listing import find_runs_of
from rlctl.version import collect_versions


@dataclasses.dataclass(frozen=True)
class CellDifference:
    """A candidate's score minus the baseline's in one cell."""

    values: list[float]  # one per axis
    nominal: bool
    baseline: Cell
    candidate: Cell

    @property
    def difference(self) -> float:
        """Of success rates; of mean returns where the task reports no success."""
        one, two = self.baseline, self.candidate
        if one.success_rate is None or two.success_rate is None:
            return two.mean_return - one.mean_return
        return two.success_rate - one.success_rate

    @property
    def is_clear(self) -> bool:
        """Whether the 95 % intervals of the two scores do not overlap."""
        one, two = (_find_interval(cell) for cell in (self.baseline, self.candidate))
        return one[1] < two[0] or two[1] < one[0]


@dataclasses.dataclass(frozen=True)
class MapDifference:
    """The differences in all cells of a map."""

    axes: list[Axis]
    cells: list[CellDifference]  # in the order of `RobustnessMap.cells`

    @property
    def has_success(self) -> bool:
        """Whether the differences are those of success rates."""
        return self.cells[0].baseline.success_rate is not None


@dataclasses.dataclass(frozen=True)
class MapComparison:
    """Two policies in the same cells."""

    names: tuple[str, str]  # baseline and candidate
    task: str
    episodes: int
    maps: list[MapDifference]


def _find_interval(cell: Cell) -> tuple[float, float]:
    return cell.success_interval or cell.return_interval


def compare_maps(
    texts: Sequence[str], request: EvalRequest, vary: Sequence[str], *, yes: bool = False
) -> MapComparison:
    """Measure two policies in the cells of `vary`, see `measure_robustness`, in the world of the first.

    Raises `UsageError` for other than two, and for groups of runs.
    """
    if len(texts) != 2:
        raise UsageError(
            "--vary compares two policies, the baseline first: rlctl runs compare A B --vary mass=0.6:1.4:5"
        )
    for text in texts:
        if not text.endswith((".safetensors", ".onnx")) and len(find_runs_of(text)) > 1:
            raise UsageError(f"{text}: several runs; --vary compares single policies, name one of them")
    randomize = dataclasses.replace(request.changes, randomize=request.changes.randomize or False)
    baseline = dataclasses.replace(request, run=texts[0], changes=randomize)
    _, _, spec = find_player(baseline, print_notes=lambda notes: None)
    one = measure_robustness(baseline, vary, yes=yes)
    two = measure_robustness(dataclasses.replace(baseline, run=texts[1], spec=spec), vary, yes=yes)
    return subtract((texts[0], texts[1]), one, two)


def subtract(names: tuple[str, str], one: Robustness, two: Robustness) -> MapComparison:
    """Return the differences of two measurements in the same cells."""
    maps = [
        MapDifference(
            before.axes,
            [
                CellDifference(cell.values, cell.nominal, cell, other)
                for cell, other in zip(before.cells, after.cells, strict=True)
                if isinstance(cell, Cell) and isinstance(other, Cell)
            ],
        )
        for before, after in zip(one.maps, two.maps, strict=True)
    ]
    return MapComparison(names, one.task, one.episodes, maps)


def show(result: MapComparison, json: str | None) -> None:
    """Print a table per map, or JSON alone for `-`."""
    if output.present(as_json(result), json):
        return
    out = output.out()
    baseline, candidate = result.names
    out.print(f"{result.task}: {candidate} minus {baseline}, the same {result.episodes} episodes in every cell")
    for compared in result.maps:
        out.print()
        if len(compared.axes) == 1:
            _show_list(compared)
        else:
            _show_grid(compared)
        quantity = "points of success" if compared.has_success else "return"
        out.print(f"{quantity}; * the 95 % intervals of the two do not overlap")


def _show_list(compared: MapDifference) -> None:
    rows = []
    for cell in compared.cells:
        scores = [_format_score(side) for side in (cell.baseline, cell.candidate)]
        rows.append((f"{cell.values[0]:g}", *scores, _format_difference(compared, cell)))
    output.print_table((compared.axes[0].name, "baseline", "candidate", "difference"), rows)


def _show_grid(compared: MapDifference) -> None:
    """Print a table: the first axis downwards, the second across."""
    down, across = compared.axes
    width = len(across.values)
    rows = []
    for number, value in enumerate(down.values):
        cells = compared.cells[number * width : (number + 1) * width]
        rows.append((f"{value:.3g}", *(_format_difference(compared, cell) for cell in cells)))
    output.print_table((f"{down.name} \\ {across.name}", *(f"{value:.3g}" for value in across.values)), rows)


def _format_score(cell: Cell) -> str:
    if cell.success_rate is None:
        return f"{cell.mean_return:.4g}"
    return f"{cell.success_rate:.1%}"


def _format_difference(compared: MapDifference, cell: CellDifference) -> str:
    mark = "*" if cell.is_clear else " "
    if compared.has_success:
        return f"{100 * cell.difference:+.0f}{mark}"
    return f"{cell.difference:+.3g}{mark}"


def as_json(result: MapComparison) -> dict[str, Any]:
    """Return the comparison as plain data."""
    return {
        "format": "rlctl runs compare map 1",
        "task": result.task,
        "baseline": result.names[0],
        "candidate": result.names[1],
        "episodes": result.episodes,
        "versions": collect_versions(),
        "maps": [
            {
                "axes": [axis.model_dump(mode="json") for axis in compared.axes],
                "quantity": "success" if compared.has_success else "return",
                "cells": [
                    {
                        "values": cell.values,
                        "nominal": cell.nominal,
                        "baseline": cell.baseline.model_dump(mode="json"),
                        "candidate": cell.candidate.model_dump(mode="json"),
                        "difference": cell.difference,
                        "intervals_overlap": not cell.is_clear,
                    }
                    for cell in compared.cells
                ],
            }
            for compared in result.maps
        ],
    }
