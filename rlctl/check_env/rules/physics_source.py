"""RL8: calls of PyBullet that are wrong as they are written."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from rlctl.check_env.evidence import Evidence
from rlctl.check_env.finding import Severity
from rlctl.check_env.legacy import Seen, rule
from rlctl.check_env.rules.known import result
from rlctl.check_env.rules.physics import watched
from rlctl.check_env.world_results import Place, Worlds

SHOWN = 4


@rule(
    "RL808",
    "physicsClientId left out",
    Severity.ERROR,
    "Keep the id that connect returns and pass physicsClientId=self.client to every call, or make all calls through "
    "pybullet_utils.bullet_client.BulletClient, which adds it.",
    needs=("worlds",),
)
def client_left_out(evidence: Evidence) -> Iterator[Seen]:
    """PyBullet is called without physicsClientId and takes client 0, whoever made it. Alone that works; the second
    instance in a process then moves the first one's world, and closing one ends the other. A warning where the calls
    are in methods that did not run."""
    watched(evidence)  # without a world in use, calls in the source do not matter
    source = result(evidence, Worlds, "worlds").source
    if places := source.ran or source.not_run:
        count = f"{len(places)} calls" if len(places) > 1 else "a call"
        where = "" if source.ran else ", in methods that did not run"
        yield Seen(
            f"{count} of PyBullet without physicsClientId{where}: {_listed(places)}",
            {
                "file": places[0].file,
                "line": places[0].line,
                "places": [f"{Path(each.file).name}:{each.line}" for each in places],
                "functions": sorted({each.call for each in places}),
            },
            None if source.ran else Severity.WARNING,
        )


def _listed(places: Sequence[Place]) -> str:
    shown = [f"{Path(each.file).name}:{each.line} {each.call}" for each in places[:SHOWN]]
    more = f" and {len(places) - SHOWN} more" if len(places) > SHOWN else ""
    return ", ".join(shown) + more
