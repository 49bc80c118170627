"""The Python API: `rlctl.make`, `check_env`, `train`, `evaluate` and `load_policy`."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    import gymnasium

    from rlctl.checking.rule import RuleFinding
    from rlctl.environments.spec import EnvSpec
    from rlctl.evaluation.evaluate import Evaluation
    from rlctl.launching.train import TrainResult
    from rlctl.policy.policy import Policy


def make(
    task: str,
    *,
    render_mode: Literal["human", "rgb_array"] | None = None,
    randomize: bool = False,
    events: Mapping[str, Mapping[str, Any]] | None = None,
    sim: str | None = None,
    **parameters: Any,
) -> gymnasium.Env[Any, Any]:
    """Return the Gymnasium environment of a task; keywords are the task's parameters.

    `randomize` enables all events of the task; `events` enables the named ones and sets their parameters:
    `events={"mass": {"factor": (0.9, 1.1)}}`. `sim` is the physics engine, like `--sim`: `pybullet`, `mujoco`, or
    `mujoco:0.01` with the time constant of contacts [s]; default: that of the task's recipe.
    """
    from rlctl.environments.registry import is_task, make_slug

    spec = dataclasses.replace(_make_spec(task, parameters, sim), randomize=randomize, events=events or {})
    env = spec.make(render_mode)
    if is_task(spec.constructor()):
        from gymnasium.envs.registration import EnvSpec as GymnasiumSpec

        own = {"task": task, "render_mode": render_mode, "randomize": randomize, "events": events, "sim": sim}
        name, kwargs = f"rlctl/{make_slug(task)}-v0", own | parameters
        env.unwrapped.spec = GymnasiumSpec(name, "rlctl.api:make", kwargs=kwargs, disable_env_checker=True)
    return env


def _make_spec(task: str, parameters: Mapping[str, Any], sim: str | None) -> EnvSpec:
    from rlctl.engine import read_engine
    from rlctl.recipe.recipe_files import make_spec

    spec = make_spec(task, parameters)
    return spec if sim is None else dataclasses.replace(spec, sim=read_engine(sim))


def check_env(
    task: str,
    /,
    *,
    select: Sequence[str] = (),
    ignore: Sequence[str] = (),
    env_timeout_s: float = 10.0,
    budget_s: float | None = None,
    baseline: str | os.PathLike[str] | None = None,
    sim: str | None = None,
    **parameters: Any,
) -> list[RuleFinding]:
    """Check an environment as `rlctl check-env` does, in child processes, and return the findings, worst first.

    Keywords are parameters of the task. `sim` is the physics engine, as for `make`. `select` and `ignore` are
    prefixes of rule ids: `ignore=["RL5"]`. A finding has `rule`, `severity` ("error", "warning", "info"), `message`,
    `fix` and `evidence`; `str(finding)` is one line. Those of `baseline`, a report of `rlctl check-env --json` on the
    task under the same name, are left out. `budget_s` is the computing time of each process of the check [s], like
    `--budget`.
    Raises `UsageError` for an unknown task or parameter, `ArtifactError` for a file that is no report, `TaskError` if
    no instance can be built and no finding says why, and `AnswerIsNo`, with the findings, if a quarter or more of the
    rules were not judged for lack of time.
    """
    from rlctl.checking.check import check
    from rlctl.checking.rule_index import choose_rules
    from rlctl.checking.tool_formats import read_baseline
    from rlctl.errors import AnswerIsNo, RlctlError, TaskError

    rules, known = choose_rules(select, ignore), set() if baseline is None else read_baseline(Path(baseline))
    spec = _make_spec(task, parameters, sim)
    report = check(spec, rules=rules, env_timeout_s=env_timeout_s, budget_s=budget_s, show_progress=False)
    report.subtract(known)
    if report.verdict.crashed:
        names, details = ", ".join(report.verdict.crashed), "\n".join(report.verdict.crashed.values())
        raise RlctlError(f"check_env: a bug in rlctl: {names} crashed on {task}; please report it", details=details)
    if report.records.built is None and not (report.verdict.findings or report.verdict.known):
        raise TaskError(f"{task}: no instance could be built, so nothing was checked; rlctl check-env {task} shows why")
    if report.is_incomplete:
        found = [str(finding) for finding in report.verdict.findings]
        raise AnswerIsNo("\n".join([f"{report.summarize()}; here: budget_s={report.needed_budget}", *found]))
    return sorted(report.verdict.findings, key=lambda finding: (finding.severity.rank, finding.rule))


def train(
    task: str,
    /,
    *,
    config: str | Path | None = None,
    device: str = "cpu",
    root: str | Path = "runs",
    check: bool = True,
    initial_policy: str | os.PathLike[str] | None = None,
    demos: str | os.PathLike[str] | None = None,
    **recipe: Any,
) -> TrainResult:
    """Train as `rlctl train` does; `load_policy` and `evaluate` accept the result's `run`.

    Keywords are the keys of a recipe (`docs/recipe.md`): `train("reach", seed=1, algo_kwargs={"gamma": 0.97})`. They
    override those of `config`, a recipe file. `initial_policy` is a run, a policy file or a task's name, like `--from`;
    `demos` are demonstrations to clone first, like `--demos`. In a script, call it below
    `if __name__ == "__main__":`, because worker processes may import the script. Raises the exceptions of
    `rlctl.errors`.
    """
    from rlctl.launching.train import run_training
    from rlctl.runs.train_request import TrainRequest

    request = TrainRequest(
        task=task,
        config=None if config is None else Path(config),
        settings=recipe,
        device=device,
        root=Path(root),
        check=check,
        initial_policy=None if initial_policy is None else os.fspath(initial_policy),
        demos=None if demos is None else os.fspath(demos),
    )
    return run_training(request)


def evaluate(
    run: str | os.PathLike[str] | None = None,
    /,
    *,
    task: str | None = None,
    parameters: Mapping[str, Any] | None = None,
    checkpoint: str = "best",
    episodes: int = 100,
    seed: int = 0,
    deterministic: bool = True,
    **recipe: Any,
) -> Evaluation:
    """Evaluate as `rlctl eval` does, and return the statistics and every episode.

    `run` is a run's folder, a policy file, a task's name, or None for the latest run. `task` replaces the task of the
    training, and `parameters` are changes of the task's parameters. The other keywords are the recipe's keys for the
    environment: `reward_weights`, `randomize`, `events`. `pandas.DataFrame(result.episodes)` is a table of them.
    """
    from rlctl.errors import UsageError
    from rlctl.evaluation.eval_request import EvalRequest
    from rlctl.evaluation.evaluate import run_evaluation
    from rlctl.recipe.sources import check_changes

    if task is not None and not isinstance(task, str):
        raise UsageError(
            f"evaluate: task must be the name of a task, got {task!r}; pass its parameters as parameters={{...}}"
        )
    if episodes < 1 or seed < 0:
        raise UsageError(f"evaluate: episodes={episodes}, seed={seed}: episodes must be 1 or more, seed 0 or more")
    request = EvalRequest(
        run=None if run is None else os.fspath(run),
        task=task,
        checkpoint=checkpoint,
        episodes=episodes,
        seed=seed,
        changes=check_changes({**recipe, **({"task": parameters} if parameters else {})}, "evaluate"),
        deterministic=deterministic,
    )
    return run_evaluation(request)


def load_policy(path: str | os.PathLike[str], /) -> Policy:
    """Load a `.safetensors` file, an exported `.onnx` file, or the best policy of a run's folder; without torch.

    `load_policy(path).predict(observation)` returns the action. The name of an installed task, `load_policy("ant")`,
    means the policy that ships with the task, never that of a run. Raises `ArtifactError` if it is not a policy.
    """
    from rlctl.environments import installed
    from rlctl.errors import ArtifactError, did_you_mean
    from rlctl.hub import store
    from rlctl.policy import load
    from rlctl.policy.shipped import find_shipped_policy
    from rlctl.runs.directory import RunDirectory

    name, file = os.fspath(path), Path(path)
    if store.is_address(name):
        file = store.fetch(name)
    elif not file.suffix and installed.find(name) is not None:
        file = find_shipped_policy(name)
    elif not file.suffix and not file.exists():
        close = did_you_mean(name, [entry.name for entry in installed.list_installed()])
        raise ArtifactError(
            f"{name}: no such file, and no installed task.{close} The newest run's policy: load_policy('runs/latest')"
        )
    if RunDirectory(file).status_file.is_file():
        file = RunDirectory(file).policy_file()
    return load.load_policy(file)
