"""Finds the run folder or the policy file that the argument RUN names, with notes about the choice."""

import contextlib
import dataclasses
import difflib
import os
import re
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from rlctl.environments import installed, registry, suggestions
from rlctl.environments.registry import describe_task_changes
from rlctl.environments.spec import EnvSpec
from rlctl.errors import PLAY_OTHERS, ArtifactError, UsageError, did_you_mean
from rlctl.hub import store
from rlctl.output import format_duration
from rlctl.policy.file import PolicyFile, PolicyInfo
from rlctl.policy.shipped import PRETRAINED, find_shipped_policy
from rlctl.runs.best import describe_unevaluated_last
from rlctl.runs.directory import GROUP_FILE, ROOT, TUNE_FILE, RunDirectory, is_group

_MOST_COMPARED = 50  # older runs whose scores are looked at
_IN_TASK = ("*/run.json", "*_seeds/*/run.json")
_BEGINS_WITH_DATE = re.compile(r"^\d{4}-\d\d")
_SAME_RUN = 0.7  # similarity of a path with a typo, and of another run's of the same day
_RUN_NAME = re.compile(r"^\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d_s\d+(_\d+)?$")


@dataclasses.dataclass(frozen=True)
class FoundPolicy:
    """A policy file, and the run that it belongs to, if any."""

    file: Path
    run: RunDirectory | None
    notes: tuple[str, ...] = ()  # for a user who did not name the run: which it is, and which were skipped or better

    def locate(self, spec: EnvSpec) -> EnvSpec:
        """Return `spec` with the absolute path of its task's file; see `locate_task`."""
        return dataclasses.replace(spec, task=locate_task(spec.task, self.run))


def find_run(text: str | None, root: Path = ROOT, *, to_train: bool = False) -> RunDirectory:
    """Return the run that the argument RUN names: a folder, a task's name (its newest run), `latest` or None.

    If there is none, the error says how to use the policy that the task ships, or with `to_train` how to train it.
    """
    if text is not None and store.is_address(text):
        text = str(store.fetch(text))
    if text is None or text == "latest":
        # The link first: names contain the time, and the clock may have been set back.
        newest = _read_latest(root) or next(iter(_list_newest_first(root, "*/*/run.json", "*/*/*_s*/run.json")), None)
        if newest is None:
            tunings = sorted(root.glob(f"*/*/{TUNE_FILE}"))
            trials = f", only trials of rlctl tune; name one of them, from {tunings[-1].parent}" if tunings else ""
            hint = trials or "; train one: rlctl train reach"
            raise ArtifactError(f"no run yet under {root.resolve()}{hint}")
        return newest
    if (Path(text) / "run.json").is_file():
        # `latest` may soon lead to another run.
        return RunDirectory(Path(text).parent / os.readlink(text) if Path(text).is_symlink() else Path(text))
    if Path(text).name == "latest" and Path(text).is_symlink():  # to a run that was removed
        return find_run("latest", Path(text).parent)
    refuse_tuning(Path(text))
    if is_group(Path(text)):
        raise UsageError(f"{text}: a group of runs; name one of them: {text.rstrip('/')}/..._s0")
    if runs := _list_newest_first(root / registry.make_slug(text), *_IN_TASK):
        return runs[0]
    if text and Path(text).is_dir():
        patterns = (f"*/{GROUP_FILE}", f"*/*/{GROUP_FILE}", "*/run.json", "*/*/run.json")  # deeper takes long in a home
        inside = next((file.parent for pattern in patterns for file in Path(text).glob(pattern)), None)
        hint = f"; in it is {inside}" if inside else ""
        raise ArtifactError(f"{text}: not a run of rlctl: it has no run.json{hint}")
    if model := suggestions.explain_model_file(text):
        raise UsageError(model)
    if is_policy_file(text) and Path(text).is_file():
        raise UsageError(f"{text}: a policy file, and a run is needed{_hint_at_run(Path(text))}. rlctl eval {text}")
    if Path(text).is_file() and Path(text).suffix != ".zip":
        hint = f"; its run: {Path(text).parent}" if (Path(text).parent / "run.json").is_file() else ""
        raise ArtifactError(f"{text}: neither a run nor a policy (.safetensors, .onnx){hint}. {PLAY_OTHERS}")
    if Path(text).suffix == ".zip":
        raise ArtifactError(
            f"{text}: a .zip, the model format of Stable-Baselines3, not a run; convert it: "
            f"rlctl runs import {text} --task TASK"
        )
    if tunings := sorted((root / registry.make_slug(text)).glob(f"*/{TUNE_FILE}")):
        raise ArtifactError(
            f"no run of {text!r}, only trials of rlctl tune; name one of them, from {tunings[-1].parent}"
        )
    if entry := installed.find(text):
        option = f"rlctl train {text} --from {text}" if to_train else "--pretrained"
        shipped = f"; to use the policy that it ships: {option}" if entry.policy_file else ""
        raise ArtifactError(f"no run of {text!r} yet under {root.resolve()}; train one: rlctl train {text}{shipped}")
    hint = _suggest_run(text, root) or " All runs: rlctl runs"
    if ":" in text:  # a task that is named by its file or module
        hint = f" To see it before a training: rlctl replay {text} --policy zero"
    raise ArtifactError(f"no run {text!r}: neither a folder nor a task with a run.{hint}")


def is_policy_file(text: str) -> bool:
    """Return whether a text names a policy file, which need not exist."""
    return Path(text).suffix in (".safetensors", ".onnx")


def _hint_at_run(policy: Path) -> str:
    for folder in policy.resolve().parents[:2]:  # `best.safetensors` is in a folder of its run
        if (folder / "run.json").is_file():
            return f"; its run: {folder}"
    return "; it has none here"


def _suggest_run(text: str, root: Path) -> str:
    """Return a hint at the run or group that a text with a typo means; else at a task; empty if none is similar.

    A path, or a name that begins with a date, means a run: a task would be another thing.
    """
    is_path = os.sep in text
    if is_path or _BEGINS_WITH_DATE.match(text):
        files = [*root.glob("*/*/run.json"), *root.glob(f"*/*/{GROUP_FILE}"), *root.glob("*/*_seeds/*/run.json")]
        # `runs/TASK/NAME`, or TASK/NAME, as `rlctl runs` lists it, or the name alone
        word = os.path.normpath(text)
        if word.startswith(f"{root}{os.sep}"):
            word = os.path.relpath(word, root)
        known = {}
        for file in sorted(files):
            inside = file.parent.relative_to(root)
            known[str(inside) if os.sep in word else inside.name] = file.parent
        close = difflib.get_close_matches(word, known, n=1, cutoff=_SAME_RUN)
        return did_you_mean(text, [str(known[close[0]])], str(known[close[0]])) if close else ""
    names = {folder.name for folder in root.glob("*/")} | {folder.name for folder in installed.list_installed()}
    return did_you_mean(text, sorted(names))


def refuse_tuning(path: Path) -> None:
    """Raise `UsageError` for the folder of a tuning, where a run or a group is expected."""
    if (path / TUNE_FILE).is_file():
        raise UsageError(
            f"{path}: the trials of rlctl tune, not seeds of one recipe; name one of its runs "
            f"(to resume it or to see its table: rlctl tune --resume {path})"
        )


def find_policy(text: str | None, which: str = "best", root: Path = ROOT) -> FoundPolicy:
    """Return the policy that the argument RUN names, which may be a policy file.

    A task's name means its newest run that has such a policy; if `which` is `pretrained`, the policy that it ships.
    A note warns if the task's source has changed since the training or the export, if its engine is missing, and of a
    run's best policy if a much newer one was never evaluated.
    """
    if text is not None and which != PRETRAINED and store.is_address(text):
        text = str(store.fetch(text))
    policy = _find_policy(text, which, root)
    return dataclasses.replace(policy, notes=(*policy.notes, *_list_warnings(policy)))


def _list_warnings(policy: FoundPolicy) -> Iterator[str]:
    info: PolicyInfo | None = None
    with contextlib.suppress(ArtifactError):  # whoever reads the whole file raises it too
        info = PolicyFile.read_info(policy.file) if policy.file.suffix == ".safetensors" else None
    change = None
    if policy.run is not None:
        change = describe_source_change(policy.run)
    elif info is not None and info.provenance is not None:
        digest = info.provenance.source_sha256
        change = _describe_source_change(info.spec.task, digest, "this policy was exported")
    if change:
        yield f"warning: {change}; its score may have changed"
    if policy.run is not None and policy.file == policy.run.best_policy:
        unevaluated = describe_unevaluated_last(policy.run)
        if unevaluated:
            yield unevaluated
    if info is not None and info.spec.lacks_pybullet:
        yield "warning: trained in PyBullet, which is not installed, so MuJoCo simulates; scores may differ"


def describe_source_change(run: RunDirectory) -> str | None:
    """Return how the source of a run's task has changed since the run began; None if it has not, or is not known."""
    try:
        status = run.status()
        task, digest = _locate_source(str(status["task"]), run), status.get("source_sha256")
    except ArtifactError:
        return None
    return _describe_source_change(task, digest, "the run began")


def _describe_source_change(task: str, digest: object, since: str) -> str | None:
    # The version of the distribution alone changes nothing.
    before = {"origin": registry.find_origin(task), "source_sha256": digest}
    changes = describe_task_changes(before, task, since) if digest is not None else []
    return changes[0] if changes else None


def _find_policy(text: str | None, which: str, root: Path) -> FoundPolicy:
    if which == PRETRAINED:
        return _find_shipped(text)
    if text is not None and is_policy_file(text):
        path = Path(text)
        if not path.exists():
            raise ArtifactError(f"{path}: no such file")
        return FoundPolicy(path, find_owner(path))
    run = find_run(text, root)
    if text is not None and (Path(text) / "run.json").is_file():
        return FoundPolicy(run.policy_file(which), run)
    in_group = is_group(run.path.parent)
    runs = _list_newest_first(run.path.parent.parent if in_group else run.path.parent, *_IN_TASK)
    candidates, older = runs, runs[1:]
    if text in (None, "latest"):
        candidates, older = [run], [other for other in runs if other.path.name < run.path.name]
    for number, candidate in enumerate(candidates):
        with contextlib.suppress(ArtifactError):
            file = candidate.policy_file(which)
            return FoundPolicy(file, candidate, _describe_choice(file, candidate, candidates[:number], older[number:]))
    run.policy_file(which)  # raises, and says why there is none
    raise AssertionError


def _find_shipped(task: str | None) -> FoundPolicy:
    file = find_shipped_policy(task)
    note = f"shipped policy {file}: step {PolicyFile.read_info(file).training_steps:,}"
    return FoundPolicy(file, None, (note,))


def find_owner(file: Path) -> RunDirectory | None:
    """Return the run that a policy, a checkpoint's policy or a recorded episode belongs to; None for a file alone."""
    folders = file.absolute().parents[1:3]
    return next((RunDirectory(folder) for folder in folders if (folder / "run.json").is_file()), None)


def locate_task(task: str, run: RunDirectory | None) -> str:
    """Return a task with the absolute path of its file, if the training named it by a relative path.

    A run that has been moved uses the same relative path from the current folder. A module that is found nowhere else
    is imported from the folder of the training, which becomes the last entry of `sys.path`: call this only for a task
    that is imported next. A downloaded run names no folder of this machine.
    """
    place = task.rpartition(":")[0]
    if place.endswith(".py"):
        return _locate_source(task, run)
    folder = _find_training_folder(task, run)
    if folder is not None and folder.is_dir() and registry.find_source_file(task) is None:
        registry.append_to_path(str(folder))  # the workers get the same path
    return task


def _locate_source(task: str, run: RunDirectory | None) -> str:
    """Return a task with the absolute path of its file, also if the training named it by a module; imports nothing."""
    folder = _find_training_folder(task, run)
    if folder is None or run is None:
        return task
    place, _, name = task.rpartition(":")
    if not place.endswith(".py"):
        file = None
        if registry.find_source_file(task) is None:
            file = _find_module_below(folder, place)
        return task if file is None else f"{file}:{name}"
    if not (original := folder / place).is_file():
        return task
    here = Path(place)
    moved = not run.path.resolve().is_relative_to(folder)
    return task if here.is_file() and (moved or here.samefile(original)) else f"{original}:{name}"


def _find_training_folder(task: str, run: RunDirectory | None) -> Path | None:
    """Return the folder in which a training was started, to which the name of its task may be relative."""
    place = task.rpartition(":")[0]
    if run is None or not place or Path(place).expanduser().is_absolute() or store.is_cached(run.path):
        return None
    folder = run.status().get("folder")
    return Path(folder) if isinstance(folder, str) else None


def _find_module_below(folder: Path, module: str) -> Path | None:
    *parents, last = module.split(".")
    for file in (folder.joinpath(*parents, last, "__init__.py"), folder.joinpath(*parents, f"{last}.py")):
        if file.is_file():
            return file
    return None


def _describe_choice(
    file: Path, run: RunDirectory, skipped: Sequence[RunDirectory], older: Sequence[RunDirectory]
) -> tuple[str, ...]:
    try:
        info = PolicyFile.read_info(file)
    except ArtifactError:  # loading it reports the same
        return ()
    age = format_duration(max(time.time() - file.stat().st_mtime, 0.0))
    notes = [f"run {run.path}: policy of step {info.training_steps:,}, saved {age} ago"]
    if is_group(run.path.parent):
        notes.append(f"it belongs to the group {run.path.parent}")
    if skipped:
        notes.append(f"skipped {', '.join(str(run.path) for run in skipped)}: no such policy yet")
    if better := _find_better(info, older):
        notes.append(better)
    return tuple(notes)


def _find_better(info: PolicyInfo, older: Sequence[RunDirectory]) -> str | None:
    """Describe the best older run of the same parameters and rewards, if it was better in its evaluations."""
    better: list[tuple[float, str]] = []
    for run in older[:_MOST_COMPARED]:
        with contextlib.suppress(ArtifactError):
            other = PolicyFile.read_info(run.policy_file("best"))
            same = all(getattr(other.spec, key) == getattr(info.spec, key) for key in ("parameters", "reward_weights"))
            if not same or info.evaluation is None or other.evaluation is None:
                continue
            ours, theirs, form = info.evaluation.success, other.evaluation.success, "success {:.1%} against {:.1%}"
            if ours is None or theirs is None:
                ours, theirs = info.evaluation.mean_return, other.evaluation.mean_return
                form = "return {:.4g} against {:.4g}"
            if theirs > ours:
                better.append((theirs, f"{run.path} ({form.format(theirs, ours)})"))
    return f"an older run had a better evaluation: {max(better)[1]}" if better else None


def _read_latest(root: Path) -> RunDirectory | None:
    with contextlib.suppress(OSError, ValueError):  # no link, or one to another place
        run = root / os.readlink(root / "latest")
        if (root / "latest").resolve().is_relative_to(root.resolve()) and (run / "run.json").is_file():
            return RunDirectory(run)
    return None


def _list_newest_first(root: Path, *patterns: str) -> list[RunDirectory]:
    """Return the runs below `root` without the trials of a tuning."""
    folders = (file.parent for pattern in patterns for file in root.glob(pattern))
    runs = [run for run in folders if _RUN_NAME.match(run.name) and not (run.parent / TUNE_FILE).is_file()]
    runs.sort(key=lambda run: (run.name[:19], (run / "run.json").stat().st_mtime_ns), reverse=True)
    return [RunDirectory(run) for run in runs]
