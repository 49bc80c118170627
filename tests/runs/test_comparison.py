"""Comparing runs: real policies on a small task, and what is refused."""

import dataclasses
import json
import shutil
import sys

import numpy as np
import pytest

from rlctl.environments.spec import EnvSpec, merge
from rlctl.errors import AnswerIsNo, ArtifactError, UsageError
from rlctl.evaluation.eval_request import EvalRequest
from rlctl.evaluation.players import choose_spec, load_player
from rlctl.launching.train import run_training
from rlctl.recipe.recipe import find_difference
from rlctl.recipe.sources import resolve
from rlctl.runs.compare.comparison import NOT_WORSE, Candidate, ComparisonGate, RunComparison, Side, compare
from rlctl.runs.compare.margin import check_margin
from rlctl.runs.compare.report import (
    as_json,
    describe_candidate,
    describe_seeds,
    describe_verdict,
    format_needed,
    make_suite,
)
from rlctl.runs.compare.significance import MeanDifference, Verdict
from rlctl.runs.directory import RunDirectory
from rlctl.runs.listing import find_runs_of
from rlctl.runs.report.write import write_report
from rlctl.runs.train_request import TrainRequest
from tests.training.conftest import ENVS, TINY


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Two recipes of two seeds each, of a few hundred steps."""
    root = tmp_path_factory.mktemp("runs")
    for gamma in (0.9, 0.99):
        for seed in (0, 1):
            settings = merge(TINY, {"seed": seed, "algo_kwargs": {"gamma": gamma}})
            run_training(TrainRequest(f"{ENVS}:Line", settings=settings, root=root / str(gamma), check=False))
    return root


@pytest.mark.slow
def test_policies_are_compared_episode_by_episode(root):
    one, two = sorted((root / "0.9/Line").iterdir())
    result = compare([str(one), str(two)], EvalRequest(None, episodes=5))
    assert not result.of_recipes
    (candidate,) = result.candidates
    difference = candidate.differences["return"]
    expected = candidate.side.runs[0].values("return") - result.baseline.runs[0].values("return")
    assert difference.mean == pytest.approx(expected.mean())
    sides = (result.baseline, candidate.side)
    first, second = ([episode.result.seed for episode in side.runs[0].evaluation.played] for side in sides)
    assert first == second
    assert candidate.recipe_changes == {}
    assert result.world_differences == []


def test_all_play_in_the_world_of_the_first(root):
    one, _ = sorted((root / "0.9/Line").iterdir())
    policy = load_player(one / "policies/best.safetensors", deterministic=True)
    easier = EnvSpec(f"{ENVS}:Line", {"goal": 0.5}, {"near": 2.0}, randomize=True, events={"mass": {"factor": 1.0}})
    played = choose_spec(policy.info, EvalRequest(str(one), spec=easier))
    assert (played.parameters, played.reward_weights) == ({"goal": 0.5}, {"near": 2.0})
    assert (played.randomize, played.events) == (True, {"mass": {"factor": 1.0}})
    changes = {"task.goal": (0.1, 0.5), "algo_kwargs.gamma": (0.9, 0.99), "randomize": (False, True)}
    candidate = Candidate(Side("b", [], []), {}, changes)
    result = RunComparison(False, "Line", Side("a", [], []), [candidate], 5, None)
    assert result.world_differences == ["task.goal", "randomize"]


@pytest.mark.slow
def test_settings_change_that_world(root, rlctl):
    runs = map(str, sorted((root / "0.9/Line").iterdir()))
    result = rlctl("runs", "compare", *runs, "--set", "task.goal=0.3")
    assert result.returncode == 2
    assert "has no parameter 'goal'" in result.stderr


def test_recipes_are_compared_seed_by_seed(root):
    result = compare([str(root / "0.9/Line"), f"{root}/0.99/Line/*"], EvalRequest(None, episodes=3))
    assert result.of_recipes
    (candidate,) = result.candidates
    assert candidate.recipe_changes == {"algo_kwargs.gamma": (0.99, 0.9)}
    assert (result.baseline.label, candidate.side.label) == ("gamma 0.9", "gamma 0.99")
    scores = result.baseline.scores("return")
    low, high = f"{scores.min():.4g}", f"{scores.max():.4g}"
    assert describe_seeds(result, result.baseline).endswith(f"(range of 2 seeds {low} to {high})")
    assert candidate.verdict is Verdict.CANNOT_TELL
    needed = format_needed(candidate, comparisons=1)
    assert "smallest possible p-value is 0.33" in needed
    assert "would decide, if the true difference in return is the measured one" in needed
    content = json.loads(json.dumps(as_json(result)))
    baseline = content["baseline"]
    assert baseline["over_seeds"]["return"]["mean"] == pytest.approx(
        np.mean([each["return"] for each in baseline["runs"]])
    )
    assert [len(side["runs"]) for side in (content["baseline"], *content["candidates"])] == [2, 2]


@pytest.mark.slow
def test_runs_of_several_recipes_as_one_are_pointed_out(root):
    result = compare([f"{root}/0.9*/Line/*_s0", f"{root}/0.9*/Line/*_s1"], EvalRequest(None, episodes=2))
    assert result.baseline.mixed == ["algo_kwargs.gamma"]


def test_a_folder_whose_name_looks_like_a_glob(write_run):
    run = write_run("reach [1]/2026-01-01_00-00-00_s0")
    assert [found.path for found in find_runs_of(str(run))] == [run]


def test_the_folder_of_all_runs_has_each_run_once(write_run, tmp_path):
    runs = [write_run(f"before/reach/2026-01-01_00-00-00_s{seed}") for seed in range(2)]
    folder = runs[0].parent.parent
    (folder / "latest").symlink_to(runs[1])
    assert [run.path for run in find_runs_of(str(folder))] == runs


def test_refusals(root, write_run):
    one, _ = sorted((root / "0.9/Line").iterdir())
    with pytest.raises(UsageError, match="two or more"):
        compare([str(one)], EvalRequest(None))
    with pytest.raises(UsageError, match="cannot be compared with itself"):
        compare([str(one), str(one)], EvalRequest(None))
    with pytest.raises(UsageError, match="a single run cannot be compared with a group"):
        compare([str(one), str(root / "0.99/Line")], EvalRequest(None))
    with pytest.raises(ArtifactError, match="no run matches"):
        compare([str(one), f"{root}/0.5*"], EvalRequest(None))
    other = write_run("ant/2026-01-01_00-00-00_s0")
    with pytest.raises(UsageError, match=r"different tasks.*--task"):
        compare([str(one), str(other)], EvalRequest(None))


def test_a_copy_of_a_run_is_no_second_seed(root, tmp_path):
    first, second = root / "0.9/Line", tmp_path / "copied"
    run = sorted((root / "0.99/Line").iterdir())[0]
    for name in ("one", "two"):
        shutil.copytree(run, second / name)
    with pytest.raises(UsageError, match="copied: two of its runs have the same recipe and seed"):
        compare([str(first), str(second)], EvalRequest(None, episodes=1))


def test_the_verdict_names_a_training_that_has_not_finished(root, tmp_path):
    done, other = sorted((root / "0.9/Line").iterdir())
    stopped = RunDirectory(tmp_path / other.name)
    shutil.copytree(other, stopped.path, symlinks=True)
    stopped.write_status({"status": "interrupted"})
    steps, total = stopped.status()["steps"], stopped.recipe().total_timesteps
    result = compare([str(done), str(stopped.path)], EvalRequest(None, episodes=3))
    (candidate,) = result.candidates
    place = f"stopped at step {steps:,} of {total:,}"
    assert describe_verdict(result, candidate) == f"{candidate.verdict}, but its training {place}"
    assert as_json(result)["candidates"][0]["runs"][0]["unfinished"] == place
    exchanged = compare([str(stopped.path), str(done)], EvalRequest(None, episodes=3))
    assert describe_verdict(exchanged, exchanged.candidates[0]).endswith(f", but the baseline's training {place}")


@pytest.mark.slow
def test_seeds_that_have_not_finished_are_not_compared(root, monkeypatch):
    unfinished = sorted((root / "0.99/Line").iterdir())[1]
    status = RunDirectory.status
    change = lambda run: status(run) | ({"status": "running"} if run.path == unfinished else {})  # noqa: E731
    monkeypatch.setattr(RunDirectory, "status", change)
    texts = [str(root / "0.9/Line"), str(root / "0.99/Line")]
    with pytest.raises(UsageError, match="this seed has not finished its training"):
        compare(texts, EvalRequest(None, episodes=1))
    assert len(compare(texts, EvalRequest(None, episodes=1), force=True).candidates[0].side.runs) == 2


@pytest.mark.slow
def test_policy_files_are_compared(root, tmp_path, rlctl):
    one, two = sorted((root / "0.9/Line").iterdir())
    kept = shutil.copy(one / "policies/best.safetensors", tmp_path / "kept.safetensors")
    runs = compare([str(one), str(two)], EvalRequest(None, episodes=4))
    files = compare([str(kept), str(two)], EvalRequest(None, episodes=4))
    assert files.candidates[0].differences == runs.candidates[0].differences
    assert files.candidates[0].recipe_changes is None
    done = rlctl("runs", "compare", kept, two, "--episodes", 4)
    assert done.returncode == 0, done.stderr
    assert "kept.safetensors" in done.stdout
    assert "recipe: " not in done.stdout


def test_a_margin_must_be_excluded(root):
    one, two = sorted((root / "0.9/Line").iterdir())
    result = compare([str(one), str(two)], EvalRequest(None, episodes=4))
    (difference, *_) = result.candidates[0].differences.values()
    tied = dataclasses.replace(difference, low=-0.2, high=0.1, p=1.0)
    candidate = dataclasses.replace(result.candidates[0], differences={"success": tied})
    result = dataclasses.replace(result, candidates=[candidate])
    result.check(ComparisonGate(margin=0.2))
    with pytest.raises(AnswerIsNo, match=r"its success may be lower by as much as 0\.2; --margin allows 0\.1$"):
        result.check(ComparisonGate(margin=0.1))


@pytest.mark.parametrize(
    ("margin", "message"),
    [
        # Of 20 equal pairs the interval begins at -1.96 / (20 + 2) = -0.0891; 1.96 / 0.05 - 2 = 37.2.
        (
            0.05,
            r"--margin 0\.05: 20 episodes cannot exclude that success is lower by 0\.0891, .*; --episodes 38 or more",
        ),
        (0.0, r"no number of episodes can$"),
        (5, r"--margin 5: a success rate is at most 1; 5 points are 0\.05"),
    ],
)
def test_a_margin_that_cannot_be_shown_is_refused_before_playing(root, margin, message, monkeypatch):
    one, two = sorted((root / "0.9/Line").iterdir())
    monkeypatch.setattr("rlctl.runs.compare.comparison.run_evaluation", lambda *_: pytest.fail("played"))
    with pytest.raises(UsageError, match=message):
        compare([str(one), str(two)], EvalRequest(None, episodes=20), margin=margin)


def test_a_margin_of_enough_episodes_can_be_shown():
    check_margin(0.05, 38, of_success=True)
    with pytest.raises(UsageError):
        check_margin(0.05, 37, of_success=True)
    check_margin(0.05, 2, of_success=False)


def test_a_copy_of_a_policy_passes_any_margin(root, tmp_path):
    one, _ = sorted((root / "0.9/Line").iterdir())
    copy = shutil.copy(one / "policies/best.safetensors", tmp_path / "copy.safetensors")
    result = compare([str(one), str(copy)], EvalRequest(None, episodes=4), margin=0.05)
    result.check(ComparisonGate(margin=0.05))
    assert describe_candidate(result, result.candidates[0])[0].startswith("the same policy file (sha256 ")
    assert result.candidates[0].side.runs[0].evaluation is result.baseline.runs[0].evaluation


def test_a_worse_policy_that_misses_a_margin_is_called_lower():
    worse = MeanDifference(mean=-0.8, low=-0.9, high=-0.7, p=0.001, needed=8)
    candidate = Candidate(Side("b", [], []), {"success": worse}, {})
    assert candidate.describe_loss(0.05) == "its success is lower by 0.8, perhaps by 0.9; --margin allows 0.05"


@pytest.mark.parametrize(
    ("success", "of_return", "is_better"),
    [
        ((0.2, 0.1, 0.3, 0.01), (1.0, -1.0, 3.0, 0.3), True),
        ((0.0, -0.1, 0.1, 1.0), (2.0, 1.0, 3.0, 0.01), True),  # equal in success, higher in return
        ((-0.2, -0.3, -0.1, 0.01), (2.0, 1.0, 3.0, 0.01), False),  # success decides
        ((0.2, -0.1, 0.5, 0.2), (2.0, -1.0, 5.0, 0.2), False),
        ((0.2, -0.1, 0.5, 0.04), (2.0, -1.0, 5.0, 0.2), False),  # of few seeds: the interval contains 0
    ],
)
def test_the_gate_better(root, success, of_return, is_better):
    quantities = {"success": success, "return": of_return}
    differences = {name: MeanDifference(*values, needed=None) for name, values in quantities.items()}
    one, two = sorted((root / "0.9/Line").iterdir())
    result = compare([str(one), str(two)], EvalRequest(None, episodes=4))
    changed = dataclasses.replace(result.candidates[0], differences=differences)
    result = dataclasses.replace(result, candidates=[changed])
    missed = [] if is_better else [f"{two}: not shown to be better than {one}"]
    assert list(result.find_missed(ComparisonGate(better=True)).values()) == missed


def test_gate(root):
    one, two = sorted((root / "0.9/Line").iterdir())
    result = compare([str(one), str(two)], EvalRequest(None, episodes=4))
    swapped = compare([str(two), str(one)], EvalRequest(None, episodes=4))
    verdicts = {result.candidates[0].verdict, swapped.candidates[0].verdict}
    assert verdicts in ({Verdict.BETTER, Verdict.WORSE}, {Verdict.CANNOT_TELL})
    for each in (result, swapped):
        if each.candidates[0].verdict is Verdict.WORSE:
            with pytest.raises(AnswerIsNo, match="worse than"):
                each.check()
        else:
            each.check()


def never_succeeding(result):
    """The same comparison, as if no episode had succeeded."""

    def fail(side):
        runs = [
            dataclasses.replace(run, evaluation=dataclasses.replace(run.evaluation, success_rate=0.0))
            for run in side.runs
        ]
        return dataclasses.replace(side, runs=runs)

    candidates = [dataclasses.replace(candidate, side=fail(candidate.side)) for candidate in result.candidates]
    return dataclasses.replace(result, baseline=fail(result.baseline), candidates=candidates)


@pytest.mark.slow
def test_two_policies_that_never_succeed_pass_no_gate_unless_told_to(root):
    one, two = sorted((root / "0.9/Line").iterdir())
    result = never_succeeding(compare([str(one), str(two)], EvalRequest(None, episodes=4)))
    for margin in (None, 1.0):
        with pytest.raises(AnswerIsNo, match=r"both succeed in none of 4 episodes.*--allow-no-success lets that pass$"):
            result.check(ComparisonGate(margin))
    (name,) = result.find_missed(ComparisonGate(margin=1.0))
    assert name == str(two)
    assert "both succeed" not in str(result.find_missed(ComparisonGate(allow_no_success=True)))
    half = dataclasses.replace(result, candidates=[])
    half.check()


def test_junit_has_a_case_for_each_candidate(root):
    one, two = sorted((root / "0.9/Line").iterdir())
    result = never_succeeding(compare([str(one), str(two)], EvalRequest(None, episodes=4)))
    (case,) = make_suite(result, NOT_WORSE, 1.5).cases
    assert case.name == f"{two} against {one}"
    assert [outcome.tag for outcome in case.outcomes] == ["failure"]
    (case,) = make_suite(result, None, 1.5).cases
    assert [outcome.tag for outcome in case.outcomes] == ["system-out"]


def test_a_parameter_that_is_not_set_has_its_default():
    higher = resolve("ant", None, {"algo": "sac", "algo_kwargs": {"learning_rate": 0.002}})
    unset = resolve("ant", None, {"algo": "sac"})
    same = resolve("ant", None, {"algo": "sac", "algo_kwargs": {"learning_rate": 0.0003}})
    assert find_difference(higher, unset) == {"algo_kwargs.learning_rate": (0.002, 0.0003)}
    assert find_difference(same, unset) == {}


@pytest.mark.slow
def test_a_report_of_two_recipes_begins_with_the_verdict(root):
    text = write_report([f"{root}/0.9*/Line/*"], "md", root / "report.md", episodes=2).read_text()
    assert "\n**gamma 0.99 against gamma 0.9: cannot tell**\n" in text
    assert text.index("cannot tell") < text.index("In the evaluations that selected them")
    assert (
        "- tested: success and return, p-values (not intervals) adjusted for all tests; if all are equal, 5% of" in text
    )


def test_without_scipy_nothing_is_played(root, monkeypatch):
    one, two = sorted((root / "0.9/Line").iterdir())
    monkeypatch.setitem(sys.modules, "scipy.stats", None)
    monkeypatch.setattr("rlctl.runs.compare.comparison.run_evaluation", lambda *_: pytest.fail("played"))
    with pytest.raises(ModuleNotFoundError):
        compare([str(one), str(two)], EvalRequest(None, episodes=20))
