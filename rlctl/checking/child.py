"""What runs in a child process of a check: some experiments, one after another, within their time."""

import dataclasses
import functools
import random
import time
import traceback
from collections.abc import Collection, Iterator, Mapping, Sequence
from multiprocessing.connection import Connection

import numpy as np
from gymnasium import spaces

from rlctl.checking.experiment import Experiment, import_experiments
from rlctl.checking.instance import Budget, Context, EnvironmentRaised, describe_failure, raised_by_environment
from rlctl.checking.progress import CallProgress, read_clock
from rlctl.checking.records import CallFailure, ChildMessage, End, Finished, Mistake, Skipped
from rlctl.checking.rule import NotApplicable, NotJudged, RuleFinding
from rlctl.environments.spec import EnvSpec
from rlctl.errors import UsageError
from rlctl.processes.messages import send

TOO_DEEP = "an expression of its source is nested too deeply to be read"


def main(
    connection: Connection,
    process: str,
    spec: EnvSpec,
    experiments: list[str],
    modules: list[str],
    seconds: float,
    most_growth: float,
    memory: int,
    own: Mapping[str, Experiment] = {},
) -> None:
    """Run some experiments of one process, and send what they yield and that this was all.

    `modules` define them and the parts of rules in them: nothing else is imported, as most of a check of a fast
    environment is imports. `memory`: the descriptor of the progress. `own`: experiments that no module has, by name.
    """
    known = {**import_experiments(modules), **own}
    chosen = [known[name] for name in experiments]
    for message in run(process, spec, chosen, seconds, CallProgress(memory), most_growth):
        send(connection, message)
    send(connection, End())


def run(
    process: str,
    spec: EnvSpec,
    experiments: Sequence[Experiment],
    seconds: float,
    progress: CallProgress | None = None,
    most_growth: float = 1.0,
) -> Iterator[ChildMessage]:
    """Yield the messages of some experiments of one process, which may take so many seconds together.

    A slow environment may take up to `most_growth` times as long.
    """
    context = Context(spec, progress)
    context.seconds, context.most_growth = seconds, most_growth
    try:
        for message in _run_all(context, experiments, seconds):
            yield dataclasses.replace(message, process=process) if isinstance(message, CallFailure) else message
    except UsageError as error:
        yield Mistake(str(error))


def _run_all(context: Context, chosen: Sequence[Experiment], seconds: float) -> Iterator[ChildMessage]:
    began = read_clock()
    shares = sum(experiment.share for experiment in chosen)
    for experiment in chosen:
        started, growth = read_clock(), context.growth
        end = began + seconds * growth
        if experiment.name == "build":
            yield from _run(experiment, context)
            if not context.is_built:
                return
            began += read_clock() - started  # importing and building comes on top
        elif context.is_built and not isinstance(context.instance.env.action_space, spaces.Space):
            yield Skipped(experiment.name, "its action space is not a space of Gymnasium")
        elif started > end:
            spent = f"earlier experiments used all of the {seconds * growth:.3g} s of computing time"
            yield Skipped(experiment.name, spent)
            yield Finished(experiment.name, 0.0, is_complete=False, is_cut=True, needed_s=context.needed_s)
        else:
            own_end = started + (end - started) * experiment.share / shares
            further = functools.partial(_grow_further, context, growth)
            context.budget = Budget(own_end, last=end, began=started, growth=further)
            yield from _run(experiment, context)
        shares -= experiment.share
    if context.is_built:
        context.progress.phase("close")
        yield from context.instance.close()


def _grow_further(context: Context, known: float) -> float:
    """Return how much the time of an experiment has grown beyond what was known at its beginning."""
    return context.growth / known


def _skip(
    experiment: Experiment, with_finding: Collection[str], why: str, *, applies: bool = True
) -> Iterator[Skipped]:
    for name in (*experiment.rules, experiment.name):
        if name not in with_finding:
            yield Skipped(name, why, applies=applies)


def _run(experiment: Experiment, context: Context) -> Iterator[ChildMessage]:
    started = time.monotonic()
    context.progress.phase(experiment.name)
    context.seeds_globals = experiment.seeds_globals
    generators = random.getstate(), np.random.get_state()  # noqa: NPY002 (the environment's own draws)
    is_complete, crash = True, ""
    with_finding: set[str] = set()
    try:
        for message in experiment.run(context):
            if isinstance(message, RuleFinding):
                with_finding.add(message.rule)
            yield message
    except (NotJudged, NotApplicable, RecursionError) as reason:  # of the environment's calls it is `EnvironmentRaised`
        why = TOO_DEEP if isinstance(reason, RecursionError) else str(reason)
        yield from _skip(experiment, with_finding, why, applies=not isinstance(reason, NotApplicable))
    except EnvironmentRaised as error:
        if experiment.alters:
            yield from _skip(experiment, with_finding, f"{error.call} raised in a state that the check made: {error}")
        else:
            is_complete = False
            yield describe_failure(error, context.progress)
    except UsageError:
        raise
    except Exception as error:  # what calls of the environment raise was caught at the call
        is_complete = False
        if raised_by_environment(error):
            yield describe_failure(EnvironmentRaised("reading an attribute", error), context.progress)
        else:
            crash = traceback.format_exc()
    if experiment.seeds_globals:  # what follows is to find no seeded generators
        random.setstate(generators[0])
        np.random.set_state(generators[1])  # noqa: NPY002
    seconds, is_cut = time.monotonic() - started, context.budget.was_cut
    yield Finished(experiment.name, seconds, is_complete, is_cut, crash, needed_s=context.needed_s)
