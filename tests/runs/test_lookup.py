"""What a user's word for RUN stands for, and what is said about the choice."""

import json
import os
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from rlctl.environments import registry
from rlctl.environments.info import EnvInfo
from rlctl.environments.spec import EnvSpec
from rlctl.errors import PLAY_OTHERS, ArtifactError, UsageError
from rlctl.policy.file import PolicyFile, PolicyInfo, Score
from rlctl.runs import directory, lookup
from rlctl.runs.directory import RunDirectory
from rlctl.runs.lookup import find_policy, find_run
from rlctl.storage import files


def error(kind, call, *arguments):
    with pytest.raises(kind) as caught:
        call(*arguments)
    return str(caught.value)


def test_the_newest_run(root, make_run):
    make_run("reach", "2026-01-01_10-00-00_s0")
    newest = make_run("ant", "2026-01-03_10-00-00_s0")
    reach = make_run("reach", "2026-01-02_10-00-00_s9")
    (root / "reach" / "notes").mkdir()
    assert find_run(None, root).path == find_run("latest", root).path == newest.path
    assert find_run("reach", root).path == reach.path
    assert find_run(str(newest.path), root).path == newest.path
    assert find_run("some/where/ant.py:ant", root).path == newest.path


def test_latest_is_the_run_that_it_leads_to_now(root, make_run):
    run = make_run("reach", "2026-01-01_10-00-00_s0")
    (root / "latest").symlink_to(Path("reach", run.path.name))
    assert find_run(str(root / "latest"), root).path == run.path


def test_a_folder_of_runs_names_one(root, make_run):
    run = make_run("reach", "2026-01-01_10-00-00_s0")
    assert error(ArtifactError, find_run, str(root), root) == (
        f"{root}: not a run of rlctl: it has no run.json; in it is {run.path}"
    )


def test_of_two_in_one_second_the_later(root, make_run):
    first = make_run("reach", "2026-01-01_10-00-00_s0")
    second = make_run("reach", "2026-01-01_10-00-00_s0_1")
    os.utime(first.status_file, (1, 1))
    assert find_run("reach", root).path == second.path


def test_no_run_yet(root):
    expected = f"no run yet under {root}; train one: rlctl train reach"
    assert error(ArtifactError, find_run, None, root) == expected
    assert error(ArtifactError, find_run, "reach", root) == (
        f"no run of 'reach' yet under {root}; train one: rlctl train reach; "
        "to use the policy that it ships: --pretrained"
    )
    assert ArtifactError("").exit_code == 5


def test_a_word_that_stands_for_no_run(root, make_run, tmp_path):
    make_run("reach", "2026-01-01_10-00-00_s0")
    assert error(ArtifactError, find_run, "raech", root) == (
        "no run 'raech': neither a folder nor a task with a run. Did you mean 'reach'?"
    )
    assert error(ArtifactError, find_run, "hoper", root).endswith("nor a task with a run. Did you mean 'hopper'?")
    (tmp_path / "stuff").mkdir()
    assert error(ArtifactError, find_run, "stuff", root) == "stuff: not a run of rlctl: it has no run.json"


@pytest.mark.parametrize(
    "text",
    [
        "{root}/reach/2026-01-01_10-00-00_s1",
        "{root}/reech/2026-01-01_10-00-00_s0",
        "2026-01-01_10-00-0_s0",
        "2026-01-01_10-00-00_s0/",
    ],
)
def test_a_typo_in_the_name_of_a_run_suggests_the_run_and_no_task(root, make_run, text):
    run = make_run("reach", "2026-01-01_10-00-00_s0")
    message = error(ArtifactError, find_run, text.format(root=root), root)
    assert message.endswith(f" Did you mean '{run.path}'?")


@pytest.mark.parametrize("text", ["reach/other", "2024-03", "runs/reach"])
def test_a_path_that_is_like_no_run_suggests_no_task(root, make_run, text):
    make_run("hopper", "2026-01-01_10-00-00_s0")
    assert error(ArtifactError, find_run, text, root).endswith(" All runs: rlctl runs")


def test_which_policy(root, make_run):
    run = make_run("reach", "2026-01-01_10-00-00_s0")
    found = find_policy("reach", root=root)
    assert found.file == run.best_policy
    assert found.run.path == run.path
    assert find_policy(str(run.best_policy), root=root).run.path == run.path
    assert (
        error(ArtifactError, find_policy, "reach", "last", root)
        == f"{run.path}: no last policy yet; the run saved none"
    )
    assert error(UsageError, find_policy, "reach", "worst", root) == (
        "--checkpoint 'worst': give best, last, or the step of a checkpoint"
    )
    assert error(ArtifactError, find_policy, "reach", "500", root) == (
        f"{run.path}: no checkpoint at step 500; there are: none"
    )
    folder = run.checkpoint(1200)
    folder.mkdir(parents=True)
    (folder / "policy.safetensors").write_bytes(b"")
    assert folder.name == "000001200"
    assert find_policy("reach", "1200", root).file == folder / "policy.safetensors"
    assert error(ArtifactError, find_policy, "reach", "500", root).endswith("there are: 1200")


def test_no_best_policy_yet(root, make_run):
    run = make_run("reach", "2026-01-01_10-00-00_s0", policy="last")
    assert error(ArtifactError, find_policy, "reach", "best", root) == (
        f"{run.path}: no best policy yet; train longer, or use --checkpoint last"
    )
    assert find_policy("reach", "last", root).file == run.last_policy


def test_a_policy_file_itself(root, tmp_path):
    file = tmp_path / "mine.safetensors"
    assert error(ArtifactError, find_policy, str(file)) == f"{file}: no such file"
    file.write_bytes(b"")
    assert find_policy(str(file)) == lookup.FoundPolicy(file, None)


BOX = {"type": "Box", "low": "-1.0", "high": "1.0", "shape": [1], "dtype": "float32"}


def give_policy(run, success=None, mean_return=0.0, steps=1000, parameters=None, file=None):
    info = PolicyInfo(
        algo="ppo",
        policy="MlpPolicy",
        env=EnvInfo(observation_space=BOX, action_space=BOX),
        spec=EnvSpec("reach", parameters or {}),
        training_steps=steps,
        evaluation=Score(success=success, mean_return=mean_return),
    )
    file = file or run.best_policy
    PolicyFile(info, {"policy/x": np.zeros(1)}).write(file)
    os.utime(file, (1e9, 1e9))


@pytest.mark.parametrize(
    ("evaluated", "last", "note"),
    [
        ([40_960], 69_632, "last is 28,672 steps newer than best and was never evaluated: --checkpoint last"),
        ([40_960, 69_632], 69_632, None),  # evaluated, and not better
        ([40_960, 69_632], 71_680, None),  # hardly newer than what was not better
    ],
)
def test_a_much_newer_policy_that_was_never_evaluated_is_named(root, make_run, evaluated, last, note):
    run = make_run("reach", "2026-01-01_10-00-00_s0")
    give_policy(run, success=0.04, steps=40_960)
    give_policy(run, steps=last, file=run.last_policy)
    rows = "".join(f"{steps},0.04,1.0\n" for steps in evaluated)
    run.evals_file.write_text(f"steps,success,return\n{rows}")
    assert find_policy(str(run.path), root=root).notes == (() if note is None else (note,))
    assert find_policy(str(run.path), "last", root).notes == ()


def test_a_task_stands_for_its_newest_run_with_a_policy(root, make_run, monkeypatch):
    first, second, third = (make_run("reach", f"2026-01-0{day}_10-00-00_s0") for day in (1, 2, 3))
    third.best_policy.unlink()
    give_policy(first, success=0.9)
    give_policy(second, success=0.5)
    monkeypatch.setattr(lookup.time, "time", lambda: 1e9 + 7200)
    found = find_policy("reach", root=root)
    assert found.file == second.best_policy
    assert found.notes == (
        f"run {second.path}: policy of step 1,000, saved 2 h ago",
        f"skipped {third.path}: no such policy yet",
        f"an older run had a better evaluation: {first.path} (success 90.0% against 50.0%)",
    )
    # The newest run is what `latest` says, with a policy or not.
    assert error(ArtifactError, find_policy, "latest", "best", root) == (
        f"{third.path}: no best policy yet; train longer, or use --checkpoint last"
    )
    # Who names a run, or a file, knows which it is.
    assert find_policy(str(first.path), root=root).notes == ()
    assert find_policy(str(first.best_policy), root=root).notes == ()


def test_only_runs_of_the_same_problem_are_compared(root, make_run):
    first, second = (make_run("reach", f"2026-01-0{day}_10-00-00_s0") for day in (1, 2))
    give_policy(first, mean_return=5.0, parameters={"tolerance": 0.5})
    give_policy(second, mean_return=1.0)
    assert len(find_policy("reach", root=root).notes) == 1
    give_policy(first, mean_return=5.0)
    assert find_policy(None, root=root).notes[1].endswith(f"{first.path} (return 5 against 1)")


def test_no_run_of_a_task_has_a_policy(root, make_run):
    runs = [make_run("reach", f"2026-01-0{day}_10-00-00_s0") for day in (1, 2)]
    for run in runs:
        run.best_policy.unlink()
    assert error(ArtifactError, find_policy, "reach", "best", root).startswith(f"{runs[1].path}: no best policy yet; ")


@pytest.mark.parametrize("text", [None, "latest", "runs/latest"])
def test_latest_is_the_newest_run_when_its_own_was_removed(root, make_run, text):
    left = make_run("reach", "2026-01-01_10-00-00_s0")
    removed = directory.create("ant", 0, root)
    removed.write_status({"task": "ant"})
    assert find_run(text, root).path.resolve() == removed.path
    shutil.rmtree(removed.path)
    assert not (root / "latest").exists()
    assert find_run(text, root).path.resolve() == left.path


def test_a_model_of_sb3_is_told_what_it_is(root, make_run, tmp_path):
    (tmp_path / "model.zip").write_bytes(b"PK")
    assert error(ArtifactError, find_policy, "model.zip", "best", root) == (
        "model.zip: a .zip, the model format of Stable-Baselines3, not a run; convert it: "
        "rlctl runs import model.zip --task TASK"
    )


def test_a_task_by_path_is_found_from_other_folders(root, make_run, tmp_path, monkeypatch):
    run = RunDirectory(tmp_path / "project" / "runs" / "Swing" / "2026-01-01_10-00-00_s0")
    run.path.mkdir(parents=True)
    original = tmp_path / "project" / "swing.py"
    original.write_text("")
    run.status_file.write_text(json.dumps({"task": "swing.py:Swing", "folder": str(tmp_path / "project")}))

    def located(folder):
        monkeypatch.chdir(folder)
        return lookup.locate_task("swing.py:Swing", run)

    (tmp_path / "other").mkdir()
    assert located(tmp_path / "project") == "swing.py:Swing"
    assert located(tmp_path / "other") == f"{original}:Swing"
    (tmp_path / "other" / "swing.py").write_text("")  # by chance of the same name
    assert located(tmp_path / "other") == f"{original}:Swing"
    (tmp_path / "project" / "swinging_arms.py").write_text("")
    assert lookup.locate_task("swinging_arms:Swing", run) == "swinging_arms:Swing"
    assert registry.find_source_file("swinging_arms:Swing") == tmp_path / "project" / "swinging_arms.py"
    moved = RunDirectory(tmp_path / "other" / "runs" / "Swing" / run.path.name)
    moved.path.parent.mkdir(parents=True)
    run.path.rename(moved.path)
    assert lookup.locate_task("swing.py:Swing", moved) == "swing.py:Swing"
    assert lookup.locate_task("reach", moved) == "reach"
    assert lookup.locate_task("swing.py:Swing", None) == "swing.py:Swing"


def test_looking_for_changes_of_a_source_does_not_change_what_is_imported(tmp_path, monkeypatch):
    run = RunDirectory(tmp_path / "project" / "runs" / "Swing" / "2026-01-01_10-00-00_s0")
    run.path.mkdir(parents=True)
    source = tmp_path / "project" / "swinging_ropes.py"
    source.write_text("")
    status = {"task": "swinging_ropes:Swing", "folder": str(tmp_path / "project"), "source_sha256": files.digest(b"")}
    run.status_file.write_text(json.dumps(status))
    monkeypatch.chdir(tmp_path)
    before = list(sys.path)
    assert lookup.describe_source_change(run) is None
    source.write_text("changed = True")
    assert "has changed" in lookup.describe_source_change(run)
    assert sys.path == before


def test_the_file_of_an_id_is_that_of_its_class_from_any_folder(tmp_path, monkeypatch):
    run = RunDirectory(tmp_path / "project" / "runs" / "Rope-v0" / "2026-01-01_10-00-00_s0")
    run.path.mkdir(parents=True)
    package = tmp_path / "project" / "hanging_ropes"
    package.mkdir()
    (package / "__init__.py").write_text("import gymnasium\ngymnasium.register('Rope-v0', 'hanging_ropes.rope:Rope')\n")
    (package / "rope.py").write_text("MODEL = 'rope.xml'\n")
    (package / "rope.xml").write_text("<mujoco/>")
    monkeypatch.chdir(tmp_path / "project")
    task = "hanging_ropes:Rope-v0"
    identity = {**registry.identify_task(task), "files_sha256": registry.identify_files(task)}
    run.status_file.write_text(json.dumps({"task": task, "folder": str(tmp_path / "project"), **identity}))
    assert lookup.describe_source_change(run) is None
    (package / "rope.xml").write_text("<mujoco model='rope'/>")
    assert "rope.xml" in lookup.describe_source_change(run)
    monkeypatch.chdir(tmp_path)
    assert lookup.describe_source_change(run) is None  # it is not found from here


def test_trials_of_a_tuning_are_not_the_latest(root, make_run):
    assert "train one" in error(ArtifactError, find_run, "latest", root)
    make_run("reach/2026-01-02_10-00-00_tune", "2026-01-02_10-00-01_s0", policy=None)
    folder = root / "reach/2026-01-02_10-00-00_tune"
    (folder / directory.TUNE_FILE).write_text("{}")
    assert f"only trials of rlctl tune; name one of them, from {folder}" in error(
        ArtifactError, find_policy, "latest", "best", root
    )
    run = make_run("reach", "2026-01-01_10-00-00_s0")
    assert find_policy("latest", root=root).run.path == run.path


def test_a_file_that_is_no_policy(root, make_run):
    run = make_run("reach", "2026-01-01_10-00-00_s0")
    run.metrics_file.write_text("steps\n")
    assert error(ArtifactError, find_policy, str(run.metrics_file), "best", root) == (
        f"{run.metrics_file}: neither a run nor a policy (.safetensors, .onnx); its run: {run.path}. {PLAY_OTHERS}"
    )


def test_a_policy_file_is_no_run(root, make_run):
    run = make_run("reach", "2026-01-01_10-00-00_s0")
    policy = run.best_policy
    policy.parent.mkdir(exist_ok=True)
    policy.touch()
    text = f"{policy}: a policy file, and a run is needed; its run: {run.path.resolve()}. rlctl eval {policy}"
    assert error(UsageError, find_run, str(policy), root) == text
    alone = root / "walk.onnx"
    alone.touch()
    assert "a run is needed; it has none here. rlctl eval" in error(UsageError, find_run, str(alone), root)
