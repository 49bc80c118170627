"""`rlctl push`: uploads a run's best policy, recipe, scores and recording, with a model card of measured numbers."""

import dataclasses
import json
from pathlib import Path

from rlctl import output
from rlctl.errors import UsageError
from rlctl.hub import store
from rlctl.policy import own_modules
from rlctl.policy.file import PolicyFile, PolicyInfo
from rlctl.runs.directory import RunDirectory, refuse_links_out
from rlctl.runs.lookup import find_run

_CARD = "README.md"
_PRIVATE = ("folder", "command", "host", "pid")  # keys of run.json about the machine that trained it; not uploaded


@dataclasses.dataclass(frozen=True)
class PushResult:
    """What was uploaded, and where."""

    address: str
    files: tuple[str, ...]
    size: int  # [bytes]


def push_run(run: str | None, address: str) -> PushResult:
    """Upload a run to an address; raises `UsageError` for an invalid address, `ArtifactError` if the upload fails."""
    if not store.is_address(address):
        raise UsageError(f"{address}: not an address, such as hf://ORG/NAME or s3://BUCKET/NAME")
    directory = find_run(run)
    refuse_links_out(directory.path)  # in somebody else's run it may lead to any file
    policy = directory.policy_file("best")
    info = PolicyFile.read_info(policy)
    contents: dict[str, Path | bytes] = {"policies/best.safetensors": policy}
    recordings = sorted(directory.episodes.glob("*.rrd"))[-1:]
    others = (directory.recipe_file, directory.evals_file, directory.onnx_file, *recordings)
    contents |= {file.relative_to(directory.path).as_posix(): file for file in others if file.is_file()}
    status = {key: value for key, value in directory.status().items() if key not in _PRIVATE}
    if own := own_modules.list_names(directory.recipe()):
        output.print_notes([f"not uploaded, although the recipe names them: {', '.join(own)}"])
    contents["run.json"] = json.dumps(status, indent=2).encode()
    contents[_CARD] = describe(directory, info, sorted(contents)).encode()
    manifest = store.push(contents, address)
    return PushResult(address, tuple(manifest.files), sum(entry.size for entry in manifest.files.values()))


def describe(run: RunDirectory, info: PolicyInfo, names: list[str]) -> str:
    """Return the model card of a run's best policy in Markdown, with measured numbers only."""
    score = info.evaluation
    measured = ["not evaluated"] if score is None else [f"mean return {score.mean_return:.4g}"]
    if score is not None and score.success is not None:
        measured.append(f"success {score.success:.1%}")
    rows = {
        "task": info.spec.task,
        "algorithm": info.algo,
        "training steps": f"{info.training_steps:,}",
        "seed": str(run.recipe().seed),
        "evaluation during training": ", ".join(measured),
        "time between two actions": "unknown" if info.env.control_dt is None else f"{info.env.control_dt:g} s",
        "SHA-256 of the task's file": str(run.status().get("source_sha256") or "unknown"),
        "versions": ", ".join(f"{name} {version}" for name, version in sorted(info.versions.items())),
    }
    table = "\n".join(f"| {key} | {_escape(value)} |" for key, value in rows.items())
    files = "\n".join(f"- `{name}`" for name in names)
    return (
        "---\nlibrary_name: rlctl\ntags: [reinforcement-learning, robotics]\n---\n\n"
        f"# {_escape(info.spec.task)}, {info.algo}\n\n| | |\n|---|---|\n{table}\n\n"
        "Evaluate it with `rlctl eval ADDRESS`, the address of these files. They contain no pickled data.\n\n"
        f"{files}\n"
    )


def _escape(text: str) -> str:
    return " ".join(text.replace("|", "\\|").replace("<", "&lt;").split())


def show(result: PushResult, json_target: str | None) -> None:
    """Print what was uploaded."""
    if not output.present(result, json_target):
        output.out().print(f"pushed {len(result.files)} files, {result.size / 1e6:.2f} MB: rlctl eval {result.address}")
