"""`rlctl export RUN --dataset minari|lerobot`: episodes of a policy as a dataset for other libraries."""

import importlib
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl import output
from rlctl.environments.dict_spaces import split
from rlctl.environments.info import EnvInfo
from rlctl.environments.registry import make_slug
from rlctl.environments.spec import EnvChanges
from rlctl.errors import UsageError, explain_missing_package
from rlctl.evaluation.eval_request import EvalRequest
from rlctl.evaluation.evaluate import start_workers
from rlctl.evaluation.players import find_player
from rlctl.exporting.export_request import ExportRequest
from rlctl.play.collect import Episode, play_episodes
from rlctl.play.seeds import Stream, episode_seeds
from rlctl.storage import files

_PACKAGES = {"minari": ("minari", "h5py"), "lerobot": ("pyarrow",)}
_LAYOUT = {"data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet", "video_path": None}
_SIZES = {"chunks_size": 1000, "data_files_size_in_mb": 100, "video_files_size_in_mb": 200}  # LeRobot's defaults


def export_dataset(request: ExportRequest) -> dict[str, Any]:
    """Write the episodes that `rlctl eval` plays; return the content of the report.

    Raises `UsageError` for a missing extra, and for a folder that exists.
    """
    try:
        for package in _PACKAGES[str(request.dataset)]:
            importlib.import_module(package)
    except ImportError as error:
        raise UsageError(explain_missing_package(f"--dataset {request.dataset}", error.name, "demos")) from None
    changes = EnvChanges(sim=request.sim)
    played = EvalRequest(request.run, checkpoint=request.checkpoint, episodes=request.episodes, changes=changes)
    source, policy, spec = find_player(played)
    task, default = make_slug(spec.task), source.run.path / "exports" if source.run is not None else Path()
    folder = request.output or default / f"{task}-{request.dataset}"
    if folder.exists():
        raise UsageError(f"--output {folder}: exists already; give a new folder, or remove this one")
    with (
        start_workers(spec, played) as workers,
        output.show_progress("playing", request.episodes, "episodes") as show_progress,
    ):
        policy.give_to(workers)
        env, seeds = workers.info, episode_seeds(played.seed, Stream.EVAL, request.episodes)
        episodes = play_episodes(workers, seeds, record=True, watch=show_progress)
    with files.whole_folder(folder) as part:
        (_write_minari if request.dataset == "minari" else _write_lerobot)(part, task, env, episodes)
    successes = None if episodes[0].result.success is None else sum(bool(e.result.success) for e in episodes)
    steps = sum(episode.result.length for episode in episodes)
    counts = {"episodes": len(episodes), "successes": successes, "steps": steps}
    return {"path": folder, "format": request.dataset, "task": spec.task, **counts}


def show(report: dict[str, Any], json: str | None) -> None:
    """Print a report, or only JSON for `-`."""
    if not output.present(report, json):
        successes = "" if report["successes"] is None else f", {report['successes']} succeeded"
        content = f"{output.format_count(report['episodes'], 'episode')}{successes}, {report['steps']:,} steps"
        output.out().print(f"wrote {report['path']}: {report['format']}, {content}")


def _write_minari(folder: Path, task: str, env: EnvInfo, episodes: list[Episode]) -> None:
    import minari
    from minari.data_collector import EpisodeBuffer
    from minari.dataset.minari_storage import MinariStorage

    storage = MinariStorage.new(folder / "data", *env.spaces(), jpeg_encoding=False)
    storage.update_metadata({"dataset_id": f"rlctl/{task}-v0", "minari_version": minari.__version__})
    storage.update_episodes(
        EpisodeBuffer(
            seed=episode.result.seed,
            observations=episode.recorded.observations,
            actions=episode.recorded.actions,
            rewards=episode.recorded.rewards,
            terminations=_mark_last(episode, episode.terminated),
            truncations=_mark_last(episode, not episode.terminated),
            infos=None if (success := episode.result.success) is None else {"success": _mark_last(episode, success)},
        )
        for episode in episodes
    )


def _mark_last(episode: Episode, value: bool) -> NDArray[np.bool_]:
    """Return a flag per step; only the last one is `value`."""
    return np.append(np.zeros(episode.result.length - 1, np.bool_), value)


def _write_lerobot(folder: Path, task: str, env: EnvInfo, episodes: list[Episode]) -> None:
    """Write format v3.0: descriptions in `meta/`, and one table with a row per step."""
    dt, columns = env.control_dt or 1.0, _list_columns(episodes)
    lengths = [episode.result.length for episode in episodes]
    ends, zeros = np.cumsum(lengths), np.zeros(len(lengths), np.int64)
    columns |= {"index": np.arange(ends[-1]), "task_index": np.zeros(ends[-1], np.int64)}
    columns |= {"timestamp": (columns["frame_index"] * dt).astype(np.float32)}
    features = {
        name: {"dtype": str(values.dtype), "shape": values.shape[1:] or [1], "names": None}
        for name, values in columns.items()
    }
    totals = {"total_episodes": len(ends), "total_frames": len(columns["index"]), "total_tasks": 1}
    described = {"codebase_version": "v3.0", "robot_type": env.robot, "fps": 1 / dt}
    described |= {"splits": {"train": f"0:{len(ends)}"}, "features": features}
    files.write_json(folder / "meta/info.json", described | totals | _LAYOUT | _SIZES)
    files.write_json(folder / "meta/stats.json", {name: _summarize(values) for name, values in columns.items()})
    _write_table(folder / "meta/tasks.parquet", {"task_index": zeros[:1], "task": np.array([task])}, index="task")
    rows = {"episode_index": np.arange(len(ends)), "length": np.array(lengths), "tasks": np.full((len(ends), 1), task)}
    rows |= {"dataset_from_index": ends - lengths, "dataset_to_index": ends}
    rows |= {f"{kind}/{part}_index": zeros for kind in ("data", "meta/episodes") for part in ("chunk", "file")}
    _write_table(folder / "meta/episodes/chunk-000/file-000.parquet", rows)
    _write_table(folder / "data/chunk-000/file-000.parquet", columns)


def _list_columns(episodes: list[Episode]) -> dict[str, NDArray[Any]]:
    rows = []
    for number, episode in enumerate(episodes):
        played, steps = episode.recorded, np.arange(episode.result.length)
        parts = {f"observation.{key or 'state'}": values[:-1] for key, values in split(played.observations).items()}
        parts |= {"action": played.actions, "next.reward": played.rewards, "next.done": _mark_last(episode, True)}
        if episode.result.success is not None:
            parts["next.success"] = _mark_last(episode, episode.result.success)
        rows.append(parts | {"frame_index": steps, "episode_index": np.full_like(steps, number)})
    columns = {name: np.concatenate([parts[name] for parts in rows]) for name in rows[0]}
    for name, values in columns.items():
        if values.ndim > 2:
            raise UsageError(f"--dataset lerobot: {name} has the shape {values.shape[1:]}; only vectors can be written")
    return {name: values.astype(np.float32) if values.dtype.kind == "f" else values for name, values in columns.items()}


def _summarize(values: NDArray[Any]) -> dict[str, Any]:
    rows = values.reshape(len(values), -1).astype(np.float64)
    moments = {"min": rows.min(0), "max": rows.max(0), "mean": rows.mean(0), "std": rows.std(0), "count": [len(rows)]}
    return {name: np.asarray(value).tolist() for name, value in moments.items()}


def _write_table(path: Path, columns: dict[str, NDArray[Any]], index: str = "") -> None:
    import pyarrow
    from pyarrow import parquet

    def as_column(values: NDArray[Any]) -> Any:
        return values if values.ndim == 1 else pyarrow.FixedSizeListArray.from_arrays(values.ravel(), values.shape[1])

    table = pyarrow.table({name: as_column(values) for name, values in columns.items()})
    if index:  # pandas reads it as the index of the table
        types = {"pandas_type": "unicode", "numpy_type": "object", "metadata": None}
        column = {"name": index, "field_name": index, **types}
        described = {"index_columns": [index], "column_indexes": [], "columns": [column]}
        table = table.replace_schema_metadata({"pandas": json.dumps(described)})
    files.write_with(path, lambda part: parquet.write_table(table, part))
