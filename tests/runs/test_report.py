"""The report of runs: what must be in it, that it needs nothing else, and what it refuses."""

import base64
import csv
import io
import json
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from rlctl.environments.spec import EnvSpec
from rlctl.errors import ArtifactError, UsageError
from rlctl.evaluation.robustness import Axis, Cell, Outcome, Robustness, RobustnessMap
from rlctl.play.episode import EpisodeInfo, RecordedEpisode, save_episode
from rlctl.recipe.sources import parse_settings, resolve
from rlctl.runs.compare import maps as comparison_map
from rlctl.runs.directory import RunDirectory
from rlctl.runs.report import content, plots
from rlctl.runs.report.show import describe_robustness
from rlctl.runs.report.write import write_report
from rlctl.storage import files
from rlctl.training.status import find_recipe_changes

LARGEST = 2_000_000  # [bytes]
HEADER = "steps,seconds,return,success,term/alive\n"
CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)


@pytest.fixture
def group(write_run):
    """Three trainings of one recipe, seeds 0 to 2."""
    folders = []
    for seed in range(3):
        folder = write_run(
            f"reach/2026-11-21_10-00-0{seed}_s{seed}",
            seed=seed,
            evals=((1000, 0.2, 1.0 + seed), (2000, 0.8 + 0.1 * seed, 9.0 + seed)),
            recipe_changes={"algo_kwargs.learning_rate": 0.001, "task.name": "<b>&"},
            versions={"rlctl": "0.1.0"},
            started="2026-11-21T10:00:00+00:00",
        )
        rows = (f"{200 * step},{step},{step + seed},{step / 10},{step}\n" for step in range(1, 11))
        (folder / "metrics.csv").write_text(HEADER + "".join(rows))
        folders.append(folder)
    return folders


def write(*runs, **options):
    path = write_report([str(run) for run in runs], **options)
    return None if path is None else path.read_text()


def test_page_has_everything_and_needs_nothing_else(group):
    page = write(group[2])
    assert "In the evaluation that selected it, the best policy succeeds in 100.0% of 100 episodes, with" in page
    for plot in ("Return over training steps", "Success rate over training steps", "Reward terms over training steps"):
        assert f'aria-label="{plot}"' in page
        assert f">{plot}</text>" in page
    assert ">60%</text>" in page  # of the axis, as in the table
    assert "prefers-color-scheme: dark" in page
    assert "#000000" not in page  # black lines and texts would be lost on a dark page
    for name, text in (("Task", "reach: Bring the hand within"), ("Started", "2026-11-21 10:00 UTC")):
        assert f"<dt>{name}</dt><dd>{text}" in page
    assert "<dd>2,000 steps in 90 s</dd>" in page
    assert page.count("<svg") == page.count("</svg>") == 3
    assert "Nothing unusual in the records of this training." in page
    assert "rlctl train reach --seed 2 --set algo_kwargs.learning_rate=0.001" in page
    assert "algo: ppo" in page
    assert "rlctl 0.1.0" in page
    assert "<b>&" not in page  # what a run says is text
    assert not re.search(r"""(src|href)\s*=\s*["']?(https?:)?//|@import|url\(\s*["']?http|<script|<link""", page)
    assert len(page) < LARGEST


def test_a_replayed_episode_is_not_one_of_the_evaluation(group):
    policies = ["training step 2000", "training step 2000", "best.safetensors, ppo, step 2000"]
    for number, (policy, total) in enumerate(zip(policies, (3.0, 5.0, 9.0), strict=True)):
        info = EpisodeInfo(spec=EnvSpec("reach"), seed=number, policy=policy, total_reward=total)
        episode = RecordedEpisode(np.zeros((1, 7)), np.zeros((2, 3)), np.array([total]), np.zeros((1, 0)), info)
        save_episode(RunDirectory(group[2]).episode_file(number), episode)
    captions = [caption for caption, _ in content.choose_episodes(content.collect([str(run) for run in group]))]
    assert captions == [
        "The best recorded episode of the last evaluation: return 5, 1 steps",
        "The worst recorded episode of the last evaluation: return 3, 1 steps",
    ]


def test_command_for_another_algorithm_trains_the_same_recipe(write_run):
    other = resolve("reach", None, {"algo": "sac", "task": {"tolerance": 0.1}, "seed": 3})
    changes = {key: value for key, (value, _) in find_recipe_changes("reach", other).items()}
    # What follows from another algorithm, its own defaults, is no choice of the user's.
    assert changes == {"algo": "sac", "task.tolerance": 0.1}
    run = write_run("reach/2026-11-21_10-00-00_s3", seed=3, recipe_changes=changes)
    (command,) = content.list_commands(content.collect([str(run)]))
    words = shlex.split(command)
    assert words[:6] == ["rlctl", "train", "reach", "--seed", "3", "--set"]
    assert resolve("reach", None, {"seed": 3, **parse_settings(words[6::2])}) == other


@pytest.mark.slow
def test_group_is_drawn_with_a_band(group):
    page = write(group[0].parent)
    assert "reach, ppo, seeds 0, 1, 2" in page
    assert "the best policies of 3 trainings succeed in 90.0% (80.0% to 100.0%) of the episodes" in page
    assert "a line is the mean of a recipe's trainings, its band spans from the lowest to the highest" in page
    assert "rlctl train reach --seeds 0,1,2 --set algo_kwargs.learning_rate=0.001" in page


def write_recipes(group, **recipes):
    for folder, settings in zip(group, recipes.values(), strict=True):
        RunDirectory(folder).write_recipe(resolve("reach", None, {"algo_kwargs": settings}))


@pytest.mark.slow
def test_a_band_per_recipe(group):
    write_recipes(group, a={"learning_rate": 0.001}, b={"learning_rate": 0.001}, c={"learning_rate": 0.002})
    report = content.collect([str(run) for run in group])
    assert [(recipe.name, len(recipe.runs)) for recipe in report.recipes] == [
        ("learning_rate 0.001", 2),
        ("learning_rate 0.002", 1),
    ]
    page = write(*group, episodes=0)
    assert page.count(">learning_rate 0.001</text>") == 3  # legends of return and success, title of its terms
    assert "learning_rate 0.002: In the evaluation that selected it" in page
    assert "not compared: learning_rate 0.002: a single run cannot be compared" in write(*group)


@pytest.mark.slow
@pytest.mark.parametrize(("form", "begins"), [("svg", b"<?xml"), pytest.param("pdf", b"%PDF-", marks=pytest.mark.slow)])
def test_curves_for_a_paper(group, rlctl, form, begins):
    write_recipes(group, a={"learning_rate": 0.001}, b={"learning_rate": 0.001}, c={"learning_rate": 0.002})
    done = rlctl("runs", "report", *group, "--format", form)
    assert (done.returncode, done.stdout) == (0, f"report: report.{form}\n")
    content = Path(f"report.{form}").read_bytes()
    assert content.startswith(begins)
    assert form == "pdf" or content.count(b">learning_rate 0.001</text>") == 2  # legends of return and success


@pytest.mark.slow
def test_a_bad_result_is_not_called_usual(write_run):
    run = write_run("reach/2026-11-21_10-00-00_s0", evals=((1000, 0.088, 1.0),))
    page = write(run)
    assert "Nothing unusual" not in page
    assert "the best policy succeeds in only 8.8% of the episodes. What has it learned instead? rlctl runs show" in page


def test_a_report_shows_what_differs_from_the_tasks_recipe(write_run):
    changes = {"recipe_changes": {"reward_weights.action": -50.0}, "recipe_before": {"reward_weights.action": -0.05}}
    report = content.collect([str(write_run("reach/a", evals=((1000, 0.0, 1.0),), **changes))])
    wanted = "reward_weights.action = -50.0 (recipe: -0.05)"
    assert dict(content.list_facts(report))["Differs from the task's recipe"] == wanted
    assert content.describe_absence(report).endswith("/runs/reach/a --audit")


def test_curves_of_seeds_are_averaged_at_common_steps():
    tables = [
        [{"steps": 10.0, "x": 1.0}, {"steps": 39.0, "x": 3.9}],
        [{"steps": 20.0, "x": 6.0}, {"steps": 40.0, "x": 6.0}],
    ]
    curve = content.mean_curve(tables, "x")
    assert curve["steps"].tolist() == [20, 39]
    # The first curve has 2 and 3.9 there, the second 6. That it ends one step before the other is not early.
    assert curve["mean"].tolist() == pytest.approx([4, 4.95])
    assert curve["low"].tolist() == pytest.approx([2, 3.9])
    assert curve["high"].tolist() == [6, 6]
    assert curve["ended"] == []


def test_a_seed_that_ended_early_does_not_cut_the_others():
    tables = [
        [],  # has no value yet
        [{"steps": 10.0, "x": 1.0}, {"steps": 20.0, "x": 2.0}],
        [{"steps": 10.0, "x": 5.0}, {"steps": 25.0, "x": 5.0}, {"steps": 40.0, "x": 8.0}],
    ]
    curve = content.mean_curve(tables, "x")
    assert curve["steps"].tolist() == [10, 25, 40]
    assert curve["mean"].tolist() == [3, 5, 8]
    assert curve["low"].tolist() == [1, 5, 8]
    assert curve["ended"] == [(1, 20.0, 2.0)]


def write_two_recipes(write_run):
    """Two folders, `ppo` and `a2c`, each with a group of two seeds that has a time for its name."""
    for algo, offset in (("ppo", 0.0), ("a2c", 2.0)):
        for seed in range(2):
            folder = write_run(
                f"reach/{algo}/2026-11-28_23-49-14_seeds/s{seed}",
                seed=seed,
                algo=algo,
                status="interrupted" if algo == "a2c" and seed else "finished",
                evals=[(1000 * k, 0.1 * k, k + seed + offset) for k in range(1, 4 - 2 * (algo == "a2c") * seed)],
                metrics=[(250 * k, 0.02 * k, k / 4 + offset) for k in range(1, 13 - 8 * (algo == "a2c") * seed)],
            )
            RunDirectory(folder).write_recipe(resolve("reach", None, {"algo": algo}))
    return ["runs/reach/ppo", "runs/reach/a2c/"]


@pytest.mark.slow
def test_curves_name_the_folders_that_the_user_named(write_run):
    texts = write_two_recipes(write_run)
    picture = write(*texts, form="svg", target=Path("curves.svg"))
    assert picture.count(">ppo</text>") == picture.count(">a2c</text>") == 2  # legends of return and success
    assert picture.count(">reach</text>") == 1
    assert "Lines and dots: mean; bands and bars: lowest to highest of 2 seeds (ppo), 2 seeds (a2c)." in picture
    assert "x: ended early (seed 1 of a2c at step 1,000)" in picture
    assert "dots: evaluations" in picture  # three evaluations are no curve


@pytest.mark.slow
def test_labels_of_the_user(write_run):
    texts = write_two_recipes(write_run)
    picture = write(*texts, form="svg", target=Path("curves.svg"), labels=["ours", "theirs"])
    assert picture.count(">ours</text>") == picture.count(">theirs</text>") == 2
    with pytest.raises(UsageError, match="--label: 1 given, and there are 2 recipes: ppo, a2c"):
        write(*texts, form="svg", labels=["ours"])
    with pytest.raises(UsageError, match="--label ours is given twice"):
        write(*texts, form="csv", labels=["ours", "ours"])


@pytest.mark.slow
def test_a_seed_that_still_trains_has_not_ended_early(write_run, hold_lock):
    texts = write_two_recipes(write_run)
    run = next(Path("runs/reach/a2c").glob("*/s1"))
    RunDirectory(run).write_status({"status": "running"})
    hold_lock(run)
    picture = write(*texts, form="svg", target=Path("curves.svg"))
    assert "x: still trains (seed 1 of a2c at step 1,000)" in picture


def test_runs_in_folders_named_by_time_have_the_name_of_their_algorithm(write_run):
    write_two_recipes(write_run)
    report = content.collect(["runs/reach/*/*/*"])
    assert sorted(recipe.label for recipe in report.recipes) == ["a2c", "ppo"]


def test_groups_named_by_time_have_the_name_of_the_setting_that_differs(write_run):
    texts = []
    for number, rate in enumerate((0.001, 0.01)):
        texts.append(f"runs/reach/lr{number}/2026-01-01_00-00-0{number}_seeds")
        for seed in range(2):
            values = {"evals": [(1000, 0.5, 1.0)], "metrics": [(500, 0.5, 1.0)]}
            folder = write_run(texts[-1].removeprefix("runs/") + f"/s{seed}", seed=seed, status="finished", **values)
            RunDirectory(folder).write_recipe(resolve("reach", None, {"algo_kwargs": {"learning_rate": rate}}))
    report = content.collect(texts)
    assert [recipe.label for recipe in report.recipes] == ["learning_rate 0.001", "learning_rate 0.01"]


@pytest.mark.slow
def test_no_episodes_are_no_error_where_none_are_played(group):
    assert "</svg>" in write(group[0], target=Path("curves.svg"), episodes=0)
    assert "steps" in write(group[0], target=Path("table.csv"), episodes=0)


def test_results_have_the_mean_of_seeds_and_name_the_unfinished(write_run):
    texts = write_two_recipes(write_run)
    table = write(*texts, form="table", target=Path("table.md"))
    assert "| mean of 2 seeds | ppo" in table
    # Returns 3 and 4: 3.5, and t(0.975, 1) = 12.706 times 0.5 to each side.
    assert "| 3.5 (-2.853 to 9.853) |" in table
    assert re.search(r"_seeds/s1 \(stopped", table) or re.search(r"s1 \(stopped", table)
    assert "| mean of 2 seeds (1 unfinished) | a2c" in table
    rows = list(csv.DictReader(io.StringIO(write(*texts, target=Path("results.csv")))))
    assert [row["seeds"] for row in rows] == ["1", "1", "2", "1", "1", "2"]
    assert (rows[2]["run"], rows[2]["label"], float(rows[2]["return"])) == ("", "ppo", 3.5)
    latex = write(*texts, target=Path("results.tex"), labels=["PPO_1", "50 %"])
    assert "PPO\\_1 & 2 & 3,000 & " in latex
    assert "50 \\% (1 unfinished) & 2 & " in latex


def test_a_file_of_markdown_is_markdown(group):
    text = write(group[0], target=Path("report.md"))
    assert "| steps |" in text
    assert "<html" not in text


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"form": "pdf", "episodes": 5}, "--episodes has no effect with the format pdf"),
        ({"form": "table", "pictures": False}, "--no-pictures has no effect with the format table"),
        ({"form": "md", "labels": ["x"]}, "--label has no effect with the format md"),
        ({"form": "pdf", "target": Path("x.png")}, "x.png is the name of another format than --format pdf"),
    ],
)
def test_options_without_effect_are_refused(group, options, message):
    with pytest.raises(UsageError, match=message):
        write(group[0], **options)


def test_scores_of_robustness_name_their_policy():
    outcome = {"success_interval": (0.1, 0.9), "mean_return": 1.0, "return_interval": (0.0, 2.0)}
    axis = Axis(name="mass", setting="events.mass.factor", values=[0.6], nominal=1.0)
    cell = Cell(values=[0.6], nominal=False, success_rate=0.3, **outcome)
    result = Robustness(
        task="reach", parameters={}, policy_file="runs/a/policies/last.safetensors", algo="ppo", training_steps=69_632,
        episodes=20, seed=0, deterministic=True, nominal=Outcome(success_rate=0.88, **outcome),
        maps=[RobustnessMap(axes=[axis], cells=[cell])],
    )  # fmt: skip
    assert list(describe_robustness(result)) == [
        "worst cell, 20 episodes at mass 0.6: success 30.0%, return 1 (last.safetensors, step 69,632)",
        "with nothing varied: success 88.0%, return 1 (last.safetensors, step 69,632)",
    ]


@pytest.mark.slow
def test_robustness_is_in_it_where_it_was_measured(group):
    outcome = {"success_interval": (0.1, 0.9), "mean_return": 1.0, "return_interval": (0.0, 2.0)}
    axis = Axis(name="mass", setting="events.mass.factor", values=[0.6, 1.0], nominal=1.0)
    cells = [Cell(values=[value], nominal=value == 1, success_rate=value / 2, **outcome) for value in axis.values]
    grid = [
        Axis(name=name, setting=f"events.{name}.factor", values=[1.0, 2.0], nominal=1.0)
        for name in ("mass", "friction")
    ]
    pairs = [Cell(values=[a, b], nominal=a == b == 1, success_rate=0.5, **outcome) for a in (1, 2) for b in (1, 2)]
    result = Robustness(
        task="reach", parameters={}, policy_file="best", algo="ppo", training_steps=1, episodes=20, seed=0,
        deterministic=True, nominal=Outcome(success_rate=0.5, **outcome),
        maps=[RobustnessMap(axes=[axis], cells=cells), RobustnessMap(axes=grid, cells=pairs)],
    )  # fmt: skip
    files.write_json(group[0] / "robustness.json", result.model_dump(mode="json"))
    page = write(group[0])
    assert "worst cell, 20 episodes at mass 0.6: success 30.0%, return 1 (best, step 1)" in page
    assert "with nothing varied: success " in page
    (group[1] / "robustness.json").write_text("{")
    assert "robustness.json: damaged: " in write(group[1])
    assert 'aria-label="Success rate by mass.factor"' in page
    assert 'aria-label="Success rate by mass.factor and friction.factor"' in page


def test_markdown_is_printed_for_pull_requests(group, rlctl):
    done = rlctl("runs", "report", group[0], "--format", "md")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("## reach, ppo, seed 0\n")
    assert "| steps | seconds | episodes | success | return |\n|---:|---:|---:|---:|---:|\n| 1,000 |" in done.stdout
    assert "```\nrlctl train reach --seed 0" in done.stdout


@pytest.mark.slow
def test_run_in_progress_is_reported_as_such(group, hold_lock):
    status = json.loads((group[0] / "run.json").read_text())
    (group[0] / "run.json").write_text(json.dumps({**status, "status": "running"}))
    (group[0] / "evals.csv").unlink()
    hold_lock(group[0])
    page = write(group[0])
    assert "No evaluation yet." in page
    assert "is running, 2,000 steps so far" in page


def test_what_cannot_be_reported(group, write_run):
    other = write_run("ant/2026-11-21_10-00-00_s0")
    with pytest.raises(UsageError, match=r"runs of several tasks \(ant, reach\)"):
        write(group[0], other)
    empty = write_run("reach/2026-11-21_11-00-00_s0", metrics=(), evals=())
    with pytest.raises(ArtifactError, match="nothing to report yet"):
        write(empty)
    (empty / "run.json").write_text("{")
    with pytest.raises(ArtifactError, match=r"run\.json"):
        write(empty)
    with pytest.raises(ArtifactError, match="no run 'nowhere'"):
        write("nowhere")


@pytest.mark.slow
def test_trained_run_has_pictures_of_its_best_and_worst_episode(rlctl, tmp_path):
    settings = ("total_timesteps=5120", "eval.every_steps=2560", "eval.episodes=4")
    done = rlctl("train", "reach", "--no-check", *(part for each in settings for part in ("--set", each)))
    assert done.returncode == 0, done.stderr
    done = rlctl("runs", "report", "-o", "all.html")  # of the newest run
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "all.html").read_text()
    pictures = re.findall(r'src="data:image/jpeg;base64,([^"]+)"', page)
    assert len(pictures) in (6, 12)  # the worst episode may be the first
    assert all(base64.b64decode(each).startswith(b"\xff\xd8") for each in pictures)
    assert len(page) < LARGEST


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
@pytest.mark.parametrize("width", [390, 1280])
def test_browser_shows_it(group, tmp_path, width):
    write(group[0].parent, target=tmp_path / "all.html")
    command = [CHROMIUM, "--headless=new", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}"]
    page = tmp_path / "all.html"
    measure = "<script>document.title = document.documentElement.scrollWidth + ' of ' + window.innerWidth</script>"
    page.write_text(page.read_text() + measure)
    done = subprocess.run(
        [*command, f"--window-size={width},900", "--dump-dom", page.as_uri()],
        capture_output=True,
        text=True,
        timeout=250,
    )
    content, inside = re.search(r"<title>(\d+) of (\d+)</title>", done.stdout).groups()
    assert int(content) <= int(inside)  # nothing to scroll sideways
    assert done.stdout.count("<svg") == 3
    assert "the best policies of 3 trainings" in done.stdout


@pytest.mark.slow
def test_legends_have_the_names_of_single_runs(group):
    write_recipes(group[:2], a={"learning_rate": 0.001}, b={"learning_rate": 0.002})
    page = write(*group[:2], episodes=0)
    assert all(page.count(f">{run.name}</text>") == 2 for run in group[:2])  # of return and success


def test_results_alone_are_a_table(group, tmp_path):
    table = write(group[0], form="table", target=tmp_path / "table.md")
    head, line, row = table.splitlines()
    assert head == "| run | recipe | algo | seed | steps | minutes | success | return |"
    assert line == "|" + " --- |" * 8
    assert row.startswith(f"| reach/{group[0].name} |  | ppo | 0 |")


@pytest.mark.slow
def test_curves_are_drawn_as_png(group, tmp_path):
    path = write_report([str(group[0])], "png", tmp_path / "curves.png")
    assert path.read_bytes().startswith(b"\x89PNG")


def test_a_moving_average_by_hand():
    values = np.array([0.0, 3.0, 6.0, 0.0, 3.0])
    # At the ends the mean of two: (0 + 3) / 2 and (0 + 3) / 2; inside of three: 9 / 3, 9 / 3, 9 / 3.
    assert plots.smooth_values(values, 3) == pytest.approx([1.5, 3.0, 3.0, 3.0, 1.5])


def make_measured(rates):
    """Return a measurement of two axes with these success rates, shape (2, 2)."""
    axes = [
        {"name": name, "setting": f"events.{name}.factor", "values": [0.5, 1.0], "nominal": 1.0}
        for name in ("mass", "friction")
    ]
    cells = [
        {
            "success_rate": rate,
            "success_interval": (max(0.0, rate - 0.1), min(1.0, rate + 0.1)),
            "mean_return": 1.0,
            "return_interval": (0.0, 2.0),
            "values": [0.5 + 0.5 * (index // 2), 0.5 + 0.5 * (index % 2)],
            "nominal": index == 3,
        }
        for index, rate in enumerate(rates)
    ]
    nominal = {key: value for key, value in cells[3].items() if key not in ("values", "nominal")}
    return Robustness.model_validate(
        {
            "task": "reach",
            "parameters": {},
            "policy_file": "x.safetensors",
            "algo": "ppo",
            "training_steps": 1,
            "episodes": 10,
            "seed": 0,
            "deterministic": True,
            "nominal": nominal,
            "maps": [{"axes": axes, "cells": cells}],
        }
    )


@pytest.mark.slow
def test_difference_of_two_maps():
    one, two = make_measured([0.2, 0.5, 0.5, 1.0]), make_measured([0.9, 0.55, 0.1, 1.0])
    result = comparison_map.subtract(("one", "two"), one, two)
    (compared,) = result.maps
    assert [cell.difference for cell in compared.cells] == pytest.approx([0.7, 0.05, -0.4, 0.0])
    assert [cell.is_clear for cell in compared.cells] == [True, False, True, False]
    cells = comparison_map.as_json(result)["maps"][0]["cells"]
    assert [cell["intervals_overlap"] for cell in cells] == [False, True, False, True]
    assert plots.draw_differences(result, "png").startswith(b"\x89PNG")
    assert b"two minus one" in plots.draw_differences(result, "svg")


@pytest.mark.slow
def test_many_maps_are_a_grid_with_room_for_their_numbers():
    scores = {"success_rate": 0.5, "success_interval": (0.4, 0.6), "mean_return": 1.0, "return_interval": (0.0, 2.0)}
    settings = {"events.mass.factor": 1.0, "events.noise.std": 0.002, "events.late.steps": 3.0, "task.tolerance": 0.05}
    maps = []
    for setting, highest in settings.items():
        values = np.linspace(0.0, highest, 5).tolist()
        axis = {"name": setting.split(".")[1], "setting": setting, "values": values, "nominal": 0.0}
        cells = [{"values": [value], "nominal": value == 0, **scores} for value in values]
        maps.append({"axes": [axis], "cells": cells})
    measured = make_measured([0.5] * 4).model_copy(
        update={"maps": [RobustnessMap.model_validate(content) for content in maps]}
    )
    svg = plots.draw_maps(measured, "svg").decode()
    width, height = (float(re.search(rf'{side}="([\d.]+)pt"', svg)[1]) for side in ("width", "height"))
    assert (width, height) == pytest.approx((2 * 4.4 * 72, 2 * 2.7 * 72))
    for label in ("mass.factor", "noise.std", "late.steps", "tolerance"):
        assert f">{label}</text>" in svg
    numbers = re.findall(r">([\d.]+)</text>", svg)
    assert {"0.0005", "0.02", "3"} <= set(numbers)
    assert len(numbers) <= 4 * 7
    assert max(map(len, numbers)) <= len("0.0005")
    difference = plots.draw_differences(comparison_map.subtract(("one", "two"), measured, measured), "svg")
    assert b"reach: the same 10 episodes in every cell" in difference


@pytest.mark.slow
def test_maps_of_a_policy_are_a_picture():
    measured = make_measured([0.2, 0.5, 0.5, 1.0])
    assert plots.draw_maps(measured, "png").startswith(b"\x89PNG")
    assert plots.draw_maps(measured, "pdf").startswith(b"%PDF")
    svg = plots.draw_maps(measured, "svg").decode()
    assert ">20%</text>" in svg
    assert "episodes in every cell" in svg
    with pytest.raises(UsageError, match=r"^map\.jpg: the name of a picture ends in \.png, \.svg or \.pdf$"):
        plots.choose_form(Path("map.jpg"))


@pytest.mark.slow_except(first=1)
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["compare", "a", "b", "c", "--vary", "mass=0:1:2"], "--vary compares two policies, the baseline first"),
        (["compare", "a", "b", "--vary", "mass=0:1:2", "--gate", "not-worse"], "--vary draws a map and judges nothing"),
        (["compare", "a", "b", "--picture", "x.png"], "--picture draws maps: add --vary"),
        (["compare", "a", "b", "--vary", "mass=0:1:2", "--picture", "x.gif"], "x.gif: the name of a picture ends in"),
    ],
)
def test_a_map_that_cannot_be_drawn_is_refused(rlctl, arguments, message):
    done = rlctl("runs", *arguments)
    assert done.returncode == 2
    assert message in done.stderr
