import dataclasses
import json
import math
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.stats

from rlctl.environments.registry import find_origin
from rlctl.environments.spec import EnvChanges
from rlctl.errors import AnswerIsNo, UsageError
from rlctl.evaluation.episode_statistics import Spread, mean_interval, mean_terms, success_interval, success_rate
from rlctl.evaluation.eval_request import EvalRequest, Gates
from rlctl.evaluation.evaluate import measure_score, run_evaluation
from rlctl.evaluation.group_scores import GroupScore, SeedScore
from rlctl.evaluation.junit import make_group_suite, make_suite
from rlctl.evaluation.report import as_json
from rlctl.launching.train import run_training
from rlctl.play.messages import EpisodeResult
from rlctl.policy.file import PolicyFile
from rlctl.runs.tables import read_table
from rlctl.runs.train_request import TrainRequest
from rlctl.task.pybullet.library import is_installed
from tests import fork_server
from tests.training.conftest import ENVS, SMALL_PPO


@pytest.fixture(scope="module")
def reach_run(tmp_path_factory):
    """A barely trained policy for reach: evaluation does not care how good it is."""
    root = tmp_path_factory.mktemp("runs")
    settings = {**SMALL_PPO, "eval": {"episodes": 2, "every_steps": 256}}
    return run_training(TrainRequest("reach", settings=settings, root=root, check=False)).run


@pytest.fixture(scope="module")
def evaluation(reach_run):
    return run_evaluation(EvalRequest(str(reach_run.path), episodes=6))


def result(success, total=1.0, terms=None):
    return EpisodeResult(0, 0, total, 10, success, terms or {}, None)


def test_success_interval_by_hand():
    results = [result(True)] * 8 + [result(False)] * 2
    assert success_rate(results) == 0.8
    low, high = success_interval(results)
    # Clopper and Pearson: at the lower end 8 or more of 10 have a probability of 0.025, at the upper end 8 or fewer.
    assert sum(math.comb(10, k) * low**k * (1 - low) ** (10 - k) for k in (8, 9, 10)) == pytest.approx(0.025)
    assert sum(math.comb(10, k) * high**k * (1 - high) ** (10 - k) for k in (9, 10)) == pytest.approx(0.975)
    # At the ends [0, 1 - 0.025^(1/n)] and [0.025^(1/n), 1].
    assert success_interval(results[8:]) == (0.0, pytest.approx(1 - 0.025 ** (1 / 2)))
    assert success_interval(results[:8]) == (pytest.approx(0.025 ** (1 / 8)), 1.0)


@pytest.mark.slow_except("0.9")
@pytest.mark.parametrize("rate", [0.5, 0.9, 0.995])
def test_success_interval_covers_at_least_as_often_as_it_says(rate):
    episodes = 100
    covered = 0.0
    for good in range(episodes + 1):
        low, high = success_interval([result(True)] * good + [result(False)] * (episodes - good))
        covered += math.comb(episodes, good) * rate**good * (1 - rate) ** (episodes - good) * (low <= rate <= high)
    assert covered >= 0.95  # Wilson's interval covers 91 % at 0.995


def test_no_success_is_not_zero_success():
    assert success_rate([result(None)]) is None
    assert success_interval([result(None)]) is None


def test_spread_by_hand():
    # Middle half of 0 1 2 3 4 5 6 100: 2 3 4 5, mean 3.5.
    spread = Spread.of([100, 0, 1, 2, 3, 4, 5, 6])
    assert spread.iqm == 3.5
    assert spread.mean == 121 / 8
    assert (spread.min, spread.max) == (0, 100)
    assert Spread.of([1.0, 3.0]).std == pytest.approx(2**0.5)
    assert Spread.of([1.0]).std == 0.0


def test_mean_terms_add_up():
    results = [result(True, 3.0, {"a": 1.0, "b": 2.0}), result(True, 5.0, {"a": 5.0, "b": 0.0})]
    assert mean_terms(results) == {"a": 3.0, "b": 1.0}


@pytest.mark.slow
def test_an_episode_does_not_depend_on_what_runs_beside_it(reach_run, evaluation):
    alone = run_evaluation(EvalRequest(str(reach_run.path), episodes=6, n_envs=1))
    assert [episode.result.total_reward for episode in alone.played] == [
        episode.result.total_reward for episode in evaluation.played
    ]
    assert len({episode.result.seed for episode in evaluation.played}) == 6


@pytest.mark.slow
def test_evaluations_of_a_training_say_how_far_bodies_overlap(reach_run):
    assert {row["overlap"] for row in read_table(reach_run.evals_file)} == {0.0}  # the arm touches nothing


def test_a_policy_of_a_package_that_is_not_installed_names_it(reach_run, rlctl, tmp_path):
    trained = PolicyFile.read(reach_run.best_policy)
    assert trained.info.origin == find_origin("reach")
    file = tmp_path / "given.safetensors"
    spec = dataclasses.replace(trained.info.spec, task="segbot")
    trained.with_info(spec=spec, origin={"distribution": "segbot", "version": "0.1.0"}).write(file)
    assert rlctl("eval", file).stderr == (
        "error: this policy was trained on the task 'segbot' of the package segbot 0.1.0, which is not installed\n"
        "install segbot 0.1.0 from its folder or wheel: pip install PATH; what is installed: rlctl tasks\n"
    )
    other = EvalRequest(str(file), task="reach", episodes=1)
    assert run_evaluation(other).spec.task == "reach"
    trained.with_info(spec=spec, origin={}).write(file)  # of an older version
    with pytest.raises(UsageError, match=r"'segbot', which is not installed\ninstall its package from its folder"):
        run_evaluation(EvalRequest(str(file), episodes=1))


def test_terms_add_up_to_the_return(evaluation):
    for episode in evaluation.played:
        assert sum(episode.result.terms.values()) == pytest.approx(episode.result.total_reward)
    assert evaluation.final_distance is not None
    assert evaluation.final_distance.min > 0


@pytest.mark.parametrize("count", [2, 3, 4, 5, 6, 7, 30, 100, 1001, 20_000])
def test_the_interval_of_a_mean_is_students(count):
    values = np.random.default_rng(0).normal(3.0, 2.0, count)
    expected = scipy.stats.t.interval(0.95, count - 1, values.mean(), scipy.stats.sem(values))
    assert mean_interval(values) == pytest.approx(expected, rel=1e-9)


def test_the_mean_return_has_an_interval(evaluation, reach_run, rlctl):
    returns = [episode.result.total_reward for episode in evaluation.played]
    # Student's t of 5 degrees of freedom: 97.5 % lie below 2.570582.
    half = 2.570582 * np.std(returns, ddof=1) / math.sqrt(6)
    low, high = np.mean(returns) - half, np.mean(returns) + half
    assert as_json(evaluation)["return_interval"] == [pytest.approx(low), pytest.approx(high)]
    shown = f"mean return {np.mean(returns):.4g}  (95 % interval {low:.4g} to {high:.4g})"
    assert shown in rlctl("eval", reach_run.path, "--episodes", "6").stdout.splitlines()


def test_json_has_what_ci_needs(evaluation):
    content = as_json(evaluation)
    assert content["sim"] == ("pybullet" if is_installed() else "mujoco")
    assert {"success_rate", "success_interval", "return", "episodes", "task", "policy", "versions"} <= content.keys()
    assert content["return"].keys() == {"mean", "iqm", "std", "min", "max"}
    assert content["episodes"][2].keys() >= {"index", "seed", "success", "return", "length", "terms"}
    assert content["return"]["mean"] == pytest.approx(np.mean([each["return"] for each in content["episodes"]]))
    json.dumps(content, allow_nan=False)


@pytest.mark.slow
def test_tolerance_is_a_parameter(reach_run):
    wide = EvalRequest(str(reach_run.path), episodes=4, changes=EnvChanges({"tolerance": 10.0}))
    assert run_evaluation(wide).success_rate == 1.0


@pytest.mark.slow
@pytest.mark.pybullet
def test_it_says_whether_it_was_randomised(reach_run, evaluation, rlctl):
    shaken = run_evaluation(EvalRequest(str(reach_run.path), episodes=6, changes=EnvChanges(randomize=True)))
    offered = as_json(evaluation)["events"]
    assert offered
    assert not any(offered.values())
    assert as_json(evaluation)["randomized"] is False
    assert as_json(shaken)["randomized"] is True
    assert as_json(shaken)["events"] == dict.fromkeys(offered, True)
    assert [each.result.total_reward for each in shaken.played] != [
        each.result.total_reward for each in evaluation.played
    ]
    plain = rlctl("eval", reach_run.path, "--episodes", 2)
    assert "2 episodes, seed 0, PyBullet, not randomised" in plain.stdout
    randomised = rlctl("eval", reach_run.path, "--episodes", 2, "--set", "randomize=true")
    assert f"2 episodes, seed 0, PyBullet, randomised by {', '.join(offered)}" in randomised.stdout


@pytest.mark.slow
def test_stochastic_repeats_with_its_seed(reach_run):
    request = EvalRequest(str(reach_run.path), episodes=2, deterministic=False)
    first, second = (run_evaluation(request).returns.mean for _ in range(2))
    assert first == second
    assert first != run_evaluation(EvalRequest(str(reach_run.path), episodes=2)).returns.mean


@pytest.mark.parametrize(
    ("gates", "message"),
    [
        (Gates(min_success=1.0), r"success rate 0\.\d+ is below 1"),
        (Gates(min_success_lower=1.0), r"lower bound 0\.\d+ of the success rate is below 1"),
        (Gates(min_return=1e9), "mean return .* is below 1e"),
        (Gates(min_success=1.0, min_return=1e9), "success rate .*; mean return"),
    ],
)
def test_gates(evaluation, gates, message):
    with pytest.raises(AnswerIsNo, match=message):
        evaluation.check(gates)


def test_a_bound_that_no_episodes_reach_is_refused_before_they_are_played(reach_run):
    request = EvalRequest(str(reach_run.path), episodes=20)
    # 0.025 ** (1 / 20) = 0.8316; log 0.025 / log 0.9 = 35.01
    with pytest.raises(
        UsageError, match=r"--min-success-lower 0\.9: 20 successes reach at most 0\.832; use --episodes 36$"
    ):
        run_evaluation(request, Gates(min_success_lower=0.9))
    with pytest.raises(UsageError, match=r"--min-success-lower 1: 20 successes reach at most 0\.832$"):
        run_evaluation(request, Gates(min_success_lower=1.0))


@pytest.mark.parametrize("name", ["min_success", "min_success_lower"])
def test_a_rate_is_between_0_and_1(name):
    with pytest.raises(UsageError, match=r": a rate is between 0 and 1; 95 % is 0\.95$"):
        Gates(**{name: 95})
    with pytest.raises(UsageError, match=r": a rate is between 0 and 1$"):
        Gates(**{name: -0.5})


def test_a_return_to_reach_is_a_number():
    with pytest.raises(UsageError, match="--min-return nan: every return would pass"):
        Gates(min_return=math.nan)


@pytest.mark.slow
def test_a_gate_on_success_needs_success(tmp_path):
    run = run_training(TrainRequest(f"{ENVS}:NoSuccess", settings=SMALL_PPO, root=tmp_path, check=False)).run
    with pytest.raises(UsageError, match="--min-success: this task reports no success"):
        run_evaluation(EvalRequest(str(run.path), episodes=2), Gates(min_success=0.5))
    assert run_evaluation(EvalRequest(str(run.path), episodes=2), Gates(min_return=-1e9)).success_rate is None
    seed = SeedScore(0, score=measure_score(EvalRequest(str(run.path), episodes=2)))
    with pytest.raises(UsageError, match="--min-success: this task reports no success"):
        GroupScore(None, [seed]).check(Gates(min_success_lower=0.5))


SILENT = """
    import gymnasium, numpy as np

    class Silent(gymnasium.Env):
        observation_space = action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            with open("resets", "a") as file:
                file.write("reset\\n")
            return np.zeros(1, np.float32), {}

        def step(self, action):
            return np.zeros(1, np.float32), 0.0, True, False, {}
"""


def test_a_gate_on_success_is_refused_after_the_first_episode_without_it(write_module, rlctl, tmp_path):
    write_module("silent.py", SILENT)
    command = ("eval", "silent.py:Silent", "--policy", "zero", "--episodes", "300", "--n-envs", "1")
    refused = rlctl(*command, "--min-success", "0.9", cwd=tmp_path)
    assert refused.returncode == 2
    assert "--min-success: this task reports no success" in refused.stderr
    varied = rlctl(*command, "--min-success", "0.9", "--push", cwd=tmp_path)
    assert "--min-success: this task reports no success" in varied.stderr
    assert len((tmp_path / "resets").read_text().splitlines()) < 10


def test_command_line_gate_and_pure_json(rlctl, reach_run, tmp_path):
    done = rlctl(*("eval", str(reach_run.path), "--episodes", "3", "--min-success", "1", "--json", "-"), cwd=tmp_path)
    assert done.returncode == 1
    content = json.loads(done.stdout)
    assert content["policy"]["training_steps"] == 256
    assert content["gates"] == {"min_success": 1.0, "min_success_lower": None, "min_return": None}
    assert [gate.partition(" 0")[0] for gate in content["gates_missed"]] == ["success rate"]
    assert done.stderr.strip().splitlines()[-1].startswith("error: gate missed: success rate 0")


def test_policy_for_another_task_is_refused(rlctl, reach_run, tmp_path):
    done = rlctl("eval", str(reach_run.best_policy), "--task", "Pendulum-v1", "--episodes", "1", cwd=tmp_path)
    assert done.returncode == 5
    assert "this policy is not for this task: its observation space is Box(" in done.stderr
    assert ", the environment's is Box([-1. -1. -8.], [1. 1. 8.], (3,), float32)" in done.stderr
    assert "Traceback" not in done.stderr


def test_no_run_yet(rlctl, tmp_path):
    done = rlctl("eval", cwd=tmp_path)
    assert done.returncode == 5
    assert done.stderr == f"error: no run yet under {tmp_path / 'runs'}; train one: rlctl train reach\n"


def test_a_run_without_a_best_policy(rlctl, reach_run, tmp_path):
    run = tmp_path / "runs" / "reach" / "2026-01-01_00-00-00_s0"
    run.mkdir(parents=True)
    (run / "run.json").write_text('{"task": "reach"}')
    done = rlctl("eval", "reach", cwd=tmp_path)
    assert done.returncode == 5
    assert "no best policy yet; train longer, or use --checkpoint last" in done.stderr


@pytest.mark.slow
def test_an_exported_policy_is_evaluated_alike_and_without_torch(reach_run, evaluation, tmp_path):
    from rlctl.exporting.export import export_policy
    from rlctl.exporting.export_request import ExportRequest

    exported = tmp_path / "policy.onnx"
    export_policy(ExportRequest(str(reach_run.path), ("onnx",), "best", exported))
    code = (
        "import sys; from rlctl.cli import run\n"
        f"code = run(['eval', {str(exported)!r}, '--task', 'reach', '--episodes', '6', '--n-envs', '1',"
        " '--json', 'result.json'])\n"
        "sys.exit(99 if {'torch', 'stable_baselines3', 'scipy'} & set(sys.modules) else code)"
    )
    done = fork_server.for_workers().run([sys.executable, "-c", code], cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    alike = json.loads((tmp_path / "result.json").read_text())["episodes"]
    for ours, theirs in zip(alike, as_json(evaluation)["episodes"], strict=True):
        assert [ours[key] for key in ("seed", "success", "length")] == [
            theirs[key] for key in ("seed", "success", "length")
        ]
        assert ours["return"] == pytest.approx(theirs["return"], rel=1e-3)


def test_junit_has_a_case_for_each_gate(evaluation):
    suite = make_suite(evaluation, Gates(min_success=0.0, min_success_lower=0.99, min_return=-1e9), 2.5)
    names = ["--min-success 0", "--min-success-lower 0.99", "--min-return -1e+09"]
    assert [case.name for case in suite.cases] == names
    assert [case.outcomes[0].tag for case in suite.cases] == ["system-out", "failure", "system-out"]
    assert suite.cases[1].outcomes[0].message.startswith("lower bound 0.")
    assert [case.name for case in make_suite(evaluation, Gates(), 2.5).cases] == ["evaluation"]


def test_junit_has_the_seeds_of_a_group_and_an_error_for_one_without_a_score():
    group = SimpleNamespace(task="reach")
    scores = GroupScore(group, [SeedScore(0, problem="not started yet")])
    (case,) = make_group_suite(scores, Gates(min_success=0.5), 1.0).cases
    assert (case.classname, case.name, case.outcomes[0].tag) == ("reach.eval", "seed 0", "error")


@pytest.mark.slow
def test_a_missed_gate_and_an_error_are_in_the_junit_file(reach_run, rlctl, tmp_path):
    done = rlctl("eval", reach_run.path, "--episodes", 2, "--min-return", 1e9, "--junit", "eval.xml")
    assert done.returncode == 1
    assert '<failure message="mean return' in (tmp_path / "eval.xml").read_text()
    assert rlctl("eval", "nothing.onnx", "--junit=eval.xml").returncode == 5
    assert '<error message="' in (tmp_path / "eval.xml").read_text()
