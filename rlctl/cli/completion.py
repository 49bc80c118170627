"""Shell completion of tasks, algorithms and runs. Imports no plugin and no library."""

from pathlib import Path

_RUNS = Path("runs")
_MOST = 50


def complete_task(incomplete: str) -> list[str]:
    """Return the installed tasks and the Python files here that begin with `incomplete`."""
    from rlctl.environments import installed  # here, because the help of every command imports this module

    names = [entry.name for entry in installed.list_installed() if entry.problem is None]
    return [name for name in (*dict.fromkeys(names), *_list_paths(incomplete, "*.py")) if name.startswith(incomplete)]


def complete_algorithm(incomplete: str) -> list[str]:
    """Return the algorithms that begin with `incomplete`."""
    known = ("ppo", "a2c", "sac", "td3", "ddpg", "dqn", "tqc", "crossq", "recurrent_ppo")
    return [name for name in known if name.startswith(incomplete)]


def complete_run(incomplete: str) -> list[str]:
    """Return `latest`, tasks with runs, runs (newest first) and policy files here that begin with `incomplete`."""
    runs = sorted((file.parent for file in _RUNS.glob("*/*/run.json")), key=lambda run: run.name, reverse=True)
    tasks = dict.fromkeys(run.parent.name for run in runs)
    latest = ["latest"] if runs else []
    files = [*_list_paths(incomplete, "*.safetensors"), *_list_paths(incomplete, "*.onnx")]
    candidates = [*latest, *tasks, *(str(run) for run in runs[:_MOST]), *files]
    return [text for text in candidates if text.startswith(incomplete)]


def _list_paths(incomplete: str, pattern: str) -> list[str]:
    folder = Path(incomplete).parent if "/" in incomplete else Path()
    return [str(path) for path in sorted(folder.glob(pattern))[:_MOST]]
