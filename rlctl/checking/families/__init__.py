"""The families of rules. A family is a file (or two): its experiments and its rules side by side.

**An experiment** does something with an environment in a child process and yields what it finds:

    @experiment("rendering", "RL215", share=0.5)
    def render(context: Context) -> Iterator[ChildMessage]:
        with context.fresh("rgb_array") as instance:
            instance.reset(FIRST_SEED)
            if not isinstance(picture := instance.call("render", instance.env.render), np.ndarray):
                yield RuleFinding("RL215", "render returns no array", {"value": str(picture)})

It decides the rules that it names: they are judged when it comes to its end. `raise NotJudged(why)` or
`NotApplicable(why)` says so of all its rules without a finding, `yield Skipped("RL404", why)` of one of them. It calls
the environment through `Instance.call`, `Instance.reset` and `EpisodePlayer` only, so that what the environment raises
is an `EnvironmentRaised`, which need not be caught, and a hang or a crash can be placed. `context.budget` is what there
is of time and memory.

**A check** judges one rule in the parent process, from recorded episodes, which many rules share:

    @check("RL502", "episodes")
    def find_both_flags(records: Records) -> Iterator[RuleFinding]:
        for episode in records.episodes: ...

It names the experiments that it needs (by default those that record the common episodes, `RECORDING`) and raises
`NotJudged` or `NotApplicable`. A rule may have both, and then has the findings of both. A recording experiment yields
what `Recording.run()` returns.

**Texts** (name, severity, meaning, fix) are in `rules.yaml`, not here. A finding gives its own severity or fix only
where they differ from the rule's. Every check and experiment of a module in `MODULES` counts; the order of experiments
is that of `PROCESSES`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterable

from rlctl.checking.experiments import Check, Experiment
from rlctl.checking.families import (
    actions,
    determinism,
    episodes,
    features,
    incentives,
    interface,
    isolation,
    loading,
    observations,
    physics,
    rewards,
    search,
    seeding,
    speed,
    state,
    variants,
)
from rlctl.checking.finding import RULES

PROCESS_S = 18.0
"""How long the experiments of one process may take together [s]; importing and building comes on top."""


@dataclasses.dataclass(frozen=True)
class Process:
    """A child process and what runs in it, in this order: what may crash the environment comes last."""

    experiments: tuple[Experiment, ...]
    hash_seed: int = 0


PROCESSES = {
    "probe": Process(
        (
            loading.build,
            determinism.compare_repetitions,
            seeding.compare_generators,
            speed.measure_speed,
            episodes.record_episodes,
            incentives.record_starts,
            search.search,
            episodes.find_unseeded,
            rewards.recompute_rewards,
            isolation.count_after_resets,
        )
    ),
    "instances": Process(
        (
            isolation.compare_instances,
            seeding.compare_unseeded,
            physics.watch_worlds,
            actions.compare_actions,
            state.change_attributes,
            actions.give_nan,
            variants.play_variants,
            interface.render,
        ),
        hash_seed=1,  # another one, so that hash order shows
    ),
}
"""The child processes."""

MODULES = (
    *(loading, observations, features, interface, determinism, seeding, isolation, episodes),
    *(rewards, incentives, actions, physics, speed, state, variants),
)

CHECKS = {var.rule: var for module in MODULES for var in vars(module).values() if isinstance(var, Check)}
"""The check of a rule, for those that have one."""

EXPERIMENTS = {experiment.name: experiment for process in PROCESSES.values() for experiment in process.experiments}

DECIDED_BY = {rule: experiment for experiment in EXPERIMENTS.values() for rule in experiment.rules}
"""The experiment that decides a rule, for those that one does."""


def find_needs(rules: Iterable[str]) -> set[str]:
    """Return the names of the experiments that some rules need."""
    needed: set[str] = set()
    for rule in rules:
        if rule in CHECKS:
            needed.update(CHECKS[rule].needs)
        if rule in DECIDED_BY:
            needed.add(DECIDED_BY[rule].name)
    return needed


def find_rules(experiments: Collection[str]) -> list[str]:
    """Return the ids of the rules that some experiments can say something about."""
    return [
        rule
        for rule in RULES
        if (rule in CHECKS and set(CHECKS[rule].needs) & set(experiments))
        or (rule in DECIDED_BY and DECIDED_BY[rule].name in experiments)
    ]
