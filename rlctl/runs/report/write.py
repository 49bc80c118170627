"""Writes a report as one HTML file that needs nothing else, or as Markdown for pull requests."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

from rlctl import output
from rlctl.errors import RlctlError
from rlctl.runs.report import content
from rlctl.runs.report.content import Report
from rlctl.runs.show import describe_robustness, tabulate
from rlctl.storage import files

DEFAULT_FILE = Path("report.html")

_PICTURES = 6
"""Of an episode."""


def write_report(
    runs: Sequence[str], form: Literal["html", "md"] = "html", target: Path | None = None, *, pictures: bool = True
) -> Path | None:
    """Write a report and return its file, by default report.html; None for Markdown that was printed.

    Raises `UsageError` for runs of several tasks, `ArtifactError` for a damaged run or one that has nothing yet.
    """
    report = content.collect(runs)
    is_html = form == "html"
    text = _render(f"report.{form}.jinja", is_html, _values(report, is_html, pictures))
    if target is None and not is_html:
        output.results().write(output.escape_controls(text))
        return None
    path = target or DEFAULT_FILE
    files.write_bytes(path, text.encode())
    return path


def _render(template: str, escape: bool, values: dict[str, Any]) -> str:
    import jinja2

    finalize = None if escape else _escape_html
    environment = jinja2.Environment(
        autoescape=escape, trim_blocks=True, undefined=jinja2.StrictUndefined, finalize=finalize
    )
    return environment.from_string(Path(__file__).with_name(template).read_text(encoding="utf-8")).render(values)


def _escape_html(value: Any) -> Any:
    """Return a text for Markdown, in which HTML would act; a block of code is marked as safe and stays as it is."""
    if hasattr(value, "__html__") or not isinstance(value, str):
        return value
    return value.replace("&", "&amp;").replace("<", "&lt;")


def _values(report: Report, is_html: bool, pictures: bool) -> dict[str, Any]:
    first = report.runs[0]
    values = {
        "title": report.title,
        "result": content.summarize_result(report),
        "notes": report.notes,
        "findings": content.collect_findings(report),
        "runs": [(each.summary.name, *tabulate(each.evaluations)) for each in report.runs],
        "robustness": [
            line for each in report.runs if each.robustness is not None for line in describe_robustness(each.robustness)
        ],
        "commands": content.list_commands(report),
        "versions": ", ".join(f"{name} {version}" for name, version in first.summary.versions.items()),
        "recipe": first.run.recipe_file.read_text(encoding="utf-8", errors="replace").strip()
        if first.run.recipe_file.is_file()
        else "(missing)",
    }
    return {**values, **_drawings(report, pictures)} if is_html else values


def _drawings(report: Report, pictures: bool) -> dict[str, Any]:
    from rlctl.runs.report import plots

    learning = [plots.plot_learning(report, "return"), plots.plot_learning(report, "success"), plots.plot_terms(report)]
    measured = [each.robustness for each in report.runs if each.robustness is not None]
    maps = [plots.plot_robustness(each) for result in measured for each in result.maps if len(each.axes) <= 2]
    maps += [plots.plot_push(result.push) for result in measured if result.push is not None]
    return {
        "learning": [plot for plot in learning if plot is not None],
        "band": f"Mean of {len(report.runs)} trainings, from the lowest to the highest."
        if len(report.runs) > 1
        else "",
        "maps": maps,
        "pictures": list(_take_pictures(report)) if pictures else [],
    }


def _take_pictures(report: Report) -> Iterator[tuple[str, list[tuple[int, str]]]]:
    from rlctl.replaying.view import take_pictures

    for name, episode in content.choose_episodes(report):
        try:
            strip = take_pictures(episode, _PICTURES)
        except RlctlError as error:  # another task by now, or one that cannot draw
            output.print_notes([f"no pictures: {str(error).splitlines()[0]}"])
            return
        depth = 1000 * strip.deepest_contact  # [mm]
        overlap = f"; bodies overlap by up to {depth:.0f} mm" if depth > 1 else ""
        yield name + overlap, [(step, base64.b64encode(picture).decode()) for step, picture in strip.pictures]
