"""`rlctl runs import POLICY --deploy FILE --model ROBOT`: write a policy of another project as a policy file."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from rlctl import output
from rlctl.environments.info import describe_worlds
from rlctl.environments.spec import EnvSpec
from rlctl.errors import ArtifactError, RecipeError, TaskError, UsageError
from rlctl.importing.foreign import isaac_lab, metadata, own, rl_sar, unitree_gym, unitree_lab
from rlctl.importing.foreign.draft import Draft
from rlctl.importing.foreign.network import ForeignNetwork
from rlctl.importing.foreign.onnx_network import read_onnx, read_tables
from rlctl.importing.foreign.request import ForeignFiles
from rlctl.importing.foreign.torchscript import read_torchscript_network
from rlctl.importing.import_model import write_checked
from rlctl.policy.file import PolicyFile, PolicyInfo
from rlctl.recipe.sources import OF_THE_ENVIRONMENT, parse_settings
from rlctl.storage import yaml_text
from rlctl.storage.files import write_bytes
from rlctl.task.clip_options import ClipOptions
from rlctl.task.deployment import MOTION_TASK, TASK, USUAL_TOLERANCE, Deployment
from rlctl.task.model_files import find_model_file
from rlctl.task.motion import MotionClip, write_motion
from rlctl.task.motion_files import RobotJoints, read_clip
from rlctl.task.mujoco.robot import Robot, read_robot
from rlctl.version import collect_versions


class DeploymentReader(Protocol):
    """A module that reads the files of a project."""

    TITLE: str

    def matches(self, content: Mapping[str, Any]) -> bool:
        """Return whether a file has this form."""

    def read(self, content: Mapping[str, Any], source: str, robot: Robot, network: ForeignNetwork) -> Draft:
        """Return what the file says."""


READERS: Sequence[DeploymentReader] = (unitree_lab, isaac_lab, unitree_gym, rl_sar, own)
"""Modules that read files; each has `TITLE`, `matches` and `read`."""


@dataclasses.dataclass(frozen=True)
class ImportedPolicy:
    """A policy file that was written, and what was guessed for it."""

    policy: PolicyFile
    deployment: Deployment
    form: str  # what the deployment was read from
    notes: tuple[str, ...]


def import_policy(
    file: Path,
    files: ForeignFiles,
    *,
    settings: Mapping[str, Any] | None = None,
    output: Path | None = None,
) -> ImportedPolicy:
    """Read network, deployment and robot; write them as a policy file, after a test that it acts.

    Raises `UsageError` for what a file lacks and `settings` do not give, and for parts that do not fit each other;
    `ArtifactError` for a file that is missing or damaged, or a network that is not imported.
    """
    target = output or Path(f"{file.stem}.safetensors")
    if target.suffix != ".safetensors":
        raise UsageError(f"--output {output}: the name of a policy file ends in .safetensors")
    if output is None and target.exists():
        raise UsageError(f"{target} exists already; give another name: --output FILE")
    imported = _read(file, files, settings or {}, target)
    write_checked(target, str(file), imported.policy)
    return imported


def import_to_play(policy: str | None, files: ForeignFiles, settings: Sequence[str]) -> tuple[str, list[str]]:
    """Import a policy for a command that plays it; return the policy file and the settings of the environment.

    The file is in the current folder. It has the name of the policy, with a number where another policy has that name;
    a file of the same import is used again. All other settings are of the deployment. Raises as `import_policy` does.
    """
    if policy is None:
        raise UsageError("--model: give the policy of the other project, an ONNX (.onnx) or TorchScript (.pt) file")
    kinds = {text: text.partition("=")[0].partition(".")[0].strip() for text in settings}
    of_environment = [text for text in settings if kinds[text] in OF_THE_ENVIRONMENT]
    of_deployment = [text for text in settings if kinds[text] not in OF_THE_ENVIRONMENT]
    file = Path(policy)
    imported = _read(file, files, parse_settings(of_deployment), Path(f"{file.stem}.safetensors"))
    target = _choose_name(Path(str(imported.policy.path)), imported.policy.encode())
    if not target.exists():
        write_checked(target, str(file), imported.policy)
    notes = [f"  {note}" for note in imported.notes]
    searched = f"if it does not walk: rlctl diagnose --policy {target}"
    output.print_notes([f"policy file {target}, from {imported.form}; {searched}", *notes])
    return str(target), of_environment


def _choose_name(first: Path, content: bytes) -> Path:
    """Return where content is stored: a new file, with a number if need be, or one that has this content already."""
    path = first
    for number in itertools.count(2):
        if not path.exists() or path.read_bytes() == content:
            break
        path = first.with_stem(f"{first.stem}-{number}")
    return path


def _read(file: Path, files: ForeignFiles, settings: Mapping[str, Any], target: Path) -> ImportedPolicy:
    """Return a policy that is to be written to `target`."""
    if files.model is None:
        raise UsageError("--deploy needs the robot: --model ROBOT.urdf or ROBOT.xml")
    network, own_metadata = read_network(file)
    robot = read_robot(_find_model(files.model, "--model"))
    draft, form = read_draft(file, files.deploy, own_metadata, robot, network)
    chosen = files.motion or draft.motion
    if chosen is None:
        clip, found = _read_own_clip(file, own_metadata, draft, settings, robot)
    else:
        clip, found = _read_clip(chosen, files.motion_rate, robot)
    deployment = draft.complete(settings, robot, network, clip)
    ground = motion = ""
    if files.terrain:
        ground = str(_find_model(files.terrain, "--terrain").resolve())
    if clip is not None:
        motion = str(_write_clip(clip, target.absolute().parent))
    parameters: dict[str, Any] = {"robot_file": str(robot.path), "terrain": ground, "motion_file": motion}
    notes = [*draft.notes, *found]
    slow = deployment.fastest_command / 2
    if clip is None and 0 < slow < USUAL_TOLERANCE:
        parameters["tolerance"] = round(slow, 3)
        notes.append(f"task.tolerance: {slow:.3g} m/s, half of the fastest command, for success of a slow robot")
    policy = make_policy(network, deployment, parameters, target)
    return ImportedPolicy(policy, deployment, form, tuple(notes))


def _find_model(name: str, option: str) -> Path:
    try:
        return find_model_file(name)
    except TaskError as error:
        raise ArtifactError(f"{option}: {error}") from None


def _read_clip(file: Path, rate: float | None, robot: Robot) -> tuple[MotionClip, list[str]]:
    """Return the clip of a policy that follows one, and what was found in its file."""
    low, high = np.array([robot.ranges[name] for name in robot.joints]).T
    joints = RobotJoints(robot.path.name, robot.joints, robot.breadth_first, low, high, np.clip(0.0, low, high))
    return read_clip(str(file), joints, ClipOptions(rate=rate, rate_option="--motion-rate"))


def _read_own_clip(
    file: Path, own_metadata: Mapping[str, str], draft: Draft, settings: Mapping[str, Any], robot: Robot
) -> tuple[MotionClip | None, list[str]]:
    """Return the clip in the graph of an ONNX file, whose rows are one per action, if there is one."""
    control_dt = settings.get("control_dt", draft.values.get("control_dt"))
    if not metadata.matches(own_metadata) or not isinstance(control_dt, int | float) or not control_dt > 0:
        return None, []
    tables = read_tables(file)
    if not metadata.has_clip(tables):
        return None, []
    clip = metadata.read_clip(own_metadata, tables, str(file), robot, 1.0 / control_dt)
    return clip, [f"clip: {len(clip)} rows in {file.name}, one per action; {clip.duration:.2f} s"]


def _write_clip(clip: MotionClip, folder: Path) -> Path:
    """Write a clip next to the policy that follows it, unless the same one is there; return its file."""
    path = _choose_name(folder / f"{clip.name}.motion.csv", write_motion(clip))
    if not path.exists():
        write_bytes(path, write_motion(clip))
    return path


def read_network(file: Path) -> tuple[ForeignNetwork, dict[str, str]]:
    """Return the network of an ONNX or TorchScript file, and the metadata of ONNX."""
    if file.suffix == ".onnx":
        return read_onnx(file)
    if file.suffix in (".pt", ".pth", ".jit", ".ts"):
        return read_torchscript_network(file), {}
    raise UsageError(f"{file}: a policy from elsewhere is an ONNX (.onnx) or TorchScript (.pt) file")


def read_draft(
    file: Path, deploy: Path | None, own_metadata: Mapping[str, str], robot: Robot, network: ForeignNetwork
) -> tuple[Draft, str]:
    """Return what a file, or else the metadata of the policy itself, says of the deployment, and the file's form."""
    if deploy is None:
        if metadata.matches(own_metadata):
            return metadata.read(own_metadata, str(file), robot, network), metadata.TITLE
        return Draft(str(file), {}), "--set alone"
    content = yaml_text.load(yaml_text.read_text(deploy), str(deploy), foreign=True)
    if not isinstance(content, dict):
        raise RecipeError(f"{deploy}: expected a mapping of names to values")
    isaac_lab.refuse_leapp(content, str(deploy))
    for reader in READERS:
        if reader.matches(content):
            try:
                return reader.read(content, str(deploy), robot, network), reader.TITLE
            except (TypeError, ValueError, KeyError, AttributeError) as error:
                raise ArtifactError(f"{deploy}: not as {reader.TITLE} is: {type(error).__name__}: {error}") from None
    known = "; ".join(reader.TITLE for reader in READERS)
    raise UsageError(f"{deploy}: in none of the known forms: {known}. Describe it as docs/foreign-policies.md says")


def make_policy(
    network: ForeignNetwork, deployment: Deployment, parameters: Mapping[str, Any], path: Path
) -> PolicyFile:
    """Return the policy of a network for the task that its deployment and `parameters`, such as files, describe."""
    from rlctl.policy.torch_policy import build_network, describe_network, policy_name

    given = {name: value for name, value in parameters.items() if value}
    task = TASK
    if deployment.follows_motion:
        task = MOTION_TASK
    spec = EnvSpec(task, {"deployment": deployment.dump(), **given}).resolve()
    with contextlib.closing(spec.make_worlds(1)) as worlds:
        env = describe_worlds(worlds)
    info = PolicyInfo(
        algo=network.algo,
        policy=policy_name(network.algo, env.spaces()[0]),
        policy_kwargs=network.arguments,
        env=env,
        spec=spec,
        versions=collect_versions(),
    )
    info = info.model_copy(update={"policy_kwargs": describe_network(build_network(info))})
    return PolicyFile(info, network.observe_as(deployment).write_tensors(), path)


def show(imported: ImportedPolicy, json: str | None) -> None:
    """Print what was imported, what was guessed and the next commands, or only JSON for `-`."""
    policy, deployment = imported.policy, imported.deployment
    content = {
        "policy": policy.path,
        "form": imported.form,
        "deployment": deployment.dump(),
        "guessed": list(imported.notes),
        "versions": policy.info.versions,
    }
    if output.present(content, json):
        return
    out = output.out()
    out.print(f"{policy.path}: {policy.info.env.action_space['shape'][0]} joints, from {imported.form}")
    for note in imported.notes:
        out.print(f"  {note}", soft_wrap=True)
    out.print(f"next:\n  rlctl eval {policy.path}\n  rlctl diagnose --policy {policy.path}")
