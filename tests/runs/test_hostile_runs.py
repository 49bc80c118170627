"""What stands in a run folder, and its name, is text: no terminal obeys it, and nothing in it is a traceback."""

import json
import os
import random

import pytest

from rlctl.errors import ArtifactError, RlctlError
from rlctl.runs import listing
from rlctl.runs.directory import RunDirectory
from rlctl.runs.report import show
from rlctl.runs.report.write import write_report
from rlctl.runs.summary import summarize

RED = "\x1b[31mred\x1b]0;title\x07\x9b2J"


def test_escape_sequences_never_reach_the_terminal(write_run, rlctl):
    name = f"reach/2026-11-21_10-00-00{RED}_s0"
    folder = write_run(
        name, status="failed", error=RED, algo=RED, recipe_changes={RED: RED}, versions={RED: RED}, started=RED
    )
    write_run("reach/2026-11-21_11-00-00_s0", algo="ppo")
    (folder.parent / RED).mkdir()
    shown = rlctl("runs").stdout
    assert r"2026-11-21_10-00-00\x1b[31mred\x1b]0;title" in shown
    outputs = [
        rlctl("runs", "show", folder),
        rlctl("runs", "report", folder, "--format", "md"),
        rlctl("runs", "show", f"nowhere{RED}"),
        rlctl("runs", "rm", folder),
        rlctl("eval", folder),
    ]
    assert [done.returncode for done in outputs] == [0, 0, 5, 2, 5]
    for text in (shown, *(done.stdout + done.stderr for done in outputs)):
        assert r"\x1b[31mred" in text
        assert not {"\x1b", "\x07", "\x9b"} & set(text)


def test_markdown_has_no_html_of_a_run(write_run, rlctl):
    folder = write_run("reach/2026-11-21_10-00-00<b>_s0", status="failed", error="<img src=x> & more", algo="<i>")
    (folder / "recipe.yaml").write_text("algo: <ppo>\n```\n<script>\n")
    text = rlctl("runs", "report", folder, "--format", "md").stdout
    assert "&lt;img src=x> &amp; more" in text
    outside = "".join(text.split("```")[::2])
    assert not {"<b>", "<i>", "<img", "<script"} & {
        part for part in ("<b>", "<i>", "<img", "<script") if part in outside
    }
    assert "algo: <ppo>" in text  # in a block of code nothing acts


VALUES = ["abc", RED, 1e308, -1e308, 10**400, float("nan"), True, None, [1], {"a": [1]}, ""]
CELLS = ["abc", "1e308", "-1e308", "nan", "inf", RED.replace("\x07", ""), "5e-324", "9" * 30, ""]
COLUMNS = ("steps", "seconds", "return", "success", "length", "terminated", "term/a", "approx_kl", "value", "std")


def scramble(folder, random):
    status = json.loads((folder / "run.json").read_text())
    status |= {key: random.choice(VALUES) for key in status if key != "task" and random.random() < 0.2}
    (folder / "run.json").write_text(json.dumps(status))
    for file in ("metrics.csv", "evals.csv"):
        rows = [
            [str(100 * step), *(random.choice(CELLS) if random.random() < 0.4 else "0.5" for _ in COLUMNS[1:])]
            for step in range(random.choice((0, 1, 5, 14)))
        ]
        (folder / file).write_text("\n".join(",".join(row) for row in [COLUMNS, *rows]) + "\n")


def describe(folder):
    show.show(show.RunDescription(RunDirectory(folder)), None)


@pytest.mark.parametrize("name", ["metrics.csv", "evals.csv"])
@pytest.mark.parametrize("content", ["a pipe or a device, not a file", "damaged: field larger than field limit"])
def test_a_table_that_cannot_be_read(content, name, write_run):
    folder = write_run("reach/2026-11-21_10-00-00_s0")
    (folder / name).unlink()
    if "pipe" in content:
        os.mkfifo(folder / name)
    else:
        (folder / name).write_text("steps,return\n1," + "y" * 200_000 + "\n")
    summary = summarize(folder)
    assert (summary.state, summary.reason.startswith(f"{name}: {content}")) == ("damaged", True)
    with pytest.raises(ArtifactError, match=f"{name}: {content}"):
        describe(folder)


@pytest.mark.parametrize("depth", [101, 300, 500])
def test_a_status_that_is_nested_deeply(depth, write_run):
    folder = write_run("reach/2026-11-21_10-00-00_s0", versions={"a": "DEEP"})
    file = folder / "run.json"
    file.write_text(file.read_text().replace('"DEEP"', "[" * depth + "]" * depth))
    assert summarize(folder).reason == "run.json: damaged: nested too deeply"


@pytest.mark.slow
@pytest.mark.parametrize("recipe", ["algo: [ppo]", "algo_kwargs: 5", "stages: {a: 1}", "algo: {ppo: 1}"])
def test_a_recipe_of_other_types_is_not_diagnosed(recipe, write_run, capsys):
    folder = write_run("reach/2026-11-21_10-00-00_s0", metrics=[(step, 0.5, 1.0) for step in range(12)])
    (folder / "recipe.yaml").write_text(f"{recipe}\n")
    describe(folder)
    write_report([str(folder)], target=folder / "report.html", pictures=False)


def test_an_evaluation_at_no_step_is_left_out(write_run, capsys):
    folder = write_run("reach/2026-11-21_10-00-00_s0")
    (folder / "evals.csv").write_text("steps,success,return\nnan,0.9,9\n500,0.5,2\n1e999,0.9,9\n")
    describe(folder)
    assert summarize(folder).best_step == 500


@pytest.mark.slow
def test_half_a_surrogate_pair_is_reported(write_run, tmp_path):
    folder = write_run("reach/2026-11-21_10-00-00_s0", status="failed", error="\ud800")
    write_report([str(folder)], target=tmp_path / "report.html", pictures=False)
    assert r"\ud800" in (tmp_path / "report.html").read_text()


@pytest.mark.slow_except("1")
@pytest.mark.parametrize("seed", range(10))
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_whatever_a_run_holds_it_is_shown(write_run, seed, tmp_path):
    folder = write_run(
        "reach/2026-11-21_10-00-00_s0", steps=1000, best_step=1000, started="2026-11-21T10:00:00", error="",
        recipe_changes={"seed": 3}, versions={"rlctl": "0.1"}, observations_outside=3, folder="/", source_sha256="a",
        **{"from": {"policy": "a", "training_steps": 3}},
    )  # fmt: skip
    scramble(folder, random.Random(seed))
    for sort in ("newest", "score", "steps", "minutes"):
        listing.show(listing.list_runs(sort=sort), str(tmp_path / "list.json"))
    try:
        show.show(show.RunDescription(RunDirectory(folder)), str(tmp_path / "show.json"))
        write_report([str(folder)], target=tmp_path / "report.html", pictures=False)
    except RlctlError:
        pass
