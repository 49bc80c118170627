"""What runs in a child process of check-env: its experiments, sent to the parent message by message."""

import dataclasses
import time
import traceback
from collections.abc import Collection, Iterator, Sequence
from multiprocessing.connection import Connection

from rlctl.checking import families
from rlctl.checking.failures import EnvironmentRaised, describe_failure
from rlctl.checking.instance import Budget, Context
from rlctl.checking.progress import CallProgress, read_clock
from rlctl.checking.records import CallFailure, ChildMessage, End, Finished, Mistake, Skipped
from rlctl.checking.rules import Experiment, NotApplicable, NotJudged, RuleFinding
from rlctl.environments.spec import EnvSpec
from rlctl.errors import UsageError
from rlctl.processes.messages import send


def main(
    connection: Connection, process: str, spec: EnvSpec, experiments: list[str], seconds: float, memory: int
) -> None:
    """Run some experiments of one process and send what they yield. `memory`: the descriptor of the progress."""
    for message in run(process, spec, experiments, seconds, CallProgress(memory)):
        send(connection, message)
    send(connection, End())


def run(
    process: str,
    spec: EnvSpec,
    names: Collection[str] | None = None,
    seconds: float = families.PROCESS_S,
    progress: CallProgress | None = None,
) -> Iterator[ChildMessage]:
    """Yield the messages of one process; all its experiments by default, within so many seconds together."""
    context = Context(spec, progress)
    experiments = families.PROCESSES[process].experiments
    chosen = [experiment for experiment in experiments if names is None or experiment.name in names]
    try:
        for message in _run_all(context, chosen, seconds):
            yield dataclasses.replace(message, process=process) if isinstance(message, CallFailure) else message
    except UsageError as error:
        yield Mistake(str(error))


def _run_all(context: Context, chosen: Sequence[Experiment], seconds: float) -> Iterator[ChildMessage]:
    end = read_clock() + seconds
    shares = sum(experiment.share for experiment in chosen)
    for experiment in chosen:
        started = read_clock()
        if experiment.name == "build":
            yield from _run(experiment, context)
            if not context.is_built:
                return
            end += read_clock() - started  # importing and building comes on top
        elif context.is_built and not context.instance.can_act:
            yield Skipped(experiment.name, "its action space is not a Gymnasium space")
        elif started > end:
            yield Skipped(experiment.name, f"the experiments before it took the {seconds:g} s there are")
            yield Finished(experiment.name, 0.0, is_complete=False, is_cut=True)
        else:
            context.budget = Budget(started + (end - started) * experiment.share / shares)
            yield from _run(experiment, context)
        shares -= experiment.share
    yield from context.close()


def _run(experiment: Experiment, context: Context) -> Iterator[ChildMessage]:
    started = time.monotonic()
    context.progress.phase(experiment.name)
    is_complete, crash = True, ""
    with_finding: set[str] = set()
    try:
        for message in experiment.run(context):
            if isinstance(message, RuleFinding):
                with_finding.add(message.rule)
            yield message
    except (NotJudged, NotApplicable) as reason:
        for name in (*experiment.rules, experiment.name):
            if name not in with_finding:
                yield Skipped(name, str(reason), applies=isinstance(reason, NotJudged))
    except EnvironmentRaised as error:
        is_complete = False
        yield describe_failure(error, context.progress)
    except UsageError:
        raise
    except Exception:  # what the environment raises was caught at the call, so this is a bug of rlctl
        is_complete, crash = False, traceback.format_exc()
    yield Finished(experiment.name, time.monotonic() - started, is_complete, context.budget.was_cut, crash)
