"""Writes a report as one HTML file that needs nothing else, as Markdown, or its curves alone as a picture."""

import base64
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import jinja2

from rlctl import output
from rlctl.errors import RlctlError, UsageError
from rlctl.evaluation.eval_request import EvalRequest
from rlctl.runs.compare.comparison import compare_runs
from rlctl.runs.compare.report import describe_candidate, describe_seeds, describe_tests, describe_verdict
from rlctl.runs.report import content
from rlctl.runs.report.content import RunReport
from rlctl.runs.report.show import describe_robustness, tabulate
from rlctl.runs.tables import TableRows
from rlctl.storage import files

_PICTURES = 6  # of an episode
PICTURES: tuple[Literal["svg", "pdf", "png"], ...] = ("svg", "pdf", "png")  # formats of curves alone


ReportForm = Literal["html", "md", "table", "csv", "latex", "svg", "pdf", "png"]
_SUFFIXES: dict[str, ReportForm] = {".html": "html", ".md": "md", ".csv": "csv", ".tex": "latex"}
_SUFFIXES |= {f".{form}": form for form in PICTURES}
_EPISODES = 100


def write_report(
    runs: Sequence[str],
    form: ReportForm | None = None,
    target: Path | None = None,
    *,
    pictures: bool = True,
    episodes: int | None = None,
    labels: Sequence[str] = (),
) -> Path | None:
    """Write a report, its learning curves alone (svg, pdf, png), or its results alone (table, csv, latex).

    Return its file; None for a text that was printed. Without `form` the suffix of `target` chooses it.

    Runs of several recipes are compared first, each plays `episodes` for it, by default 100; 0 leaves it out. `labels`
    name the recipes in curves and tables. Raises `UsageError` for an option that has no effect.
    """
    form = _choose_form(form, target)
    _refuse_options(form, pictures=pictures, episodes=episodes, labels=labels)
    report = content.collect(runs, labels)
    path = target or Path(f"report.{form}")
    if form in ("table", "csv", "latex"):
        return _write_text(_format_results(report, form), target)
    if form in ("svg", "pdf", "png"):
        from rlctl.runs.report import plots

        files.write_result(path, plots.draw_learning(report, form))
        return path
    is_html = form == "html"
    finalize = None if is_html else _escape_html
    environment = jinja2.Environment(
        autoescape=is_html, trim_blocks=True, undefined=jinja2.StrictUndefined, finalize=finalize
    )
    template = environment.from_string(Path(__file__).with_name(f"report.{form}.jinja").read_text(encoding="utf-8"))
    text = template.render(_values(report, is_html, pictures, _EPISODES if episodes is None else episodes))
    return _write_text(text, path if is_html else target)


def _choose_form(form: ReportForm | None, target: Path | None) -> ReportForm:
    suffix = None if target is None else _SUFFIXES.get(target.suffix)
    if form is None:
        return suffix or "html"
    is_markdown = form == "table" and suffix == "md"
    if suffix is not None and suffix != form and not is_markdown:
        raise UsageError(f"--output {target} is the name of another format than --format {form}: leave one of them out")
    return form


def _refuse_options(form: ReportForm, *, pictures: bool, episodes: int | None, labels: Sequence[str]) -> None:
    ignored = []
    if not pictures and form != "html":
        ignored.append("--no-pictures")
    if episodes and form not in ("html", "md"):
        ignored.append("--episodes")
    if labels and form == "md":
        ignored.append("--label")
    if ignored:
        raise UsageError(f"{ignored[0]} has no effect with the format {form}: leave it out")


def _format_results(report: RunReport, form: ReportForm) -> str:
    from rlctl.runs.report import results

    rows = results.list_results(report)
    if form == "csv":
        return results.format_csv(rows)
    if form == "latex":
        return results.format_latex(report, rows)
    return results.format_markdown(rows)


def _write_text(text: str, target: Path | None) -> Path | None:
    """Write a text to a file, or without one to stdout."""
    if target is None:
        output.results().write(output.escape_controls(text))
        return None
    files.write_result(target, text.encode(errors="backslashreplace"))
    return target


def _escape_html(value: Any) -> Any:
    """Escape HTML in a text for Markdown; code blocks are marked as safe and stay unchanged."""
    if hasattr(value, "__html__") or not isinstance(value, str):
        return value
    return value.replace("&", "&amp;").replace("<", "&lt;")


def _values(report: RunReport, is_html: bool, pictures: bool, episodes: int) -> dict[str, Any]:
    file = report.runs[0].run.recipe_file
    recipe = file.read_text(encoding="utf-8", errors="replace").strip() if file.is_file() else "(missing)"
    verdicts, notes = _compare(report, episodes)
    values = {
        "title": report.title,
        "verdicts": verdicts,
        "results": [
            ": ".join(filter(None, (recipe.name, content.summarize_result(recipe.runs)))) for recipe in report.recipes
        ],
        "facts": content.list_facts(report),
        "notes": [*notes, *report.notes],
        "findings": content.collect_findings(report),
        "followers": content.collect_followers(report),
        "absence": content.describe_absence(report),
        "runs": [
            (f"{run.summary.name}{recipe.name and f' ({recipe.name})'}", _split_terms(run.evaluations))
            for recipe in report.recipes
            for run in recipe.runs
        ],
        "robustness": list(_describe_robustness(report)),
        "commands": content.list_commands(report),
        "recipe_name": report.recipes[0].name,
        "recipe": recipe,
    }
    return {**values, **_draw(report, pictures)} if is_html else values


def _describe_robustness(report: RunReport) -> Iterator[str]:
    for run in report.runs:
        of_run = f"{run.summary.name}: " if len(report.runs) > 1 else ""
        if run.robustness is not None:
            for line in describe_robustness(run.robustness):
                yield f"{of_run}{line}"


def _compare(report: RunReport, episodes: int) -> tuple[list[tuple[str, str, list[str]]], list[str]]:
    """Return question, verdict and evidence per candidate, and notes, such as why nothing was compared."""
    if not episodes or len(report.recipes) == 1:
        return [], []
    names = [recipe.name for recipe in report.recipes]
    groups = [[run.run for run in recipe.runs] for recipe in report.recipes]
    try:
        result = compare_runs(names, groups, EvalRequest(None, episodes=episodes))
    except RlctlError as error:
        return [], [f"not compared: {str(error).splitlines()[0]}"]
    seeds = [describe_seeds(result, side) for side in result.sides] if result.of_recipes else []
    verdicts = [
        (
            f"{candidate.side.name} against {result.baseline.name}",
            describe_verdict(result, candidate),
            [*seeds, *describe_candidate(result, candidate), describe_tests(result)],
        )
        for candidate in result.candidates
    ]
    worlds = result.world_differences
    return verdicts, [f"all runs were evaluated with the baseline's {', '.join(worlds)}"] if worlds else []


def _split_terms(rows: TableRows) -> list[tuple[list[str], list[list[str]]]]:
    """Return the table of evaluations, and that of the reward terms if there are any, as columns and cells."""
    main = [{name: value for name, value in row.items() if not name.startswith("term/")} for row in rows]
    terms = [{name: value for name, value in row.items() if name.startswith(("term/", "steps"))} for row in rows]
    return [
        ([name.removeprefix("term/") for name in columns], cells)
        for columns, cells in map(tabulate, (main, terms))
        if len(columns) > 1
    ]


def _draw(report: RunReport, pictures: bool) -> dict[str, Any]:
    from rlctl.runs.report import plots

    learning = [plots.plot_learning(report, name) for name in ("return", "success")]
    learning += [plots.plot_terms(recipe) for recipe in report.recipes]
    measured = [run.robustness for run in report.runs if run.robustness is not None]
    maps = [plots.plot_robustness(varied) for result in measured for varied in result.maps if len(varied.axes) <= 2]
    maps += [plots.plot_push(result.push) for result in measured if result.push is not None]
    return {
        "learning": [plot for plot in learning if plot is not None],
        "maps": maps,
        "pictures": list(_take_pictures(report)) if pictures else [],
    }


def _take_pictures(report: RunReport) -> Iterator[tuple[str, list[tuple[int, str]]]]:
    from rlctl.replaying.pictures import take_pictures

    for name, episode in content.choose_episodes(report):
        try:
            strip = take_pictures(episode, _PICTURES)
        except RlctlError as error:  # the task has changed, or cannot draw
            output.print_notes([f"no pictures: {str(error).splitlines()[0]}"])
            return
        depth = 1000 * strip.deepest_contact  # [mm]
        overlap = f"; bodies overlap by up to {depth:.0f} mm" if depth > 1 else ""
        yield name + overlap, [(step, base64.b64encode(picture).decode()) for step, picture in strip.pictures]
