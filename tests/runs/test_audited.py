"""What `rlctl runs show --audit` found is shown from then on."""

import json

import pytest


def test_the_last_audit_of_a_run_is_shown(write_run, rlctl):
    run = write_run("reach/a")
    learned = {"learned": "it has learned to stand (return 1)", "verdict": "alive pays it"}
    content = {"format": "rlctl check-env audit 1", **learned}
    (run / "audit.json").write_text(json.dumps(content))
    shown = rlctl("runs", "show", run)
    assert "audit: it has learned to stand (return 1)\naudit: alive pays it\n" in shown.stdout
    assert json.loads(rlctl("runs", "show", run, "--json", "-").stdout)["audit"] == content


@pytest.mark.slow
def test_a_run_that_hardly_succeeds_names_the_command(write_run, rlctl):
    poor, good = write_run("reach/a", evals=((1000, 0.2, 1.0),)), write_run("reach/b", evals=((1000, 0.9, 1.0),))
    assert f"what has it learned instead? rlctl runs show {poor} --audit\n" in rlctl("runs", "show", poor).stdout
    assert "--audit" not in rlctl("runs", "show", good).stdout


@pytest.mark.slow_except(first=1)
@pytest.mark.parametrize("text", ["{}", "[1", '{"format": "rlctl check-env audit 9"}'])
def test_a_file_of_something_else_is_a_warning(write_run, rlctl, text):
    run = write_run("reach/a")
    (run / "audit.json").write_text(text)
    shown = rlctl("runs", "show", run)
    assert shown.returncode == 0
    assert "warning: " in shown.stdout
    assert "audit.json" in shown.stdout


@pytest.mark.slow
def test_a_policy_that_has_learned_nothing_is_not_called_good(rlctl, tmp_path):
    small = ("--set", "n_envs=4", "--set", "eval.episodes=4", "--set", "algo_kwargs.n_steps=32")
    trained = rlctl("train", "reach", "-n", "512", "--no-check", *small, "--set", "algo_kwargs.batch_size=64")
    assert trained.returncode == 0, trained.stderr
    shown = rlctl("runs", "show", "--audit")
    assert shown.returncode == 0, shown.stderr
    (line,) = [line for line in shown.stdout.splitlines() if line.startswith("audit: it has learned")]
    assert "what is wanted" not in line
    assert "reaching the goal" in line or "the shipped policy" in line


def test_a_time_limit_without_anything_to_play_is_refused(write_run, rlctl):
    done = rlctl("runs", "show", write_run("reach/a"), "--env-timeout", 5)
    assert (done.returncode, done.stderr.splitlines()[0]) == (
        2,
        "error: --env-timeout: nothing is played without --audit",
    )


@pytest.mark.slow
def test_the_value_of_the_recipe_is_beside_the_changed_one(write_run, rlctl):
    changed = {"recipe_changes": {"algo_kwargs.gamma": 0.97}, "recipe_before": {"algo_kwargs.gamma": 0.99}}
    shown = rlctl("runs", "show", write_run("reach/a", **changed)).stdout
    assert "differs from the task's recipe: algo_kwargs.gamma = 0.97 (recipe: 0.99)\n" in shown
