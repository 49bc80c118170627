"""The examples work as their texts say."""

from __future__ import annotations

import csv
import json
import os
import shutil
import subprocess
import sys
import venv
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests import fork_server

EXAMPLES = Path(__file__).parent.parent / "examples"


def rlctl(*arguments: str, cwd: Path, path: Path | None = None) -> str:
    """Run `rlctl` in `cwd`, with `path` as one more place that packages are installed in; return its stdout."""
    return run("-m", "rlctl", *arguments, cwd=cwd, path=path)


def run(*arguments: str, cwd: Path, path: Path | None = None) -> str:
    env = {**os.environ, "PYTHONPATH": str(path)} if path else None
    done = fork_server.for_commands().run([sys.executable, *arguments], cwd=cwd, env=env)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def findings(task: str, cwd: Path, *options: str) -> set[str]:
    command = [sys.executable, "-m", "rlctl", "check-env", task, "--json", "-", *options]
    done = fork_server.for_commands().run(command, cwd=cwd)
    return {finding["rule"] for finding in json.loads(done.stdout)["findings"]}


@pytest.mark.slow
@pytest.mark.pybullet
def test_broken_env_has_the_mistakes_that_its_text_names(tmp_path: Path) -> None:
    source = (EXAMPLES / "broken_env/pushed_ball.py").read_text()
    first = {"RL204", "RL301", "RL309", "RL501", "RL609", "RL704", "RL808"}
    assert findings(f"{EXAMPLES}/broken_env/pushed_ball.py:PushedBall", tmp_path) == first
    drawn = "np.random.uniform(-0.5, 0.5, 2)  # noqa: NPY002"
    assert drawn in source
    (tmp_path / "seeded.py").write_text(
        source.replace(f"place = {drawn}", "super().reset(seed=seed); place = self.np_random.uniform(-0.5, 0.5, 2)")
    )
    changed = ("--select", "RL301,RL309,RL401,RL605")  # what the other rules find does not change
    assert findings("seeded.py:PushedBall", tmp_path, *changed) == {"RL401", "RL605"}


@pytest.mark.slow
def test_bare_env_is_clean(tmp_path: Path) -> None:
    assert findings(f"{EXAMPLES}/bare_env/pointmass.py:PointMass", tmp_path) == set()


@pytest.mark.slow
def test_reacher_of_mujoco_trains(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    rlctl("train", "Reacher-v5", "-n", "1600", "--set", "eval.episodes=2", cwd=tmp_path)


@pytest.mark.slow
def test_bare_env_trains_by_path(tmp_path: Path) -> None:
    small = ["--set", "algo_kwargs.n_steps=25", "--set", "algo_kwargs.batch_size=100", "--set", "eval.episodes=4"]
    task = f"{EXAMPLES}/bare_env/pointmass.py:PointMass"
    rlctl("train", task, "-n", "400", "--n-envs", "4", *small, cwd=tmp_path)
    run_folder = tmp_path / "runs" / "latest"
    # The recipe beside the file was found: its learning rate is not the default.
    recipe = yaml.safe_load((run_folder / "recipe.yaml").read_text())
    assert recipe["algo_kwargs"]["learning_rate"] == 1e-3
    # is_success of a plain environment makes the success column.
    with (run_folder / "evals.csv").open(newline="") as lines:
        assert float(next(csv.DictReader(lines))["success"]) >= 0.0


def test_ci_workflow_uses_options_that_exist() -> None:
    workflow = yaml.safe_load((EXAMPLES / "ci" / "rlctl.yml").read_text())
    commands = [step["run"].split() for step in workflow["jobs"]["learn"]["steps"] if "rlctl " in step.get("run", "")]
    verbs = [command for command in commands if command[0] == "rlctl"]
    assert {verb[1] for verb in verbs} == {"train", "eval", "gate", "replay", "runs"}
    for verb in verbs:
        page = run("-m", "rlctl", *verb[1 : 3 if verb[1] == "runs" else 2], "--help", cwd=EXAMPLES)
        assert [word for word in verb if word.startswith("--") and word not in page] == []


def test_ci_workflow_installs_what_its_variable_names() -> None:
    workflow = yaml.safe_load((EXAMPLES / "ci" / "rlctl.yml").read_text())
    (install,) = [step["run"] for step in workflow["jobs"]["learn"]["steps"] if "pip install" in step.get("run", "")]
    assert install == 'pip install "$RLCTL" .'
    assert workflow["env"]["RLCTL"] == "rlctl"


@pytest.mark.slow
def test_ci_workflow_and_a_new_plugin_install_without_an_index(tmp_path: Path) -> None:
    repository, root = tmp_path / "repository", EXAMPLES.parent
    shutil.copytree(EXAMPLES / "my_task", repository)
    tracked = ("pyproject.toml", "README.md", "LICENSE", "constraints.txt", "rlctl", "plugins")
    (repository / "rlctl").mkdir()
    for name in tracked:
        copy = shutil.copytree if (root / name).is_dir() else shutil.copy
        copy(root / name, repository / "rlctl" / name)
    scripts = _environment_without_rlctl(tmp_path / "venv")
    workflow = yaml.safe_load((EXAMPLES / "ci" / "rlctl.yml").read_text())
    offline = {"PIP_NO_INDEX": "1", "PIP_NO_BUILD_ISOLATION": "0"}  # pip reads the second the wrong way round
    place = {"RLCTL": "./rlctl", "PIP_CONSTRAINT": "rlctl/constraints.txt"}
    env = {**os.environ, **offline, **workflow["env"], **place, "PATH": f"{scripts}:{os.environ['PATH']}"}

    def shell(command: str) -> str:
        done = subprocess.run(command, shell=True, cwd=repository, env=env, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    (install,) = [step["run"] for step in workflow["jobs"]["learn"]["steps"] if "pip install" in step.get("run", "")]
    shell(install)
    shell("rlctl tasks new my-arm")
    shell("pip install ./my-arm")  # not -e: offline there is nothing that hatchling needs for it
    tasks = {task["name"] for task in json.loads(shell("rlctl tasks --check --json -"))["tasks"]}
    assert {"my-task", "my-arm", "reach"} <= tasks


def _environment_without_rlctl(folder: Path) -> Path:
    """Make an environment that has whatever this one has, except rlctl; return its scripts."""
    venv.create(folder, with_pip=True)
    everything = folder / "everything"
    everything.mkdir()
    for site in dict.fromkeys(each for each in sys.path if each.endswith("site-packages")):
        for place in Path(site).iterdir():
            if "rlctl" not in place.name and not place.name.endswith(".pth") and not (everything / place.name).exists():
                (everything / place.name).symlink_to(place)
    (site,) = folder.glob("lib/python*/site-packages")
    for old in site.glob("setuptools*"):  # the one of venv is older than torch wants
        shutil.rmtree(old)
    (site / "everything.pth").write_text(f"{everything}\n")
    return folder / "bin"


def test_my_task_has_a_command_of_its_own(tmp_path: Path, install: Any) -> None:
    site = install("my-task", {"first-rewards": "my_task.first_rewards:first_rewards"}, group="rlctl.commands")
    shutil.copytree(EXAMPLES / "my_task/my_task", site / "my_task")
    printed = rlctl("first-rewards", "my_task.touch:Touch", "--episodes", "2", "--json", "-", cwd=tmp_path, path=site)
    result = json.loads(printed)
    assert result["task"] == "my_task.touch:Touch"
    assert len(result["rewards"]) == 2
    assert max(result["rewards"]) < 0.0  # the tip is not at the point


@pytest.mark.slow
def test_my_task_as_a_wheel(tmp_path: Path) -> None:
    project = EXAMPLES / "my_task"
    run("-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path / "dist"), str(project), cwd=tmp_path)
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    site = tmp_path / "site"
    run("-m", "pip", "install", "--quiet", "--no-deps", "--target", str(site), str(wheel), cwd=tmp_path)

    listed = json.loads(rlctl("tasks", "--json", "-", cwd=tmp_path, path=site))
    assert "my-task" in json.dumps(listed)
    assert rlctl("first-rewards", "my-task", "--episodes", "1", cwd=tmp_path, path=site).startswith("seed 0: -")

    empty = tmp_path / "empty"
    empty.mkdir()
    rlctl("train", "my-task", "-n", "4000", "--set", "eval.episodes=8", cwd=empty, path=site)
    assert (empty / "runs" / "latest" / "policies" / "best.safetensors").is_file()

    run("-m", "pytest", "-q", "-p", "no:cacheprovider", str(project / "tests"), cwd=empty, path=site)


STEPS = yaml.safe_load((EXAMPLES / "ci" / "check-env" / "action.yml").read_text())["runs"]["steps"]


def run_action(tmp_path: Path, task: str, arguments: str = "") -> tuple[int, dict[str, str]]:
    """Run the text of the action's check, as GitHub's runner does; return its exit code and outputs."""
    (step,) = [step for step in STEPS if step.get("id") == "check"]
    output = tmp_path / "output"
    output.unlink(missing_ok=True)
    env = {**os.environ, "TASK": task, "ARGUMENTS": arguments, "NO_COLOR": "1"}
    env |= {"RUNNER_TEMP": str(tmp_path), "GITHUB_OUTPUT": str(output)}
    env["PATH"] = f"{Path(sys.executable).parent}:{env['PATH']}"
    done = subprocess.run(["bash", "-e", "-c", step["run"]], cwd=EXAMPLES / "bare_env", env=env, check=False)
    return done.returncode, dict(line.split("=", 1) for line in output.read_text().splitlines())


@pytest.mark.slow
def test_the_check_env_action_runs(tmp_path: Path) -> None:
    code, outputs = run_action(tmp_path, "pointmass.py:PointMass", "--select RL1")
    assert (code, outputs["exit-code"]) == (0, "0")
    assert json.loads(Path(outputs["report"]).read_text())["findings"] == []


@pytest.mark.slow
def test_arguments_of_the_action_may_have_several_lines(tmp_path: Path) -> None:
    assert run_action(tmp_path, "pointmass.py:Nobody", "--select RL99")[0] == 2
    assert run_action(tmp_path, "pointmass.py:Nobody", "--select RL99\n--help")[0] == 0


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("node") is None, reason="needs node")
def test_the_action_comments_on_the_check_that_it_ran(tmp_path: Path) -> None:
    report = tmp_path / "check-env-pointmass.py-Nobody.json"
    report.write_text('{"findings": []}')  # of an earlier use in the same job
    code, outputs = run_action(tmp_path, "pointmass.py:Nobody", "--select RL99")
    assert (code, outputs) == (2, {"report": str(report), "exit-code": "2"})
    said = comment(tmp_path, outputs, code)
    assert "The check did not run (exit code 2)." in said
    assert "RL99" in said  # the error
    report.write_text('{"findings": []}')
    assert "No findings, but exit code 70" in comment(tmp_path, outputs, 70)


def comment(tmp_path: Path, outputs: dict[str, str], code: int) -> str:
    """Run the script of the action's comment; GitHub's API refuses the token, which is a warning."""
    (step,) = [step for step in STEPS if "github-script" in step.get("uses", "")]
    script = tmp_path / "comment.js"
    script.write_text(
        "const context = {repo: {}, issue: {number: 1}}, core = {warning: console.log}\n"
        "const rest = {issues: {createComment: c => { console.log(c.body); throw Error('no permission') }}}\n"
        "const github = {rest, paginate: async () => []}\n"
        f";(async () => {{\n{step['with']['script']}\n}})()\n"
    )
    env = {**os.environ, "TASK": "pointmass.py:Nobody", "REPORT": outputs["report"], "EXIT_CODE": str(code)}
    done = subprocess.run(["node", script], env=env, capture_output=True, text=True, check=True)
    assert "no comment on the pull request: no permission" in done.stdout
    return done.stdout
