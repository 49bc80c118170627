"""The plots of a report, as SVG texts for an HTML page or as a file of their own."""

import dataclasses
import functools
import io
import math
import re
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, cast, get_args

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Rectangle
from matplotlib.ticker import EngFormatter, FuncFormatter, MaxNLocator, PercentFormatter
from numpy.typing import NDArray

from rlctl.errors import UsageError
from rlctl.evaluation.robustness import Axis, Cell, FailedCell, PushTest, Robustness, RobustnessMap
from rlctl.runs.compare.maps import MapComparison, MapDifference
from rlctl.runs.report.content import RecipeRuns, RunReport, mean_curve

_SIZE = (4.4, 2.7)  # [inches]: the width of a phone, so that text is readable there
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",  # text stays text: smaller, and can be searched
    "pdf.fonttype": 42,  # TrueType; journals refuse Type 3
    "font.size": 9,
    "font.family": "sans-serif",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.3,
}
Picture = Literal["svg", "pdf", "png"]
_MOST_IN_A_ROW = 3  # panels
_MOST_TICKS = 7  # of an axis
_MOST_NUMBERS = 12  # next to each other in a row of cells
_PNG_RESOLUTION = 200  # [dots per inch]
_UNDATED: dict[Picture, dict[Any, Any]] = {"svg": {"Date": None}, "pdf": {"CreationDate": None}, "png": {}}
_FEW = 8  # evaluations; fewer make no curve, and the training's is drawn too
_LONG = 40  # points of a curve that is smoothed
_LEGEND: dict[str, Any] = {"frameon": False, "fontsize": 8}
_NO_METADATA: dict[Any, Any] = dict.fromkeys(("Date", "Creator", "Format", "Type"))
_TITLES = {"return": "Return", "success": "Success rate"}
_UNITS = {"return": "return of an episode", "success": "success rate"}


@dataclasses.dataclass(frozen=True)
class _Curves:
    """The curves of a recipe over training steps, of one quantity; None without values."""

    recipe: RecipeRuns
    training: dict[str, Any] | None
    evaluated: dict[str, Any] | None

    @property
    def has_few_evaluations(self) -> bool:
        """Whether the evaluations make no curve of their own: a picture for a paper then has the training's too."""
        return self.evaluated is None or len(self.evaluated["steps"]) < _FEW

    def list_of_paper(self) -> list[dict[str, Any]]:
        """Return the curves that a picture for a paper has; readers expect one per recipe."""
        training = self.training if self.has_few_evaluations else None
        return [curve for curve in (training, self.evaluated) if curve is not None]


def _list_curves(report: RunReport, column: str) -> list[_Curves]:
    return [
        _Curves(
            recipe,
            training=mean_curve([run.metrics for run in recipe.runs], column),
            evaluated=mean_curve([run.evaluations for run in recipe.runs], column),
        )
        for recipe in report.recipes
    ]


def plot_learning(report: RunReport, column: str) -> str | None:
    """Return the curve of a quantity over training steps, with evaluations; None where there is none."""
    figure, axes = _make_figure()
    return _finish(figure, axes) if _draw_learning(axes, _list_curves(report, column), column) else None


def draw_learning(report: RunReport, form: Picture) -> bytes:
    """Return the learning curves as a file for a paper; a quantity without values has no panel.

    Below them is what lines, bands and marks are, and which seeds ended early.
    """
    curves = {column: _list_curves(report, column) for column in _TITLES}
    with matplotlib.rc_context(_STYLE):
        figure, file = Figure(figsize=(2 * _SIZE[0], _SIZE[1] + 0.5), layout="constrained"), io.BytesIO()
        figure.suptitle(report.runs[0].summary.task, fontsize=10, fontweight="bold")
        for axes, column in zip(figure.subplots(1, 2), _TITLES, strict=True):
            if _draw_learning(axes, curves[column], column, for_paper=True):
                axes.set_title(_TITLES[column], loc="left", fontsize=9)
            else:
                axes.remove()
        drawn = [one for column in _TITLES for one in curves[column]]
        figure.supxlabel("\n".join(_explain_curves(report.recipes, drawn)), fontsize=7)
        _save(figure, file, form)
    return file.getvalue()


def _explain_curves(recipes: Sequence[RecipeRuns], drawn: Sequence[_Curves]) -> list[str]:
    """Return what the marks of the curves mean, and which seeds ended early or still train, as lines."""
    counts = []
    for recipe in recipes:
        of_recipe = f" ({recipe.label})" if len(recipes) > 1 else ""
        if len(recipe.runs) > 1:
            counts.append(f"{len(recipe.runs)} seeds{of_recipe}")
    sentences = []
    if counts:
        sentences.append(f"Lines and dots: mean; bands and bars: lowest to highest of {', '.join(counts)}.")
    if any(len(curves.list_of_paper()) == 2 for curves in drawn):
        sentences.append("Lines: episodes of the training; dots: evaluations.")
    ended: dict[str, float] = {}
    training: dict[str, float] = {}
    for curves in drawn:
        of_recipe = f" of {curves.recipe.label}" if curves.recipe.label else ""
        for number, step, _ in [end for curve in curves.list_of_paper() for end in curve["ended"]]:
            run = curves.recipe.runs[number].summary
            steps = training if run.state == "running" else ended
            steps[f"seed {run.seed}{of_recipe}"] = step
    parts = []
    for what, steps in (("ended early", ended), ("still trains", training)):
        if steps:
            parts.append(f"{what} ({', '.join(f'{name} at step {step:,.0f}' for name, step in steps.items())})")
    if parts:
        sentences.append(f"x: {', '.join(parts)}; from there on the mean of the others.")
    return [line for sentence in sentences for line in textwrap.wrap(sentence, 130)]


def _save(figure: Figure, file: io.BytesIO, form: Picture) -> None:
    figure.savefig(file, format=form, dpi=_PNG_RESOLUTION, metadata=_UNDATED[form])


def choose_form(path: Path) -> Picture:
    """Return the format of a picture by the suffix of its file; raises `UsageError` for another one."""
    for form in get_args(Picture):
        if path.suffix == f".{form}":
            return cast(Picture, form)
    raise UsageError(f"{path}: the name of a picture ends in .png, .svg or .pdf")


def draw_maps(result: Robustness, form: Picture) -> bytes:
    """Return the robustness maps of a policy, in a grid, as a picture."""
    title = f"{result.task}: {Path(result.policy_file).name}, {result.episodes:,} episodes in every cell"
    return _draw_panels([functools.partial(_draw_map, varied=varied) for varied in result.maps], form, title)


def draw_differences(result: MapComparison, form: Picture) -> bytes:
    """Return the maps of the difference of two policies, in a grid, as a picture."""
    title = f"{result.task}: the same {result.episodes:,} episodes in every cell"
    panels = [functools.partial(_draw_difference, names=result.names, compared=compared) for compared in result.maps]
    return _draw_panels(panels, form, title)


def _draw_panels(panels: Sequence[Callable[[Figure, Axes], None]], form: Picture, title: str) -> bytes:
    columns = min(math.ceil(math.sqrt(len(panels))), _MOST_IN_A_ROW)
    rows = math.ceil(len(panels) / columns)
    with matplotlib.rc_context(_STYLE):
        figure, file = Figure(figsize=(columns * _SIZE[0], rows * _SIZE[1]), layout="constrained"), io.BytesIO()
        figure.suptitle(textwrap.fill(title, 60 * columns), fontsize=9)
        grid = figure.subplots(rows, columns, squeeze=False).ravel()
        for draw, axes in zip(panels, grid, strict=False):
            draw(figure, axes)
        for axes in grid[len(panels) :]:
            axes.remove()
        _save(figure, file, form)
    return file.getvalue()


def _draw_difference(figure: Figure, axes: Axes, names: tuple[str, str], compared: MapDifference) -> None:
    unit = "difference in the success rate" if compared.has_success else "difference in the return"
    values = np.array([cell.difference for cell in compared.cells])
    clear = np.array([cell.is_clear for cell in compared.cells])
    title = textwrap.fill(f"{Path(names[1]).name} minus {Path(names[0]).name}", 48)
    if len(compared.axes) == 1:
        (axis,) = compared.axes
        axes.axhline(0.0, color="gray", linewidth=0.8)
        axes.plot(axis.values, values, marker="o", ms=3, mfc="white")
        axes.plot(np.array(axis.values)[clear], values[clear], "o", ms=4, color="C0", label="intervals do not overlap")
        axes.legend(loc="best", **_LEGEND)
        _label(axes, axis.label, unit, title)
        _mark_values(axes, whole=axis.whole)
        return
    rows, columns = compared.axes
    largest = 1.0 if compared.has_success else float(np.abs(values).max()) or 1.0
    limits = {"cmap": "RdYlGn", "vmin": -largest, "vmax": largest}
    _draw_heat(figure, axes, values, (rows, columns), unit, limits, "{x:+.0%}" if compared.has_success else None)
    for index in np.flatnonzero(clear):  # above the number of the cell
        place = index % len(columns.values), index // len(columns.values) + 0.3
        axes.plot(*place, marker="*", ms=6, color="black")
    _label(axes, columns.label, rows.label, title)


def _draw_learning(axes: Axes, curves: Sequence[_Curves], column: str, *, for_paper: bool = False) -> bool:
    for number, of_recipe in enumerate(curves):
        recipe, training, evaluated = of_recipe.recipe, of_recipe.training, of_recipe.evaluated
        color = {"color": f"C{number}"} if recipe.name else {}  # a colour per recipe
        name = textwrap.fill(textwrap.shorten(recipe.label, 64, placeholder=" ..."), 34)
        alone = for_paper and evaluated is not None and (training is None or not of_recipe.has_few_evaluations)
        if training is not None and not alone:
            _draw_smoothed(axes, training, name or "training", color)
        if evaluated is not None:
            label, style = (name, "-") if alone else ("", "none")
            line = {"linestyle": style, **color} if recipe.name else {}
            _draw_curve(axes, evaluated, label if name else "evaluations", {"marker": "o", "ms": 3, **line})
    if column == "success":
        _scale_rates(axes)
    if axes.lines:  # below the axes, where it hides no curve
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2, **_LEGEND)
    _label(axes, "training steps", _UNITS[column], f"{_TITLES[column]} over training steps")
    return bool(axes.lines)


def _draw_smoothed(axes: Axes, curve: dict[str, Any], label: str, style: dict[str, Any]) -> None:
    """Draw a curve as it is, and a long one pale below its moving average."""
    means = np.asarray(curve["mean"], np.float64)
    if len(means) < _LONG:
        _draw_curve(axes, curve, label, style)
        return
    (line,) = axes.plot(curve["steps"], means, linewidth=0.7, alpha=0.3, **style)
    smooth = {**curve, "mean": smooth_values(means, len(means) // _LONG * 2 + 1)}
    _draw_curve(axes, smooth, label, {**style, "color": line.get_color()})


def smooth_values(values: NDArray[np.float64], window: int) -> NDArray[np.float64]:
    """Return the moving average over `window` points, an odd number, shape (points,); over fewer at the ends."""
    weights = np.ones(window)
    return np.convolve(values, weights, "same") / np.convolve(np.ones(len(values)), weights, "same")


def plot_terms(recipe: RecipeRuns) -> str | None:
    """Return the weighted reward terms of a recipe over training steps; None where there are none."""
    figure, axes = _make_figure()
    for name in dict.fromkeys(name for run in recipe.runs for name in run.terms()):
        if (curve := mean_curve([run.metrics for run in recipe.runs], f"term/{name}")) is not None:
            _draw_curve(axes, curve, name, {"linewidth": 1.2})
    if not axes.lines:
        return None
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), **_LEGEND)
    title = "Reward terms over training steps" + (f"\n{recipe.name}" if recipe.name else "")
    return _finish(figure, axes, "training steps", "weighted sum per episode", title)


def _scale_rates(axes: Axes) -> None:
    axes.set_ylim(-0.03, 1.03)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))


def _draw_curve(axes: Axes, curve: dict[str, Any], label: str, style: dict[str, Any]) -> None:
    (line,) = axes.plot(curve["steps"], curve["mean"], label=label, **style)
    for _, step, value in curve.get("ended", ()):
        axes.plot(step, value, marker="x", ms=5, color=line.get_color())
    if curve["count"] > 1 and style.get("linestyle") == "none":
        axes.vlines(curve["steps"], curve["low"], curve["high"], color=line.get_color(), linewidth=1.0)
    elif curve["count"] > 1:
        axes.fill_between(curve["steps"], curve["low"], curve["high"], color=line.get_color(), alpha=0.2, linewidth=0)


def plot_robustness(result: RobustnessMap) -> str:
    """Return a map of success, or return where there is no success: a heat map, or a curve with its interval."""
    figure, axes = _make_figure()
    _draw_map(figure, axes, result)
    return _finish(figure, axes)


def _draw_map(figure: Figure, axes: Axes, varied: RobustnessMap) -> None:
    quantity = "success" if varied.has_success else "return"
    if len(varied.axes) == 1:
        _draw_varied(axes, varied, quantity)
        return
    rows, columns = varied.axes
    values = np.array([_value(cell, quantity) for cell in varied.cells])
    limits: dict[str, Any] = {"vmin": 0, "vmax": 1} if quantity == "success" else {}
    form = "{x:.0%}" if quantity == "success" else None
    _draw_heat(figure, axes, values, (rows, columns), _UNITS[quantity], {"cmap": "viridis", **limits}, form)
    for index, cell in enumerate(varied.cells):
        if cell.nominal:
            corner = index % len(columns.values) - 0.46, index // len(columns.values) - 0.46
            axes.add_patch(Rectangle(corner, 0.92, 0.92, fill=False, edgecolor="white", linewidth=1.5))
    _label(axes, columns.label, rows.label, f"{_TITLES[quantity]} by {rows.label} and {columns.label}")


def _draw_heat(
    figure: Figure,
    axes: Axes,
    values: NDArray[np.float64],
    varied: tuple[Axis, Axis],
    unit: str,
    limits: dict[str, Any],
    form: str | None,
) -> None:
    """Draw values, shape (cells,), as colours: the first axis upwards, the second to the right."""
    rows, columns = varied
    axes.grid(False)
    grid = values.reshape(len(rows.values), len(columns.values))
    image = axes.imshow(grid, origin="lower", aspect="auto", **limits)
    axes.set_xticks(*_choose_ticks(columns))
    axes.set_yticks(*_choose_ticks(rows))
    if grid.shape[1] <= _MOST_NUMBERS:
        _write_cells(axes, image, grid, form or "{x:.3g}")
    figure.colorbar(image, ax=axes, label=unit, format=form)


def _choose_ticks(axis: Axis) -> tuple[list[int], list[str]]:
    """Return which values of an axis are marked, and their texts: more would overlap."""
    marked = list(range(0, len(axis.values), math.ceil(len(axis.values) / _MOST_TICKS)))
    return marked, [_format_tick(axis.values[index]) for index in marked]


def _mark_values(axes: Axes, *, whole: bool) -> None:
    axes.xaxis.set_major_locator(MaxNLocator(_MOST_TICKS - 1, steps=[1, 2, 5, 10], integer=whole))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: _format_tick(value)))


def _format_tick(value: float) -> str:
    return f"{value:.3g}"


def _write_cells(axes: Axes, image: AxesImage, grid: NDArray[np.float64], form: str) -> None:
    """Write the value of each cell in it, black on light colours; nothing where the environment failed."""
    for (row, column), value in np.ndenumerate(grid):
        if math.isnan(value):
            continue
        red, green, blue, _ = image.to_rgba(np.array([value]))[0]
        is_light = 0.299 * red + 0.587 * green + 0.114 * blue > 0.5
        color = "black" if is_light else "white"
        axes.text(column, row, form.format(x=value), ha="center", va="center", fontsize=7, color=color)


def _draw_varied(axes: Axes, result: RobustnessMap, quantity: str) -> None:
    (axis,) = result.axes
    low, high = np.array([_interval(cell, quantity) for cell in result.cells], np.float64).T
    means = [_value(cell, quantity) for cell in result.cells]
    curve = {"steps": axis.values, "mean": means, "low": low, "high": high, "count": len(means)}
    _draw_curve(axes, curve, quantity, {"marker": "o", "ms": 3})
    if axis.nominal is not None:
        axes.axvline(axis.nominal, linestyle=":", color="gray", label="nominal")
        axes.legend(loc="best", **_LEGEND)
    if quantity == "success":
        _scale_rates(axes)
    _label(axes, axis.label, _UNITS[quantity], f"{_TITLES[quantity]} by {axis.label}")
    _mark_values(axes, whole=axis.whole)


def plot_push(test: PushTest) -> str:
    """Return the fraction of episodes that go well over the impulse of the push."""
    figure, axes = _make_figure()
    axes.plot([level.impulse for level in test.levels], [level.held for level in test.levels], marker="o", ms=3)
    if test.threshold is not None:
        axes.axvline(test.threshold, linestyle=":", color="gray")
    _scale_rates(axes)
    return _finish(figure, axes, "push [N s]", f"episodes: {test.measure}", f"{test.measure.capitalize()} by push")


def _value(cell: Cell | FailedCell, quantity: str) -> float:
    """Return a score of a cell, NaN where the environment failed: nothing is drawn there."""
    if isinstance(cell, FailedCell):
        return math.nan
    if quantity == "success" and cell.success_rate is not None:
        return cell.success_rate
    return cell.mean_return


def _interval(cell: Cell | FailedCell, quantity: str) -> tuple[float, float]:
    if isinstance(cell, FailedCell):
        return math.nan, math.nan
    if quantity == "success" and cell.success_interval is not None:
        return cell.success_interval
    return cell.return_interval


def _make_figure() -> tuple[Figure, Axes]:
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=_SIZE, layout="constrained")
        return figure, figure.add_subplot()


def _label(axes: Axes, x: str, y: str, title: str) -> None:
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.set_title(title, loc="left", fontsize=9, fontweight="bold")
    if x == "training steps":
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))


def _finish(figure: Figure, axes: Axes, *labels: str) -> str:
    if labels:
        _label(axes, *labels)
    file = io.StringIO()
    with matplotlib.rc_context(_STYLE):
        figure.savefig(file, format="svg", transparent=True, metadata=_NO_METADATA)
    svg = file.getvalue()[file.getvalue().index("<svg") :].replace("#000000", "currentColor")  # the page's text colour
    # The page scales the plot; screen readers read its name.
    name = axes.get_title(loc="left").replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;")
    return re.sub(
        r'^<svg ([^>]*?)width="[^"]*"',
        rf'<svg role="img" aria-label="{name}" \1',
        re.sub(r' height="[^"]*pt"', "", svg, count=1),
    )
