"""Prints who earned what: the verdict in a line, a table of returns by term, and JSON."""

from typing import Any

from rich.text import Text

from rlctl import output
from rlctl.checking.audit import FORMAT
from rlctl.checking.audit.audit import AuditReport
from rlctl.checking.audit.competitors import Kind
from rlctl.checking.audit.ranking import Beaten, MeanScore

STYLES = {Kind.wanted: "green", Kind.moved: "green", Kind.learned: "cyan"}
MOST_NAMED = 5  # of the other competitors that earn as much


def show(report: AuditReport, json: str | None) -> None:
    """Print the verdict and the table, or JSON alone for `-`."""
    if output.present(to_json(report), json):
        return
    out = output.out()
    style = "bold red" if report.ranking.beaten else "bold"
    out.print(Text(f"{report.task}: {report.verdict}", style if out.is_terminal else ""))
    if others := _name_others(report):
        out.print(others)
    for sentence in report.ranking.paid_still:
        out.print(sentence)
    if report.ranking.learned:
        out.print(report.ranking.learned)
    _print_rows(report)
    for name, why in report.not_played.items():
        out.print(f"not played: {name}: {why}")
    if report.is_cut:
        out.print("time ran out before all episodes were played; --budget SECONDS gives more")


def _name_others(report: AuditReport) -> str:
    others = report.ranking.beaten[1:]
    if not others:
        return ""
    named = [_name_share(one) for one in others[:MOST_NAMED]]
    rest = len(others) - len(named)
    more = f" and {rest} more" if rest else ""
    return f"so do: {', '.join(named)}{more}"


def _name_share(one: Beaten) -> str:
    return one.competitor if one.share is None else f"{one.competitor} ({100 * one.share:.0f} %)"


def _print_rows(report: AuditReport) -> None:
    rows = report.ranking.rows
    terms = list(rows[0].terms)
    has_success = any(row.success_rate is not None for row in rows)
    columns = ["who", "return", "steps", *terms]
    if has_success:
        columns.insert(2, "success")
    lines = [_format_row(row, terms, has_success, report) for row in rows]
    least = sorted(terms, key=lambda term: max(abs(row.terms.get(term, 0.0)) for row in rows))
    output.print_table(columns, lines, left=["who"], drop=least)


def _format_row(row: MeanScore, terms: list[str], has_success: bool, report: AuditReport) -> list[str | Text]:
    style = STYLES.get(row.kind, "")
    if any(one.competitor == row.name for one in report.ranking.beaten):
        style = "red"
    values = [f"{row.terms.get(term, 0.0):.4g}" for term in terms]
    cells: list[str | Text] = [Text(row.name, style), f"{row.mean_return:.4g}", f"{row.steps:.0f}", *values]
    if has_success:
        cells.insert(2, "" if row.success_rate is None else f"{row.success_rate:.0%}")
    return cells


def to_json(report: AuditReport) -> dict[str, Any]:
    """Return the report as plain data."""
    ranking = report.ranking
    return {
        "format": FORMAT,
        "task": report.task,
        "verdict": report.verdict,
        "wanted": ranking.wanted or None,
        "beaten": [
            {
                "competitor": one.competitor,
                "wanted": one.wanted,
                "return": one.mean_return,
                "wanted_return": one.wanted_return,
                "share": one.share,
                "term": one.term or None,
                "pays": one.pays,
                "message": one.describe(),
            }
            for one in ranking.beaten
        ],
        "paid_still": list(ranking.paid_still),
        "learned": ranking.learned or None,
        "competitors": [
            {
                "name": row.name,
                "kind": row.kind,
                "episodes": row.episodes,
                "return": row.mean_return,
                "discounted_return": row.discounted,
                "success": row.success_rate,
                "steps": row.steps,
                "terms": dict(row.terms),
            }
            for row in ranking.rows
        ],
        "not_played": report.not_played,
        "out_of_time": report.is_cut,
        "seconds": report.seconds,
    }
