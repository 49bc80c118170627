"""What `rlctl identify` prints."""

import dataclasses
import sys

import yaml

from rlctl import output
from rlctl.deploy.identify.excite import Excitation
from rlctl.deploy.identify.identify import Identification, IdentifiedValue

_PLOT_SIZE = (100, 18)
_PLOT_POINTS = 400


def show(result: Identification, json: str | None) -> None:
    """Print the values with their intervals, or write them as JSON to a file or, for `-`, to stdout."""
    if output.present({**dataclasses.asdict(result), "events": result.events()}, json):
        return
    out = output.out()
    out.print(f"{result.task}: {result.log}, {result.rows:,} rows, {result.seconds:.1f} s")
    for line in _list_lines(result):
        out.print(line)
    if sys.stdout.isatty():
        out.print(draw_curves(result))
    out.print("\nto train with these values, add to a recipe:")
    out.print(write_fragment(result), end="")


def write_fragment(result: Identification) -> str:
    """Return the part of a recipe with the estimated values as intervals."""
    return yaml.safe_dump({"events": result.events()}, sort_keys=False, default_flow_style=None)


def _list_lines(result: Identification) -> list[str]:
    width = max([len(value.name) for value in result.values] + [len(result.delay_event) + 6, len("position error")])
    lines = [f"{value.name:<{width}}  {_format_value(value)}" for value in result.values]
    if result.delay_event:
        note = "" if result.delay_known else "; one step more or less fits this log as well"
        lines.append(f"{result.delay_event + '.steps':<{width}}  {result.delay}{note}")
    for name, (before, after) in (("position error", result.position_error), ("velocity error", result.velocity_error)):
        lines.append(f"{name:<{width}}  {before:.3g} -> {after:.3g}, root mean square over windows of 1 s")
    return lines


def _format_value(value: IdentifiedValue) -> str:
    if value.known:
        return f"{value.value:.4g}, 95 % in [{value.low:.4g}, {value.high:.4g}]"
    return f"not known: {value.note}"


def draw_curves(result: Identification) -> str:
    """Return a plot in characters of the joint with the largest error, measured and simulated."""
    import plotext

    plotext.clear_figure()
    plotext.plotsize(*_PLOT_SIZE)
    plotext.title(f"{result.curves['joint']}: position over rows")
    for label in ("measured", "before", "after"):
        plotext.plot(result.curves[label][:_PLOT_POINTS], label=label)
    return str(plotext.uncolorize(plotext.build()))


def show_excitation(result: Excitation, json: str | None) -> None:
    """Print the trajectory's file and how much of the ranges it uses."""
    if output.present(result, json):
        return
    output.out().print(
        f"{result.path}: {result.seconds:g} s for {result.task}, {result.amplitude:.0%} of the action range\n"
        f"in simulation the joints use {result.largest_share:.0%} of their range (without margins), touch nothing "
        "and stay below their top speeds; the robot's cables and surroundings are not simulated\n"
        f"play its actions on the robot, log the same columns, then: rlctl identify {result.task} --log FILE"
    )
