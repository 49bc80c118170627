"""`rlctl train --seeds`: runs of several seeds in a group, their scores, and what is wrong with some of them."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from rlctl.errors import ArtifactError, Interrupted, RecipeError, UsageError
from rlctl.evaluation.eval_request import EvalRequest, Gates
from rlctl.evaluation.group_scores import evaluate_group
from rlctl.launching.seeds import train_seeds
from rlctl.runs.compare.comparison import find_runs_of
from rlctl.runs.directory import RunLock, is_being_written
from rlctl.runs.group import create_group, find_group, parse_seeds, read_group
from rlctl.runs.listing import list_runs, plan_removal
from rlctl.runs.lookup import find_policy, find_run
from rlctl.runs.train_request import TrainRequest
from tests.training.conftest import ENVS, TINY

LINE = f"{ENVS}:Line"


@pytest.mark.parametrize(
    ("text", "seeds"), [("0-4", [0, 1, 2, 3, 4]), ("3", [3]), ("5,0, 7-8", [5, 0, 7, 8]), ("2-2", [2])]
)
def test_seeds(text, seeds):
    assert parse_seeds(text) == seeds


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("3-1", "--seeds 3-1: write a range or a list, such as 0-4"),
        ("0,0", "--seeds 0,0: seed 0 is given twice"),
        ("0-3,2", "--seeds 0-3,2: seed 2 is given twice"),
        ("", "--seeds : write a range or a list, such as 0-4 or 0,3,7"),
        ("-1", "--seeds -1: write a range"),
        ("0-5000", "--seeds 0-5000: write a range or a list, such as 0-4 or 0,3,7; at most 1,000"),
    ],
)
def test_what_is_no_seeds(text, message):
    with pytest.raises(UsageError) as caught:
        parse_seeds(text)
    assert str(caught.value).startswith(message)


def test_a_single_number_is_one_seed_not_so_many(rlctl):
    done = rlctl("train", "reach", "--seeds", "4", "--from", "missing.safetensors")  # ends before any training
    assert done.stderr.splitlines()[0] == "--seeds 4: one run, with seed 4; for 4 seeds: --seeds 0-3"


@pytest.fixture(scope="module")
def group(tmp_path_factory):
    """Two seeds of PPO on the line, side by side."""
    root = tmp_path_factory.mktemp("runs")
    result = train_seeds(TrainRequest(LINE, settings=TINY, root=root, check=False), "4-5", jobs=2, episodes=3)
    assert result.failed == {}
    return result.score.group


@pytest.mark.slow
def test_each_seed_is_an_ordinary_run(group):
    assert group.path.name.endswith("_seeds")
    for seed in (4, 5):
        run = group.find_run(seed)
        assert run.status()["seed"] == seed
        assert run.recipe().algo_kwargs["n_steps"] == 16
        assert run.status()["command"] == ["rlctl", *sys.argv[1:]]  # that of the process that started it
    content = json.loads(group.scores_file.read_text())
    assert [(each["seed"], each["steps"], each["algo"]) for each in content["seeds"]] == [
        (4, 128, "ppo"),
        (5, 128, "ppo"),
    ]
    assert content["seeds"][0]["score"]["episodes"] == 3
    scores = [each["score"]["mean_return"] for each in content["seeds"]]
    assert content["return"]["mean"] == pytest.approx(sum(scores) / 2)


@pytest.mark.slow
def test_runs_of_a_group_are_found(group):
    root = group.path.parent.parent
    newest = find_run(LINE, root).path
    assert newest.parent == group.path
    assert find_policy(LINE, root=root).run.path == newest
    assert (root / "latest").resolve().parent == group.path.resolve()
    names = [run.name for run in list_runs("Line", root=root)]
    assert sorted(names) == sorted(f"Line/{group.path.name}/{group.find_run(seed).path.name}" for seed in (4, 5))
    with pytest.raises(UsageError, match="a group of runs; name one of them"):
        find_run(str(group.path), root)
    assert f"it belongs to the group {group.path}" in find_policy("latest", root=root).notes
    assert find_policy(str(newest), root=root).notes == ()


@pytest.mark.slow
def test_the_newest_thing_trained_is_the_group(group, monkeypatch, tmp_path):
    root = group.path.parent.parent
    one = group.find_run(5).path
    assert [find_group(word, root) for word in ("latest", LINE, str(group.path))] == [group.path] * 3
    assert find_group(str(one), root) is None
    assert find_group(str(root / "latest"), root) is None
    (tmp_path / "runs").symlink_to(root)
    monkeypatch.chdir(tmp_path)
    assert [run.path.name for run in find_runs_of("latest")] == [group.find_run(seed).path.name for seed in (4, 5)]
    assert [run.path for run in find_runs_of(str(one))] == [one]


@pytest.mark.slow
def test_resume_latest_goes_on_with_the_group(group, rlctl):
    """One run was stopped before its first checkpoint: both are in the table at the end."""
    root = group.path.parent.parent
    one = group.find_run(4)
    before = one.status()
    one.write_status({"status": "interrupted"})
    try:
        done = rlctl("train", "--resume", "latest", "-o", root)
    finally:
        one.write_status(before)
    assert done.returncode == 0, done.stderr
    assert f"{group.path}: 2 seeds (4, 5), 1 done, 1 at a time" in done.stderr
    assert [line.split()[0] for line in done.stdout.splitlines()[-5:-3]] == ["4", "5"]


@pytest.mark.slow
def test_a_group_that_is_being_trained_is_not_removed(group):
    with group.find_run(4).lock(), pytest.raises(UsageError, match="this run is being trained; nothing was removed"):
        plan_removal([str(group.path)], root=group.path.parent.parent)


@pytest.mark.slow
def test_a_changed_task_is_one_warning_for_all_seeds(group, capsys):
    runs = [group.find_run(seed) for seed in group.seeds]
    digests = [run.status()["source_sha256"] for run in runs]
    for run in runs:
        run.write_status({"source_sha256": "0" * 64})
    try:
        evaluate_group(read_group(group.path), EvalRequest(None, episodes=2))
    finally:
        for run, digest in zip(runs, digests, strict=True):
            run.write_status({"source_sha256": digest})
    assert capsys.readouterr().err.count("warning: ") == 1


@pytest.mark.slow
def test_what_is_done_stays_and_a_damaged_run_stops_no_other(group, tmp_path):
    file = group.find_run(5).status_file
    content = file.read_text()
    before = group.find_run(4).last_policy.stat().st_mtime_ns
    file.write_text("{")
    try:
        result = train_seeds(TrainRequest(resume=str(group.path), check=False), None, episodes=2)
        assert result.failed == {5: 5}
        with pytest.raises(Exception, match="1 of 2 seeds failed: seed 5 with exit code 5") as caught:
            result.check()
        assert caught.value.exit_code == 5
        scores = evaluate_group(read_group(group.path), EvalRequest(None, episodes=2))
        assert [seed.score is None for seed in scores.seeds] == [False, True]
        assert "run.json: damaged" in scores.as_json()["seeds"][1]["problem"]
        with pytest.raises(ArtifactError, match="1 of 2 seeds have no score; seed 5: "):
            scores.check(Gates())
    finally:
        file.write_text(content)
    assert group.find_run(4).last_policy.stat().st_mtime_ns == before


@pytest.mark.slow
def test_a_signal_stops_all_with_checkpoints(tmp_path):
    """In a thread the signal is sent; the handler is in the main thread, as on the command line."""
    settings = {**TINY, "total_timesteps": 10_000_000}

    def interrupt():
        deadline = time.monotonic() + 250
        while time.monotonic() < deadline and len(list(tmp_path.glob("*/*/*/metrics.csv"))) < 2:
            time.sleep(0.1)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    with pytest.raises(Interrupted, match=r"interrupted; resume with: rlctl train --resume .*_seeds") as caught:
        train_seeds(TrainRequest(LINE, settings=settings, root=tmp_path, check=False), "0-1", jobs=2)
    assert caught.value.exit_code == 130
    (path,) = tmp_path.glob("*/*_seeds")
    for seed in (0, 1):
        run = read_group(path).find_run(seed)
        assert run.status()["status"] == "interrupted"
        assert run.checkpoints()


@pytest.mark.slow
def test_a_group_that_is_being_trained_is_not_resumed(group):
    with RunLock(group.path, "group"), pytest.raises(UsageError, match=r"another process is writing this group \(pid"):
        train_seeds(TrainRequest(resume=str(group.path)), None)


@pytest.mark.slow
def test_trainings_end_with_the_process_that_started_them(tmp_path):
    """It is killed by SIGKILL, which it cannot pass on; then the group can be resumed at once."""
    options = ["-n", "10000000", "--n-envs", "2", "--jobs", "2", "--no-check", "-o", str(tmp_path)]
    command = [sys.executable, "-m", "rlctl", "train", LINE, "--seeds", "0-1", *options]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as parent:
        wait_for(lambda: len(list(tmp_path.glob("*/*/*/run.json"))) == 2)
        parent.kill()
    (path,) = tmp_path.glob("*/*_seeds")
    runs = [read_group(path).find_run(seed) for seed in (0, 1)]
    wait_for(lambda: not any(is_being_written(run.path) for run in runs))
    assert not is_being_written(path)


def wait_for(condition, timeout_s=120.0):
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.1)


def test_what_is_wrong_for_every_seed_is_said_at_once(tmp_path):
    request = TrainRequest(LINE, settings={"algo_kwargs": {"gama": 1}}, root=tmp_path, check=False)
    with pytest.raises(RecipeError, match="gamma"):
        train_seeds(request, "0-1")
    with pytest.raises(UsageError, match="--seeds and --seed exclude each other"):
        train_seeds(TrainRequest(LINE, settings={"seed": 1}, root=tmp_path, check=False), "0-1")
    with pytest.raises(ArtifactError, match=r"group\.json: no such file"):
        train_seeds(TrainRequest(resume=str(tmp_path), check=False), None)
    assert not list(tmp_path.iterdir())


def test_a_request_is_the_same_after_json():
    settings = {"algo": "sac", "algo_kwargs": {"gamma": 0.97}, "task": {}, "n_envs": 2}
    request = TrainRequest("reach", settings=settings, config=Path("my.yaml"), initial_policy="reach", device="cuda")
    assert TrainRequest.from_json(json.loads(json.dumps(request.to_json()))) == request


@pytest.mark.parametrize(
    "change",
    [
        {"json": "/elsewhere/file"},
        {"record": "--json=/elsewhere"},
        {"task": None},
    ],
)
def test_the_file_of_a_group_names_no_other_place(change, tmp_path):
    """It came from somebody else: nothing in it is an option of a command line."""
    group = create_group(TrainRequest(LINE, settings=TINY, root=tmp_path), [0])
    assert read_group(group.path) == group
    file = group.path / "group.json"
    content = json.loads(file.read_text())
    content["request"] |= {"root": "/elsewhere", "resume": "/elsewhere/run"}
    file.write_text(json.dumps(content))
    assert read_group(group.path) == group
    content["request"] |= change
    file.write_text(json.dumps(content))
    with pytest.raises(ArtifactError, match=r"group\.json: damaged, or written by another version of rlctl"):
        read_group(group.path)


def test_a_group_of_somebody_else_runs_no_script(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    group = create_group(TrainRequest("stranger.py:main", settings=TINY, root=tmp_path), [0])
    (tmp_path / "stranger.py").write_text("open('ran', 'w')")
    with pytest.raises(ArtifactError, match=r"group\.json names 'stranger\.py:main' as its task"):
        train_seeds(TrainRequest(resume=str(group.path)), None)
    assert not (tmp_path / "ran").exists()


def test_a_group_of_another_version(tmp_path):
    (tmp_path / "group.json").write_text('{"task": "reach", "seeds": [0], "options": ["--json=/elsewhere"]}')
    with pytest.raises(ArtifactError, match="written by another version of rlctl"):
        read_group(tmp_path)


@pytest.mark.parametrize("seeds", [[0, 0], [10**400], [-1]])
def test_a_group_with_wrong_seeds_is_damaged(tmp_path, seeds):
    group = create_group(TrainRequest(LINE, settings=TINY, root=tmp_path), [0])
    file = group.path / "group.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "seeds": seeds}))
    with pytest.raises(ArtifactError, match=r"group\.json: damaged"):
        read_group(group.path)
