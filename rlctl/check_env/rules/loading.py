"""RL0: from the name on the command line to an environment."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from rlctl.check_env.evidence import RAISED, Evidence, Failure
from rlctl.check_env.finding import Seen, Severity, rule
from rlctl.check_env.rules.known import built, lost_display

ERROR, WARNING = Severity.ERROR, Severity.WARNING


def _failed(evidence: Evidence, kind: str, fix: str | None = None) -> Iterator[Seen]:
    error = evidence.load_error
    if error is not None and error.kind == kind:
        yield Seen(error.message, {"traceback": error.details} if error.details else {}, fix=fix)


@rule("RL001", "import", ERROR, "Import the module in a Python prompt and repair what it raises.", needs=())
def imports(evidence: Evidence) -> Iterator[Seen]:
    """The module cannot be imported, so there is nothing to train on."""
    yield from _failed(evidence, "import")


@rule(
    "RL002",
    "constructor",
    ERROR,
    "Build it in a Python prompt, without arguments, and repair what it raises.",
    needs=(),
)
def constructs(evidence: Evidence) -> Iterator[Seen]:
    """The constructor raises, so there is nothing to train on."""
    yield from _failed(evidence, "constructor")


@rule(
    "RL003",
    "not an environment",
    ERROR,
    "Inherit from gymnasium.Env and define reset, step, observation_space and action_space from gymnasium.spaces.",
    complaints=(
        r"must inherit from the gymnasium",
        r"Gym is incompatible with Gymnasium",
        r"space does not inherit",
        r"space must inherit",
        r"must specify an? (action|observation) space",
    ),
    needs=(),
)
def is_environment(evidence: Evidence) -> Iterator[Seen]:
    """What was built lacks what every library expects: the methods, the spaces, or Gymnasium's base class."""
    yield from _failed(evidence, "no environment")
    built = evidence.built
    if built is None:
        return
    if not built.is_env and not built.is_old_gym:
        yield Seen("the class does not inherit from gymnasium.Env")
    for name, leaves in (("observation", built.leaves), ("action", built.action_leaves)):
        if "NoneType" in {leaf.kind for leaf in leaves}:
            yield Seen(f"there is no {name}_space")


@rule(
    "RL004",
    "loading ends the process",
    ERROR,
    "Build it in a Python prompt with `python -X faulthandler`; nothing at import or in the constructor may wait "
    "for input, open a window, or exit.",
    needs=(),
)
def survives_loading(evidence: Evidence) -> Iterator[Seen]:
    """Importing or building it crashes the interpreter, ends it, or never comes back."""
    if evidence.built is None:
        for failure in evidence.failures:
            if failure.part == "probe" and failure.call in ("load", "build") and not lost_display(failure):
                yield Seen(_while_loading(failure), {"last_output": failure.details} if failure.details else {})


def _while_loading(failure: Failure) -> str:
    doing = "the import" if failure.call == "load" else "the constructor"
    return f"{doing} {failure.error}" if failure.kind == "hung" else f"the process {failure.error} in {doing}"


@rule("RL005", "missing class", ERROR, "Correct the name after the colon; it is case-sensitive.", needs=())
def has_class(evidence: Evidence) -> Iterator[Seen]:
    """The module was imported, and does not define what was asked for."""
    yield from _failed(evidence, "class")


@rule("RL006", "constructor needs arguments", ERROR, "Give the constructor's arguments default values.", needs=())
def needs_no_arguments(evidence: Evidence) -> Iterator[Seen]:
    """The constructor has arguments without a default. Every tool builds environments without arguments, unless it is
    told what to give."""
    missing = evidence.load_error.missing if evidence.load_error else []
    settings = " ".join(f"--set task.{name}=..." for name in missing)
    yield from _failed(evidence, "arguments", f"Give them ({settings}), or give them default values.")


@rule(
    "RL007",
    "file not found",
    ERROR,
    "Build the path from the module's own folder, Path(__file__).parent; for PyBullet's own models, call "
    "setAdditionalSearchPath(pybullet_data.getDataPath()) on the same client.",
    complaints=(f"^{RAISED}.*(Cannot load|No such file)",),
)
def files_found(evidence: Evidence) -> Iterator[Seen]:
    """A model, URDF or other file that the environment loads does not exist where it is looked for. Relative paths
    depend on the folder that the tool is started in, and workers and CI start elsewhere."""
    error = evidence.load_error
    if error is not None and error.kind == "file" and error.file is not None:
        yield _not_found("the constructor", error.file, error.details)
    seen = set()
    for failure in evidence.failures if evidence.built is not None else ():
        if failure.file is not None and failure.file["file"] not in seen:
            seen.add(failure.file["file"])
            yield _not_found(failure.call, failure.file, failure.details)


def _not_found(call: str, file: Mapping[str, Any], details: str | None) -> Seen:
    where = f", looked for in {' and '.join(file['searched'])}" if file["searched"] else ""
    similar = f"; there is {file['similar']}" if file["similar"] else ""
    evidence = {**file, "traceback": details} if details else dict(file)
    return Seen(f"{call} does not find {file['file']!r}{where}{similar}", evidence)


@rule(
    "RL008",
    "old gym",
    ERROR,
    "Replace `import gym` by `import gymnasium as gym`, register with gymnasium.register, return (observation, info) "
    "from reset and five values from step.",
    needs=(),
)
def gymnasium_not_gym(evidence: Evidence) -> Iterator[Seen]:
    """It is written for the old `gym` package, which is no longer maintained: Gymnasium does not find its
    registrations, and today's learners do not accept its environments."""
    yield from _failed(evidence, "old gym")
    if evidence.built is not None and evidence.built.is_old_gym:
        yield Seen("the class inherits from gym.Env, not from gymnasium.Env")


OLD_KEYS = {
    "render.modes": "render_modes",
    "video.frames_per_second": "render_fps",
    "video.frames_per_sec": "render_fps",
}


@rule("RL009", "old metadata keys", WARNING, 'metadata = {"render_modes": ["rgb_array"], "render_fps": 30}', needs=())
def metadata_keys(evidence: Evidence) -> Iterator[Seen]:
    """metadata has the old `gym`'s keys, which Gymnasium and its wrappers do not read."""
    for key in built(evidence).metadata:
        if key in OLD_KEYS:
            yield Seen(
                f"metadata has {key!r}, which is now {OLD_KEYS[key]!r}", {"value": key, "expected": OLD_KEYS[key]}
            )


@rule("RL010", "no render_fps", WARNING, 'Add "render_fps" to metadata: 1 / the time of a control step.', needs=())
def frame_rate(evidence: Evidence) -> Iterator[Seen]:
    """metadata promises render modes and has no render_fps, so that videos and `human` windows run at any speed."""
    metadata = built(evidence).metadata
    if metadata.get("render_modes") and not any("fps" in key or "frames_per_sec" in key for key in metadata):
        yield Seen(
            f"metadata has render_modes {metadata['render_modes']} and no render_fps", {"expected": "render_fps"}
        )
