"""Return over minutes of rlctl, RL Baselines3 Zoo and sbx on the same cores: `make compare`. Hours.

RLCTL_ZOO names a Python with rl_zoo3 2.9.2 and rlctl, RLCTL_SBX one with sbx-rl 0.28 and rlctl. One training runs at a
time, with all cores: on one of two, rl-zoo3's TQC has 0.8 times the steps/s, sbx's 0.6 times. Minutes count from the
start of the process and include evaluations. What was measured before, and its folder, is kept in build/compare; the
table and the picture are written from all of it.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import importlib.metadata
import json
import os
import platform
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rlctl.run.directory import RunDirectory
from rlctl.storage import files
from tests.benchmarks.shipped import read_csv
from tests.benchmarks.zoo import PPO_REACH, PPO_REACH_ENVS, ZOO_ENVS

PUBLISHED = {  # the scores of the shipped policies' recipes: return, or success for the last two
    "ant": 3300.0,
    "half-cheetah": 2950.0,
    "hopper": 2600.0,
    "walker2d": 2200.0,
    "humanoid": 0.8,
    "reach": 0.95,
}
BY_SUCCESS = ("humanoid", "reach")
ZOO_ID = {
    "ant": "AntBulletEnv-v0",
    "half-cheetah": "HalfCheetahBulletEnv-v0",
    "hopper": "HopperBulletEnv-v0",
    "walker2d": "Walker2DBulletEnv-v0",
    "humanoid": "HumanoidBulletEnv-v0",
}
EPISODES = 10  # of a peer's evaluation; rlctl evaluates as its recipe says
EVALUATIONS = 50
_POLL_S = 0.5
FOLDER, PAGE = Path("build/compare"), Path("docs/compare.md")


@dataclasses.dataclass
class Curve:
    """The evaluations of a training."""

    task: str
    tool: str
    seed: int
    command: str
    minutes: list[float]
    returns: list[float]
    success: list[float | None]

    @property
    def scores(self) -> list[float]:
        """What the published score is compared with."""
        return [float(value or 0.0) for value in self.success] if self.task in BY_SUCCESS else self.returns

    def minutes_to(self, score: float) -> float | None:
        """Return the minutes to the first evaluation with a score; None if there is none."""
        return next((m for m, reached in zip(self.minutes, self.scores, strict=True) if reached >= score), None)

    def best_after(self, minutes: float) -> float | None:
        """Return the best score of the evaluations until then; None if there was none."""
        return max((s for m, s in zip(self.minutes, self.scores, strict=True) if m <= minutes), default=None)


def train_rlctl(task: str, seed: int, folder: Path) -> tuple[list[str], Callable[[], list[Any]]]:
    """Return the command of the shipped recipe, and a function that reads (returns, success) of its evaluations."""

    def read() -> list[Any]:
        file = RunDirectory(folder / "latest").evals_file
        rows = read_csv(file) if file.exists() else []
        return [(float(row["return"]), float(row["success"]) if row["success"] else None) for row in rows]

    return [sys.executable, "-m", "rlctl", "train", task, "--seed", str(seed), "-o", str(folder)], read


def train_zoo(task: str, seed: int, folder: Path) -> tuple[list[str], Callable[[], list[Any]]]:
    """Return the zoo's command with its own tuned hyperparameters; for `reach`, those of an earlier recipe of rlctl."""
    algo, settings = _read_zoo_settings(task)
    file = folder / "zoo.yml"
    file.write_text(yaml.safe_dump({f"rlctl/{task}-v0": settings}))
    every = int(float(settings["n_timesteps"]) / EVALUATIONS)
    command = [
        *(os.environ["RLCTL_ZOO"], "-m", "rl_zoo3.train", "--algo", algo, "--env", f"rlctl/{task}-v0"),
        *("--gym-packages", "rlctl.gym", "--conf-file", str(file), "--vec-env", "subproc", "--seed", str(seed)),
        *("--eval-freq", str(every), "--eval-episodes", str(EPISODES), "--save-freq", "-1", "-f", str(folder)),
        *("--device", "cpu"),
    ]
    return command, lambda: _read_evaluations(folder)


def _read_zoo_settings(task: str) -> tuple[str, dict[str, Any]]:
    if task == "reach":
        steps = {"n_steps": PPO_REACH_ENVS * PPO_REACH["n_steps"] // ZOO_ENVS}
        network = "dict(log_std_init=-2, net_arch=[64, 64])"
        settings = {**PPO_REACH, **steps, "policy_kwargs": network, "normalize": True, "n_timesteps": 1_000_000}
        return "ppo", {**settings, "n_envs": ZOO_ENVS, "policy": "MlpPolicy"}
    find = "import rl_zoo3, pathlib; print(pathlib.Path(rl_zoo3.__file__).parent / 'hyperparams/tqc.yml')"
    file = subprocess.run([os.environ["RLCTL_ZOO"], "-c", find], check=True, capture_output=True, text=True).stdout
    settings = yaml.safe_load(Path(file.strip()).read_text())[ZOO_ID[task]]
    return "tqc", settings


def _read_evaluations(folder: Path) -> list[Any]:
    rows: list[Any] = []
    for file in folder.rglob("evaluations.npz"):
        with contextlib.suppress(OSError, ValueError, EOFError), np.load(file) as arrays:  # while it is written
            success = arrays.get("successes")
            for index, returns in enumerate(arrays["results"]):
                rows.append((float(returns.mean()), None if success is None else float(success[index].mean())))
    return rows


_SBX = """
import json, sys, gymnasium, sbx, rlctl.gym
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv
job = json.loads(sys.argv[1])
if __name__ == "__main__":
    env = make_vec_env(job["env"], n_envs=job["n_envs"], vec_env_cls=SubprocVecEnv, seed=job["seed"])
    every = max(1, job["every"] // job["n_envs"])
    callback = EvalCallback(
        make_vec_env(job["env"]), n_eval_episodes=job["episodes"], eval_freq=every, log_path=job["folder"], verbose=0
    )
    model = getattr(sbx, job["algo"])("MlpPolicy", env, seed=job["seed"], **job["settings"])
    model.learn(job["steps"], callback=callback)
"""
_SBX_TQC = {
    "learning_rate": 7.3e-4,
    "buffer_size": 300_000,
    "batch_size": 256,
    "gamma": 0.98,
    "tau": 0.02,
    "train_freq": 8,
    "gradient_steps": 32,
    "learning_starts": 1000,
    "policy_kwargs": {"net_arch": [256, 256]},
}
_SBX_PPO = {"learning_rate": 1.2e-3, "n_steps": 320, "batch_size": 640, "n_epochs": 5, "gamma": 0.93}


def train_sbx(task: str, seed: int, folder: Path) -> tuple[list[str], Callable[[], list[Any]]]:
    """Return the command of sbx's TQC with the zoo's learning rate, batch, gamma and tau; for `reach` its PPO."""
    algo, settings, steps = ("PPO", _SBX_PPO, 1_000_000) if task == "reach" else ("TQC", _SBX_TQC, 2_000_000)
    job = {
        "env": f"rlctl/{task}-v0",
        "algo": algo,
        "settings": settings,
        "seed": seed,
        "steps": steps,
        "n_envs": 8 if task == "reach" else 16,
        "episodes": EPISODES,
        "every": steps // EVALUATIONS,
        "folder": str(folder),
    }
    script = folder / "train.py"
    script.write_text(_SBX)
    return [os.environ["RLCTL_SBX"], str(script), json.dumps(job)], lambda: _read_evaluations(folder)


PEERS = {"rl-zoo3": "RLCTL_ZOO", "sbx": "RLCTL_SBX"}
_NAMES = {sys.executable: "python"} | {os.environ[name]: f"${name}" for name in PEERS.values() if name in os.environ}
TOOLS = {"rlctl": train_rlctl, "rl-zoo3": train_zoo, "sbx": train_sbx}


def measure(task: str, tool: str, seed: int, limit_minutes: float) -> Curve:
    """Train until the tool ends or the time is over; raises `RuntimeError` if it fails."""
    folder = (FOLDER / f"{task}_{tool}_{seed}").resolve()
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    command, read = TOOLS[tool](task, seed, folder)
    shown = f"{_NAMES[command[0]]} {shlex.join(command[1:])}".replace(str(folder), "FOLDER")
    curve = Curve(task, tool, seed, shown, [], [], [])
    log = folder / "log.txt"
    began = time.monotonic()
    with log.open("wb") as output, _start(command, output) as process:
        while process.poll() is None and time.monotonic() - began < 60 * limit_minutes:
            time.sleep(_POLL_S)
            _add_new(curve, read(), (time.monotonic() - began) / 60)
        was_stopped = process.poll() is None
    _add_new(curve, read(), (time.monotonic() - began) / 60)
    if not was_stopped and process.returncode != 0:
        raise RuntimeError(f"{tool} {task}: exit code {process.returncode}\n{log.read_text()[-2000:]}")
    return curve


@contextlib.contextmanager
def _start(command: list[str], output: Any) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT, start_new_session=True)
    try:
        yield process
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)  # its workers too
            process.wait()


def _add_new(curve: Curve, evaluations: list[Any], minutes: float) -> None:
    for returns, success in evaluations[len(curve.returns) :]:
        curve.minutes.append(minutes)
        curve.returns.append(returns)
        curve.success.append(success)


def write_page(curves: list[Curve], limit_minutes: float) -> None:
    """Write the table of all curves."""
    lines = [
        "# How long a training takes, next to RL Baselines3 Zoo and sbx\n",
        f"Written by `make compare` on {_describe_machine()}.",
        "One training at a time; minutes from the start of the process, evaluations included.",
        "rl-zoo3 has its own tuned hyperparameters (TQC), for `reach` those of an earlier recipe of rlctl (PPO).",
        "sbx has TQC [256, 256] with the zoo's learning rate, batch, gamma and tau, for `reach` PPO.",
        f"Peers are evaluated on {EPISODES} episodes, rlctl as its recipes say. If a training ended earlier, its best",
        "score counts. `make compare TASKS=ant` adds a task.\n",
        "![score over minutes](pictures/compare.png)\n",
        f"| task | score to reach | tool | seed | minutes to it | best score within {limit_minutes:g} minutes |",
        "|---|---|---|---|---|---|",
    ]
    for curve in curves:
        goal, best = PUBLISHED[curve.task], curve.best_after(limit_minutes)
        reached = curve.minutes_to(goal)
        form = ".0%" if curve.task in BY_SUCCESS else ",.0f"
        cells = [
            f"`{curve.task}`",
            f"{goal:{form}}",
            curve.tool,
            str(curve.seed),
            "not reached" if reached is None else f"{reached:.1f}",
            "no evaluation" if best is None else f"{best:{form}}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    commands = dict.fromkeys(f"{curve.tool}: `{curve.command}`" for curve in curves)
    files.write_text(PAGE, "\n".join([*lines, "", "The commands:\n", *(f"- {text}" for text in commands), ""]))


def _describe_machine() -> str:
    with open("/proc/cpuinfo") as info:
        model = next((line.partition(":")[2].strip() for line in info if line.startswith("model name")), "")
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in ("rlctl", "torch", "numpy"))
    return f"{os.cpu_count()} cores of {model or platform.machine()}, {versions}, rl_zoo3 2.9.2, sbx-rl 0.28.0"


def draw(curves: list[Curve], target: Path) -> None:
    """Draw the score over minutes, a panel per task and a line per training."""
    from matplotlib.figure import Figure

    tasks = list(dict.fromkeys(curve.task for curve in curves))
    columns = min(3, len(tasks))
    rows = -(-len(tasks) // columns)
    figure = Figure(figsize=(3.6 * columns, 2.8 * rows), layout="constrained")
    for number, task in enumerate(tasks, start=1):
        axes = figure.add_subplot(rows, columns, number, title=task, xlabel="minutes")
        axes.axhline(PUBLISHED[task], color="0.7", linestyle=":")
        lines = {}
        for curve in curves:
            if curve.task == task:
                color = f"C{list(TOOLS).index(curve.tool)}"
                (lines[curve.tool],) = axes.plot(curve.minutes, curve.scores, color=color)
        axes.set_ylabel("success rate" if task in BY_SUCCESS else "return")
        axes.legend(lines.values(), lines, frameon=False)
    figure.savefig(target, dpi=110)


def main() -> int:
    """Measure what is missing, and write the page and the picture."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.compare", description=__doc__)
    parser.add_argument("tasks", nargs="*", default=list(PUBLISHED), help="default: all")
    parser.add_argument("--tools", nargs="*", default=list(TOOLS), choices=list(TOOLS))
    parser.add_argument("--seeds", type=int, nargs="*", default=[0])
    parser.add_argument("--minutes", type=float, default=60.0, help="limit of one training")
    options = parser.parse_args()
    for task in options.tasks:
        if task not in PUBLISHED:
            parser.error(f"no task {task!r} here; give {', '.join(PUBLISHED)}")
    for tool in options.tools:
        if tool in PEERS and PEERS[tool] not in os.environ:
            parser.error(f"set {PEERS[tool]} to a Python with {tool} and rlctl, or give --tools rlctl")
    FOLDER.mkdir(parents=True, exist_ok=True)
    for task in options.tasks:
        for seed in options.seeds:
            for tool in options.tools:
                file = FOLDER / f"{task}_{tool}_{seed}.json"
                if not file.exists():
                    print(f"{task} {tool} seed {seed}", file=sys.stderr, flush=True)
                    files.write_json(file, dataclasses.asdict(measure(task, tool, seed, options.minutes)))
    curves = [Curve(**json.loads(file.read_text())) for file in FOLDER.glob("*.json")]
    curves.sort(key=lambda curve: (list(PUBLISHED).index(curve.task), list(TOOLS).index(curve.tool), curve.seed))
    write_page(curves, 30.0)
    draw(curves, Path("docs/pictures/compare.png"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
