"""`rlctl replay --worst`, `--best`, `--failures`: episodes by outcome."""

import dataclasses

import pytest
import typer

from rlctl.cli import build_app
from rlctl.errors import UsageError
from rlctl.evaluation.eval_request import EvalRequest
from rlctl.evaluation.evaluate import run_evaluation
from rlctl.play.messages import EpisodeResult
from rlctl.replaying import sources
from rlctl.replaying.choice import choose_episodes, select
from rlctl.replaying.replay import run_replay
from rlctl.replaying.replay_request import Choice, ReplayRequest


def results(*outcomes):
    return [EpisodeResult(0, seed, total, 10, success, {}, None) for seed, (success, total) in enumerate(outcomes)]


@pytest.mark.parametrize(
    ("kind", "count", "seeds"),
    [("worst", 2, [3, 1]), ("worst", 9, [3, 1, 0, 2]), ("best", 1, [2]), ("failures", 9, [3, 1]), ("failures", 1, [3])],
)
def test_success_counts_before_the_return(kind, count, seeds):
    played = results((True, 1.0), (False, 5.0), (True, 2.0), (False, -1.0))
    assert [result.seed for result in select(played, Choice(kind, count))] == seeds


def test_without_success_the_return_counts():
    played = results((None, 1.0), (None, 5.0))
    assert [result.seed for result in select(played, Choice("best", 1))] == [1]
    with pytest.raises(UsageError, match="reports no success; use --worst 3, which selects by return"):
        select(played, Choice("failures", 3))


@pytest.mark.slow
def test_they_are_episodes_of_the_evaluation_bit_for_bit(run, tmp_path, capsys):
    request = ReplayRequest(str(run.run.path), episodes=5, output=tmp_path, worst=2)
    result = run_replay(request)
    evaluated = run_evaluation(EvalRequest(str(run.run.path), episodes=5)).episodes
    expected = sorted((bool(row["success"]), row["return"], row["seed"]) for row in evaluated)[:2]
    assert [(each.success, each.total_reward, each.seed) for each in result.episodes] == expected
    assert all(each.recording.is_file() for each in result.episodes)
    assert result.choice.startswith("the 2 worst of 5 episodes, of which ")
    assert "warning" not in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(("off", "warns"), [(5e-15, False), (0.25, True)])
def test_a_return_that_has_changed_since_the_choice_is_reported(run, tmp_path, monkeypatch, capsys, off, warns):
    def choose(*arguments):
        chosen, text = choose_episodes(*arguments)
        return [dataclasses.replace(result, total_reward=result.total_reward - off) for result in chosen], text

    monkeypatch.setattr(sources, "choose_episodes", choose)
    run_replay(ReplayRequest(str(run.run.path), episodes=1, output=tmp_path, worst=1))
    assert (", +0.25 off from when the episode was chosen" in capsys.readouterr().err) is warns


@pytest.mark.slow
def test_no_failures_is_an_answer(replay, run, tmp_path):
    done = replay(run.run.path, "--failures", 2, "--episodes", 2, "--set", "task.tolerance=9", "-o", "out")
    assert done.returncode == 0, done.stderr
    assert "nothing to replay: no failure among 2 episodes (seed 0)" in done.stdout
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "source", "counts"),
    [
        (["--best", "reach"], "reach", {"best": 1}),
        (["--best", "2", "reach"], "reach", {"best": 2}),
        (["--failures=3", "reach"], "reach", {"failures": 3}),
        (["reach", "--worst"], "reach", {"worst": 1}),
        (["--worst", "--episodes", "5"], None, {"worst": 1}),
        (["--best", "x"], "x", {"best": 1}),
        (["--best", "--", "7"], "7", {"best": 1}),
        (["--checkpoint", "last", "7"], "7", {}),
    ],
)
def test_only_a_number_after_an_option_is_its_own(arguments, source, counts):
    command = typer.main.get_command(build_app(["replay"])).commands["replay"]
    parameters = command.make_context("replay", list(arguments)).params
    assert parameters["source"] == source
    assert {name: n for name in ("worst", "best", "failures") if (n := parameters[name]) is not None} == counts


@pytest.mark.parametrize(("value", "problem"), [("0", "greater than or equal to 1"), ("-2", "greater"), ("1.5", "int")])
def test_a_number_below_1_or_not_whole_is_refused(rlctl, value, problem):
    done = rlctl("replay", "--best", value)
    assert done.returncode == 2
    assert "Invalid value for '--best'" in done.stderr
    assert problem in done.stderr


@pytest.mark.slow_except(first=2)
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["--worst", "1", "--best", "1"],
            "--worst and --best exclude each other: leave out --best",
        ),
        (["x.npz", "--worst", "1"], "x.npz is a recorded episode and is replayed unchanged: leave out --worst"),
        (
            ["--verify", "x.npz", "--worst", "1"],
            "x.npz is a recorded episode and is replayed unchanged: leave out --worst",
        ),
        (["--worst", "2", "-o", "y.rrd"], "--output y.rrd: a recording has one episode; give a folder for 2"),
        (["--video", "y.avi"], "--video y.avi: give a file that ends in .mp4 or .gif, or .png for one picture"),
    ],
)
def test_bad_requests(replay, arguments, message):
    done = replay(*arguments)
    assert (done.returncode, done.stderr) == (2, f"error: {message}\n")
