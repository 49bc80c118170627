"""RL4: instances do not touch each other. Training steps dozens of them in one process."""

from __future__ import annotations

from collections.abc import Iterator

from rlctl.check_env.comparison import find_difference
from rlctl.check_env.context import Context
from rlctl.check_env.episode import Episode
from rlctl.check_env.experiment import check, experiment
from rlctl.check_env.families.determinism import COMPARED_STEPS, compare, require_independent
from rlctl.check_env.families.interface import select_failures
from rlctl.check_env.finding import Finding, NotJudged, Severity
from rlctl.check_env.instance import Instance
from rlctl.check_env.messages import FIRST_SEED, SECOND_SEED, Failure, Message, Skipped, Trajectory
from rlctl.check_env.recording import Recording
from rlctl.check_env.records import Records

IN_TURNS, AFTER_CLOSE = "two instances stepped in turns", "after another instance was closed"


@experiment("instances", share=10.0)
def compare_instances(context: Context) -> Iterator[Message]:
    """Play on three instances: one alone, one after it, and two side by side of which one is closed."""
    progress, budget = context.progress, context.budget
    longest_s = budget.seconds_left / 5

    def begin(instance: Instance, role: str, seed: int) -> Recording:
        progress.phase(role)
        deadline = budget.end_within(longest_s)
        episode = Episode(instance, seed, number=seed - FIRST_SEED, max_steps=COMPARED_STEPS, deadline=deadline)
        return Recording(role, episode, budget)

    progress.phase("alone")
    first = context.build()
    yield from begin(first, "fresh process", FIRST_SEED).run()
    yield from begin(first, "second alone", SECOND_SEED).run()
    yield from context.close(first)

    progress.phase("fresh instance")
    neighbour = context.build()
    yield from begin(neighbour, "fresh instance", FIRST_SEED).run()
    if budget.seconds_left < 0:
        for role in ("interleaved", "after close"):
            yield Skipped(role, "building and stepping the first two instances took all the time there is for them")
        yield from context.close(neighbour)
        return

    # From here on each instance has played the same episodes, in the same order, as `first` had.
    progress.phase("interleaved")
    survivor = context.build()
    pair = begin(survivor, "interleaved", FIRST_SEED), begin(neighbour, "interleaved", SECOND_SEED)
    for recording in pair:
        recording.reset()
    while any(recording.running for recording in pair):
        for recording in pair:
            if recording.running:
                recording.step()
    for recording in pair:
        yield from recording.messages()
    yield from _close_in_between(context, begin(survivor, "after close", SECOND_SEED), neighbour)
    yield from context.close(survivor)


def _close_in_between(context: Context, recording: Recording, neighbour: Instance) -> Iterator[Message]:
    """Play an episode, after whose first step another instance is closed."""
    recording.reset()
    if recording.running:
        recording.step()
    context.progress.phase("close")
    yield from context.close(neighbour)
    context.progress.phase("after close")
    while recording.running:
        recording.step()
    yield from recording.messages()


def _require_same_alone(records: Records) -> None:
    """Raise `NotJudged` unless instances, and episodes, that follow each other do the same."""
    if compare(records, "fresh process", "fresh instance")[1] is not None:
        raise NotJudged("two instances differ already when they are alone (RL301 to RL304)")
    require_independent(records)


def _failure(records: Records, rule: str, phase: str, doing: str) -> Finding | None:
    """Return the first failure of a phase that does not happen to an instance alone."""
    alone = {(failure.call, failure.error) for failure in select_failures(records, "raised")}
    for failure in records.failures:
        is_here = failure.process == "instances" and failure.phase == phase and failure.call != "build"
        if is_here and (failure.call, failure.error) not in alone:
            return Finding(rule, f"{doing}, {_describe(failure)}", failure.place)
    return None


def _describe(failure: Failure) -> str:
    if failure.kind == "raised":
        return f"{failure.in_call} raised {failure.error}"
    return f"{failure.in_call} {'ended' if failure.kind == 'died' else 'hangs'}: the process {failure.error}"


def _difference(records: Records, rule: str, beside: Trajectory, doing: str) -> Finding | None:
    alone = records.require_role("fresh process")
    if beside.seed != alone.seed:
        alone = records.require_role("second alone")
    if alone.ended == "raised":
        raise NotJudged("the episode raised when alone, too (RL207)")
    difference = find_difference(records.require_built(), alone, beside)
    if difference is None:
        return None
    severity = Severity.WARNING if difference.is_small else None
    return Finding(rule, f"{doing}, against one alone: {difference.text()}", difference.evidence(beside), severity)


@check("RL401", "comparisons", "instances")
def find_shared_world(records: Records) -> Iterator[Finding]:
    _require_same_alone(records)
    found = _failure(records, "RL401", "interleaved", IN_TURNS)
    if found is None:
        records.require_role("interleaved")
        differences = (_difference(records, "RL401", each, IN_TURNS) for each in records.role("interleaved"))
        found = next((each for each in differences if each is not None), None)
    if found is not None:
        yield found


@check("RL402", "comparisons", "instances")
def find_effect_of_closing(records: Records) -> Iterator[Finding]:
    _require_same_alone(records)
    found = _failure(records, "RL402", "after close", AFTER_CLOSE)
    if found is None:
        if list(find_shared_world.run(records)):
            raise NotJudged("the instances already disturb each other while both are open (RL401)")
        found = _difference(records, "RL402", records.require_role("after close"), AFTER_CLOSE)
    if found is not None:
        yield found


@check("RL403", "instances")
def find_single_instance(records: Records) -> Iterator[Finding]:
    for failure in records.failures:
        if failure.call in ("load", "build") and failure.process != "probe":
            where = "in one process" if failure.phase in ("fresh instance", "interleaved") else "in a second process"
            yield Finding("RL403", f"a second instance {where} cannot be built: {failure.error}", failure.place)
            return
