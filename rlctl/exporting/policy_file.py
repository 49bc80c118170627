"""`rlctl export RUN --policy FILE`: the actor only, with its origin and its scores."""

import dataclasses
from typing import Any

from rich.filesize import decimal as format_bytes

from rlctl import output
from rlctl.environments.registry import identify_task
from rlctl.errors import ArtifactError, UsageError
from rlctl.evaluation.eval_request import EvalRequest
from rlctl.evaluation.evaluate import measure_score
from rlctl.evaluation.report import describe_score
from rlctl.exporting.export_request import ExportRequest
from rlctl.policy.file import PolicyFile
from rlctl.policy.named_actors import BASELINES
from rlctl.policy.shipped import Provenance
from rlctl.runs import lookup
from rlctl.runs.lookup import FoundPolicy
from rlctl.storage import validation
from rlctl.task.deployment import TASKS


def export_actor(request: ExportRequest) -> PolicyFile:
    """Measure a run's policy and write its actor to `request.policy`, with score, recipe, task version and commit.

    Zero and random actions are measured on the same episodes. A policy file written this way can be measured again,
    on the present version of its task. Raises `UsageError` for any other policy without a run.
    """
    assert request.policy is not None
    target, source = request.policy, lookup.find_policy(request.run, request.checkpoint)
    output.print_notes(source.notes)
    origin = _find_origin(source)
    policy = PolicyFile.read(source.file)
    spec = source.locate(policy.info.derive_spec())
    evaluation = EvalRequest(run=str(source.file), episodes=request.episodes)
    score = measure_score(evaluation)
    scores = {name: measure_score(dataclasses.replace(evaluation, baseline=name, spec=spec)) for name in BASELINES}
    content = {**origin, **identify_task(spec.task), "score": score, "baselines": scores}
    provenance = validation.build(Provenance, content, ArtifactError, f"{source.file}: provenance")
    policy = policy.actor_only().with_info(provenance=provenance)
    policy.write(target)
    return dataclasses.replace(policy, path=target)


def _find_origin(source: FoundPolicy) -> dict[str, Any]:
    """Return the fields of `Provenance` on the training of a policy."""
    if source.run is not None:
        return {
            "run": "/".join(source.run.path.resolve().parts[-2:]),
            "git_commit": source.run.status().get("git_commit"),
            "recipe": source.run.recipe().model_dump(mode="json", by_alias=True),
        }
    info = PolicyFile.read_info(source.file) if source.file.suffix == ".safetensors" else None
    if info is not None and info.spec.task in TASKS:
        raise UsageError(
            f"{source.file}: an imported policy: the file itself is what to pass on, with its robot; "
            f"its score: rlctl eval {source.file} --json FILE"
        )
    provenance = None if info is None else info.provenance
    if provenance is None:
        raise UsageError(f"{source.file}: the file does not contain the recipe of its training; give its run instead")
    return provenance.model_dump(include={"run", "git_commit", "recipe"})


def show(policy: PolicyFile, json: str | None) -> None:
    """Print what `export_actor` wrote, or only JSON for `-`."""
    out, path, info, provenance = output.out(), policy.path, policy.info, policy.info.provenance
    assert path is not None
    assert provenance is not None  # `export_actor` sets both
    size, score, task = path.stat().st_size, provenance.score, info.spec.task
    content = {"path": path, "bytes": size, "task": task, "algo": info.algo, "training_steps": info.training_steps}
    if output.present(content | provenance.model_dump(), json):
        return
    out.print(f"exported {path} ({format_bytes(size)}): the actor of {provenance.run}")
    out.print(f"{info.algo} for {task}, step {info.training_steps:,}")
    for name, measured in {"policy": score, **provenance.baselines}.items():
        out.print(f"{name:8} {describe_score(measured)}")
    out.print(f"{output.format_count(score.episodes, 'episode')}, seed {score.seed}; 95 % intervals")
