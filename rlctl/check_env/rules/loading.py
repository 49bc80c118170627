"""RL0: from the name on the command line to an environment."""

from __future__ import annotations

from collections.abc import Iterator

from rlctl.check_env.evidence import Evidence, Failure
from rlctl.check_env.finding import Seen, Severity, rule

ERROR = Severity.ERROR


def _failed(evidence: Evidence, stage: str) -> Iterator[Seen]:
    error = evidence.load_error
    if error is not None and error.stage == stage:
        fix = None
        if error.missing:
            settings = " ".join(f"--set task.{name}=..." for name in error.missing)
            fix = f"Give the constructor's arguments ({settings}), or give them default values."
        details = {"traceback": error.details} if error.details else {}
        yield Seen(error.message, details, fix=fix)


@rule("RL001", "import", ERROR, "Import the module in a Python prompt and repair what it raises.")
def imports(evidence: Evidence) -> Iterator[Seen]:
    """The module cannot be imported, so there is nothing to train on."""
    yield from _failed(evidence, "import")


@rule("RL002", "constructor", ERROR, "Repair the constructor; files it loads must be found from any folder.")
def constructs(evidence: Evidence) -> Iterator[Seen]:
    """The constructor raises, so there is nothing to train on. Often an argument without a default, or a model
    file that is looked for in the wrong folder."""
    yield from _failed(evidence, "constructor")


@rule(
    "RL003",
    "not an environment",
    ERROR,
    "Inherit from gymnasium.Env (not from the old `gym`) and define reset, step, observation_space and "
    "action_space from gymnasium.spaces.",
    complaints=(
        r"must inherit from the gymnasium",
        r"Gym is incompatible with Gymnasium",
        r"space does not inherit",
        r"space must inherit",
        r"must specify an? (action|observation) space",
    ),
)
def is_environment(evidence: Evidence) -> Iterator[Seen]:
    """What was built lacks what every library expects: the methods, the spaces, or Gymnasium's base class.
    Environments of the old `gym` package look alike and fail here."""
    yield from _failed(evidence, "kind")
    built = evidence.built
    if built is None:
        return
    if not built.is_env:
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
)
def survives_loading(evidence: Evidence) -> Iterator[Seen]:
    """Importing or building it crashes the interpreter, ends it, or never comes back."""
    if evidence.built is None:
        for failure in evidence.failures:
            if failure.part == "probe" and failure.call in ("load", "build"):
                yield Seen(_while_loading(failure), {"last_output": failure.details} if failure.details else {})


def _while_loading(failure: Failure) -> str:
    doing = "the import" if failure.call == "load" else "the constructor"
    return f"{doing} {failure.error}" if failure.kind == "hung" else f"the process {failure.error} in {doing}"
