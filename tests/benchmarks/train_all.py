"""Trains every bundled task with several seeds, and writes the score tables of the plugins' READMEs: `make train-all`.

What is trained already stays, what was stopped goes on; a task whose runs are not here keeps its row. The numbers come
from the runs: means over seeds of the best policies' scores, over 100 episodes that their training has not seen, and
the spread over seeds.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import re
import statistics
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rlctl.entry_points import OURS
from rlctl.environments import installed, registry
from rlctl.evaluation.eval_request import EvalRequest
from rlctl.evaluation.group_scores import evaluate_group
from rlctl.runs.directory import GROUP_FILE
from rlctl.runs.group import Group, parse_seeds, read_group
from rlctl.runs.train_request import TrainRequest
from rlctl.storage import files

BEGIN, END = "<!-- scores: make train-all -->\n", "<!-- end of scores -->\n"
_SEED = re.compile(r"_s(\d+)(_\d+)?$")  # of a run folder's name
HEAD = """\
| task | algorithm | seeds | steps | minutes | success | return | action change | ended early |
|---|---|---|---|---|---|---|---|---|
"""


def list_tasks() -> list[str]:
    """Return the bundled tasks."""
    return [each.name for each in installed.list_installed() if each.distribution in OURS]


def find_group(task: str, seeds: Sequence[int], root: Path) -> Group | None:
    """Return the newest group of a task's runs, or its runs of these seeds outside of groups, if there are all."""
    groups = sorted((root / registry.make_slug(task)).glob(f"*_seeds/{GROUP_FILE}"))
    if groups:
        return read_group(groups[-1].parent)
    alone = Group(root / registry.make_slug(task), list(seeds), TrainRequest(task))
    return alone if all(alone.is_done(seed) for seed in seeds) else None


def find_finished(task: str, root: Path) -> Group | None:
    """Return the finished runs of a task outside of groups, a run per seed; None if there are none."""
    folder = root / registry.make_slug(task)
    seeds = {int(match[1]) for file in folder.glob("*/run.json") if (match := _SEED.search(file.parent.name))}
    alone = Group(folder, [], TrainRequest(task))
    finished = sorted(seed for seed in seeds if alone.is_done(seed))
    return dataclasses.replace(alone, seeds=finished) if finished else None


def train(task: str, seeds: str, root: Path) -> int:
    """Train what is missing of a task; return the exit code."""
    group = find_group(task, parse_seeds(seeds), root)
    if group is not None and all(group.is_done(seed) for seed in group.seeds):
        return 0
    what = ["--resume", str(group.path)] if group is not None else [task, "--seeds", seeds, "--output", str(root)]
    return subprocess.run([sys.executable, "-m", "rlctl", "train", *what], check=False).returncode


def read_scores(group: Group) -> dict[str, Any]:
    """Return the scores of a group, from its file if that has the same runs and is newer; else they are measured."""
    runs = [run for seed in group.seeds if (run := group.find_run(seed)) is not None]
    file = group.scores_file
    newest = max((run.status_file.stat().st_mtime for run in runs), default=0.0)
    content: dict[str, Any] = {}
    if file.is_file() and file.stat().st_mtime >= newest:
        content = json.loads(file.read_text())
    if not content or [each["seed"] for each in content["seeds"]] != group.seeds:
        content = evaluate_group(group, EvalRequest(None)).as_json()
        files.write_json(file, content)
    return content


def format_row(scores: dict[str, Any]) -> str:
    """Return a task's row of the table; one of a task without a score says why."""
    known = [each for each in scores["seeds"] if each["score"] is not None]
    if not known:
        return f"| `{scores['task']}` | | | | | {scores['seeds'][0]['problem']} | | | |\n"
    measured = [each["score"] for each in known]
    success, returns = ([each[key] for each in measured] for key in ("success", "mean_return"))
    early = [each["ended_early"] for each in measured if each["ended_early"] is not None]
    cells = [
        f"`{scores['task']}`",
        known[0]["algo"],
        ", ".join(str(each["seed"]) for each in known),
        _list([each["steps"] for each in known if each["steps"] is not None], ",.0f"),
        _list([each["seconds"] / 60 for each in known if each["seconds"] is not None], ".1f"),
        "" if None in success else _list([100 * each for each in success], ".0f", " %", spread=True),
        _list(returns, ".4g", spread=True),
        _list([each["action_change"] for each in measured], ".2f"),
        _list([100 * each for each in early], ".0f", " %"),
    ]
    return f"| {' | '.join(cells)} |\n"


def _list(values: list[float], form: str, unit: str = "", *, spread: bool = False) -> str:
    """Return the values of the seeds, once if all are alike, and with `spread` their mean and standard deviation."""
    texts = [f"{value:{form}}" for value in values]
    text = ", ".join(texts if spread or len(set(texts)) > 1 else texts[:1]) + (unit if texts else "")
    if spread and len(values) > 1:
        text += f" (mean {statistics.fmean(values):{form}} ± {statistics.stdev(values):{form}})"
    return text


def format_table(scores: Sequence[dict[str, Any]], rows: Mapping[str, str] | None = None) -> str:
    """Return the table of some tasks, with what its numbers are; `rows` are those of tasks whose runs are not here."""
    rows = {**(rows or {}), **{each["task"]: format_row(each) for each in scores}}
    first = next((each["score"] for one in scores for each in one["seeds"] if each["score"] is not None), None)
    note = (
        "Values of the training seeds in their order, one where all are alike; ± is the standard deviation between them"
    )
    if first is not None:
        note += f"; {first['episodes']} episodes each, which no training has seen"
    return HEAD + "".join(rows[task] for task in sorted(rows)) + f"\n{note}.\n"


def read_rows(readme: Path) -> dict[str, str]:
    """Return the rows of a README's table, by task."""
    _, _, rest = readme.read_text().partition(BEGIN)
    table, _, _ = rest.partition(END)
    return {match[1]: match[0] for match in re.finditer(r"^\| `([\w-]+)` \|.*\n", table, re.MULTILINE)}


def write_table(readme: Path, table: str) -> None:
    """Put a table between the marks of a README, which get their place at its end if there are none."""
    text = readme.read_text()
    if BEGIN not in text:
        text = f"{text.rstrip()}\n\n## Scores\n\n{BEGIN}{END}"
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    readme.write_text(f"{before}{BEGIN}\n{table}\n{END}{after}")


def main() -> int:
    """Train what is missing and write the tables; return the highest exit code of a training."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tasks", nargs="*", help="these tasks only; default: all")
    parser.add_argument("--seeds", default="1-3", help="training seeds of what is begun")
    parser.add_argument("--root", type=Path, default=Path("runs"), help="where run folders are")
    parser.add_argument("--table-only", action="store_true", help="train nothing")
    options = parser.parse_args()
    worst, by_readme = 0, {}
    for task in list_tasks():
        if not options.table_only and (not options.tasks or task in options.tasks):
            code = train(task, options.seeds, options.root)
            if code in (129, 130, 143):
                return code
            worst = max(worst, code)
        group = find_group(task, parse_seeds(options.seeds), options.root) or find_finished(task, options.root)
        entry = installed.find(task)
        if group is not None and entry is not None and entry.module_file is not None:
            by_readme.setdefault(entry.module_file.with_name("README.md"), []).append(read_scores(group))
    for readme, scores in by_readme.items():
        write_table(readme, format_table(scores, read_rows(readme)))
    return worst


if __name__ == "__main__":
    sys.exit(main())
