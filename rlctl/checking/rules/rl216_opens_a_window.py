"""RL216: opens a window."""

from collections.abc import Iterator

from rlctl.checking.experiment import RECORDING, judges_records
from rlctl.checking.experiments.build import FailedBuild, explains_failures, judges_built
from rlctl.checking.failures import select_failures
from rlctl.checking.instance import Instance, describe, display_error, lacks_display
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.environments.bullet_clients import ClientCalls, find_clients
from rlctl.errors import NoDisplayError

RULE = Rule(
    "RL216",
    "opens a window",
    Severity.ERROR,
    meaning="""
        The environment opens a window although no render mode was requested. On a server without a display this
        ends the process; elsewhere dozens of windows slow training down.
    """,
    fix="""
        Let render_mode be None by default, and open windows for "human" only. With PyBullet - p.connect(p.GUI
        if render_mode == "human" else p.DIRECT). Where the constructor takes render_mode, --set task.render_mode=null
        checks the rest before that.
    """,
    needs_instance=False,
)


@explains_failures(RULE, place=30)
def _explain_no_display(failed: FailedBuild) -> Iterator[RuleFinding]:
    if isinstance(failed.error, NoDisplayError):
        yield RuleFinding(RULE, failed.message)
    elif failed.cause is None or failed.context.progress.read().call == "load":  # RL001
        return
    elif lacks_display(describe(failed.cause)):
        yield RuleFinding(RULE, f"{failed.message}: it opens a window", failed.details, where=failed.where)


@judges_built(RULE)
def _find_window(instance: Instance) -> Iterator[RuleFinding]:
    clients = [ClientCalls(client) for client in find_clients()]
    if any(client.getConnectionInfo()["connectionMethod"] == client.GUI for client in clients):
        evidence = {"value": "GUI", "expected": "DIRECT"}
        yield RuleFinding(RULE, "PyBullet was connected with a window (p.GUI)", evidence)


@judges_records(RULE, *RECORDING)
def _find_lost_display(records: Records) -> Iterator[RuleFinding]:
    for failure in records.failures:
        if line := display_error(failure):
            yield RuleFinding(RULE, f"{failure.message}, because there is no display: {line!r}", failure.place)
            return
    for failure in select_failures(records, "raised"):
        if lacks_display(failure.error):
            yield RuleFinding(RULE, f"{failure.message}: it opens a window", failure.place, where=failure.where)
            return
    records.require_built()
