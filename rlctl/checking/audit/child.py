"""What a child process of the audit runs: rounds in which every competitor plays the episode of one seed."""

from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path

from rlctl.checking import child
from rlctl.checking.audit.competitors import Competitor, Kind, Plays, check_instance, list_competitors
from rlctl.checking.experiment import Experiment
from rlctl.checking.instance import MOST_FAILURES, Context, EnvironmentRaised, describe_failure
from rlctl.checking.records import ChildMessage, Fact, Skipped
from rlctl.checking.rule import NotJudged
from rlctl.environments.spec import EnvSpec
from rlctl.errors import RlctlError

PLAYED, AUDIT = "played", "audit"
PROCESSES = 2
ROUNDS = 2  # of each process


def main(
    connection: Connection,
    process: str,
    spec: EnvSpec,
    experiments: list[str],
    modules: list[str],
    seconds: float,
    most_growth: float,
    memory: int,
    shipped: str,
    learned: str,
) -> None:
    """Play in one process, whose name ends with its number, and send what each episode earned."""
    number = int(process.rpartition(" ")[2])
    files = [Path(file) if file else None for file in (shipped, learned)]
    competitors = list_competitors(*files)
    own = Experiment(
        name=AUDIT,
        process=process,
        place=1,
        share=1.0,
        run=lambda context: play_rounds(context, competitors, number),
        own_rules=(),
        hooks=(),
    )
    child.main(connection, process, spec, experiments, modules, seconds, most_growth, memory, {AUDIT: own})


def play_rounds(
    context: Context, competitors: list[Competitor], first: int, rounds: int = ROUNDS
) -> Iterator[ChildMessage]:
    """Let competitors play the rounds `first`, `first + PROCESSES`, ... until time is over."""
    if why := check_instance(context.instance):
        raise NotJudged(why)
    plays = Plays(context)
    failures = 0
    try:
        for index in range(rounds):
            number = first + index * PROCESSES
            for competitor in order(competitors, number):
                context.progress.phase(competitor.name)
                try:
                    yield from _play(plays, competitor, number)
                except EnvironmentRaised as error:
                    failures += 1
                    yield describe_failure(error, context.progress)
                    yield Skipped(competitor.name, f"raised {error}")
                    if failures >= MOST_FAILURES:
                        return
                except (RlctlError, NotJudged) as error:
                    yield Skipped(competitor.name, str(error))
    finally:
        plays.close()


def order(competitors: list[Competitor], number: int) -> list[Competitor]:
    """Return the order of a round: what others are compared with first; then every other round begins at the end.

    Where time is short, two processes so leave out none of them.
    """
    others = [one for one in competitors if one.kind in (Kind.idle, Kind.part)]
    first = [one for one in competitors if one not in others]
    return [*first, *(reversed(others) if number % 2 else others)]


def _play(plays: Plays, competitor: Competitor, number: int) -> Iterator[ChildMessage]:
    seed = plays.seeds[number]
    script = competitor.prepare(plays, seed, number)
    if script is None:
        return
    world = script.world or plays.world
    played = world.play(script, competitor.name, seed, number, plays.world.longest)
    if script.accepts(played):
        yield Fact(PLAYED, played)
