"""What `rlctl eval --vary` and `--push` print: heat maps and the push that a policy withstands."""

from __future__ import annotations

import json
import shlex
from typing import TYPE_CHECKING

from rlctl import output
from rlctl.evaluation.axes import SIM
from rlctl.run.robustness import Cell, Outcome, PushTest, Robustness, RobustnessMap

if TYPE_CHECKING:
    from rich.text import Text

_MOST_COLUMNS = 25  # of a map that is drawn
_MOST_ROWS = 60
_NOMINAL, _WORST = "*", "<"


def show(result: Robustness, target: str | None) -> None:
    """Print the maps and the push, or JSON alone for `-`."""
    if output.present(result.model_dump(mode="json"), target):
        return
    out = output.out()
    out.print(f"{result.task}: {result.policy_file} ({result.algo}, step {result.training_steps:,})")
    mode = "" if result.deterministic else ", sampled actions"
    out.print(
        f"{output.format_count(result.episodes, 'episode')} in every cell, the same seeds (seed {result.seed}){mode}"
    )
    out.print(f"nominal: {format_outcome(result.nominal)}")
    worst = result.find_worst()
    for varied in result.maps:
        out.print()
        _show_map(varied, worst[1] if worst else None)
    if worst is not None:
        varied, cell = worst
        out.print(f"\nworst: {varied.name_cell(cell)}: {format_outcome(cell)}")
        out.print(f"the same episodes alone: {format_command(result, varied, cell)}")
    if result.push is not None:
        out.print()
        _show_push(result.push)


def format_command(result: Robustness, varied: RobustnessMap, cell: Cell) -> str:
    """Return the command that plays the episodes of one cell."""
    settings = {f"task.{name}": json.dumps(value) for name, value in result.parameters.items()}
    settings |= {f"reward_weights.{name}": json.dumps(value) for name, value in result.reward_weights.items()}
    for name, event in result.events.items():
        settings |= {f"events.{name}.{key}": json.dumps(value) for key, value in event.items()} or {
            f"events.{name}": "{}"
        }
    settings["randomize"] = "false"
    engine = []
    for axis, value in zip(varied.axes, cell.values, strict=True):
        if axis.setting == SIM:
            engine = ["--sim", f"mujoco:{value:g}"]
            continue
        settings[axis.setting] = str(int(value) if value.is_integer() else value)
    words = ["rlctl", "eval", result.policy_file, "--episodes", str(result.episodes), "--seed", str(result.seed)]
    words += [*engine, *([] if result.deterministic else ["--stochastic"])]
    return shlex.join([*words, *(word for key, value in settings.items() for word in ("--set", f"{key}={value}"))])


def format_outcome(outcome: Outcome) -> str:
    """Return an outcome for people: `success 97.0 % (91.5 to 99.0), return 123 (119 to 127)`."""
    parts = []
    if outcome.success_rate is not None and outcome.success_interval is not None:
        low, high = outcome.success_interval
        parts.append(f"success {outcome.success_rate:.1%} ({low:.1%} to {high:.1%})")
    low, high = outcome.return_interval
    return ", ".join([*parts, f"return {outcome.mean_return:.4g} ({low:.4g} to {high:.4g})"])


def _show_map(varied: RobustnessMap, worst: Cell | None) -> None:
    out = output.out()
    columns, rows = len(varied.axes[-1].values), len(varied.cells) // len(varied.axes[-1].values)
    if len(varied.axes) == 1 and columns <= _MOST_ROWS:
        _show_list(varied, worst)
    elif columns <= _MOST_COLUMNS and rows <= _MOST_ROWS:
        _show_grid(varied, worst)
    else:
        names = " x ".join(axis.name for axis in varied.axes)
        out.print(f"{names}: {len(varied.cells):,} cells, too many to draw; --json has them all")


def _show_list(varied: RobustnessMap, worst: Cell | None) -> None:
    has_success = varied.cells[0].success_rate is not None
    successes = ("success", "95 % interval") if has_success else ()
    rows = []
    for cell, color in zip(varied.cells, _color_cells(varied), strict=True):
        cells: list[str | Text] = [f"{cell.values[0]:g}"]
        if cell.success_rate is not None:
            cells += [_paint(f"{cell.success_rate:.1%}", color), _format_interval(cell.success_interval, percent=True)]
        value = f"{cell.mean_return:.4g}"
        cells += [value if has_success else _paint(value, color), _format_interval(cell.return_interval)]
        marks = [*(["nominal"] if cell.nominal else []), *(["worst"] if cell is worst else [])]
        rows.append([*cells, ", ".join(marks)])
    output.print_table((varied.axes[0].name, *successes, "return", "95 % interval", ""), rows, left=("",))


def _format_interval(interval: tuple[float, float] | None, *, percent: bool = False) -> str:
    if interval is None:
        return "-"
    low, high = interval
    return f"{low:.1%} to {high:.1%}" if percent else f"{low:.4g} to {high:.4g}"


def _show_grid(varied: RobustnessMap, worst: Cell | None) -> None:
    """Print a heat map: the first axis downwards, the second across."""
    down, across = varied.axes
    has_success = varied.cells[0].success_rate is not None
    cells = list(zip(varied.cells, _color_cells(varied), strict=True))
    width = len(across.values)
    rows: list[list[str | Text]] = [
        [f"{value:.3g} ", *(_draw_cell(cell, color, cell is worst) for cell, color in cells[start : start + width])]
        for value, start in zip(down.values, range(0, len(cells), width), strict=True)
    ]
    columns = [f"{down.name} \\ {across.name} ", *(f" {value:.3g} " for value in across.values)]
    output.print_table(columns, rows, gap="")
    out = output.out()
    marks = [*([f"{_NOMINAL} nominal"] if any(cell.nominal for cell in varied.cells) else []), f"{_WORST} worst"]
    out.print(f"{'success [%]' if has_success else 'mean return'}; {', '.join(marks)}")


def _draw_cell(cell: Cell, color: str, is_worst: bool) -> Text:
    text = f"{cell.mean_return:.3g}" if cell.success_rate is None else f"{100 * cell.success_rate:.0f}"
    mark = f"{_NOMINAL if cell.nominal else ''}{_WORST if is_worst else ''}"
    return _paint(f" {text}{mark or ' '}", color)


def _paint(text: str, color: str) -> Text:
    from rich.text import Text

    return Text(text, style=f"black on {color}")


def _color_cells(varied: RobustnessMap) -> list[str]:
    """Return a colour per cell, from red over yellow to green: of success rates from 0 to 1, else of the returns."""
    rates = [cell.success_rate for cell in varied.cells]
    returns = [cell.mean_return for cell in varied.cells]
    low, high = min(returns), max(returns)
    parts = [
        (mean - low) / (high - low or 1.0) if rate is None else rate for rate, mean in zip(rates, returns, strict=True)
    ]
    return [f"rgb({min(255, round(510 * (1 - part)))},{min(255, round(510 * part))},80)" for part in parts]


def _show_push(push: PushTest) -> None:
    out = output.out()
    what = push.body if push.link is None else f"{push.link} of {push.body}"
    out.print(f"push on {what} in the middle of the episode, {push.duration_s:g} s, from a random side")
    held = "success" if push.measure == "success" else "up to the end"
    speeds = [level.impulse / push.mass if push.mass else 0.0 for level in push.levels]
    rows = [
        (f"{level.impulse:.3g}", f"{speed:.2g}", f"{level.held:.1%}", f"{level.mean_return:.4g}")
        for level, speed in zip(push.levels, speeds, strict=True)
    ]
    output.print_table(("push [N s]", "of a speed of [m/s]", held, "return"), rows)
    out.print(push.verdict)
