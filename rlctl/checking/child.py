"""What runs in a child process of check-env: its experiments, sent to the parent message by message."""

from __future__ import annotations

import dataclasses
import time
import traceback
from collections.abc import Collection, Iterator, Sequence
from multiprocessing.connection import Connection

from rlctl.checking import families
from rlctl.checking.clock import read_clock
from rlctl.checking.experiments import Experiment
from rlctl.checking.failures import EnvironmentRaised, describe_failure
from rlctl.checking.finding import NotApplicable, NotJudged, RuleFinding
from rlctl.checking.instance import Budget, Context
from rlctl.checking.messages import CallFailure, ChildMessage, End, Finished, Mistake, Skipped
from rlctl.checking.progress import CallProgress
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
    chosen = [each for each in families.PROCESSES[process].experiments if names is None or each.name in names]
    try:
        for message in _run_all(context, chosen, seconds):
            yield dataclasses.replace(message, process=process) if isinstance(message, CallFailure) else message
    except UsageError as error:
        yield Mistake(str(error))


def _run_all(context: Context, chosen: Sequence[Experiment], seconds: float) -> Iterator[ChildMessage]:
    """Run the experiments; each has its share of the time that those before it have left."""
    end = read_clock() + seconds
    shares = sum(each.share for each in chosen)
    for each in chosen:
        started = read_clock()
        if each.name == "build":
            yield from _run(each, context)
            if not context.is_built:
                return
            end += read_clock() - started  # importing and building comes on top
        elif context.is_built and not context.instance.can_act:
            yield Skipped(each.name, "its action space is not a Gymnasium space")
        elif started > end:
            yield Skipped(each.name, f"the experiments before it took the {seconds:g} s there are")
        else:
            context.budget = Budget(started + (end - started) * each.share / shares)
            yield from _run(each, context)
        shares -= each.share
    yield from context.close()


def _run(experiment: Experiment, context: Context) -> Iterator[ChildMessage]:
    started = time.monotonic()
    context.progress.phase(experiment.name)
    is_complete, crash = False, ""
    found: set[str] = set()
    try:
        for message in experiment.run(context):
            if isinstance(message, RuleFinding):
                found.add(message.rule)
            yield message
        is_complete = True
    except (NotJudged, NotApplicable) as reason:
        for name in (*experiment.rules, experiment.name):
            if name not in found:
                yield Skipped(name, str(reason), applies=isinstance(reason, NotJudged))
        is_complete = True
    except EnvironmentRaised as error:
        yield describe_failure(error, context.progress)
    except UsageError:
        raise
    except Exception:
        # The environment's own exceptions were caught where it was called, so this one is ours.
        crash = traceback.format_exc()
    yield Finished(experiment.name, time.monotonic() - started, is_complete, crash)
