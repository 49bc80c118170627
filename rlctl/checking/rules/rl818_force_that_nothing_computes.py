"""RL818: force that nothing computes."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from rlctl.checking.experiments.worlds import MujocoTrials, judges_trials
from rlctl.checking.mujoco_trials import Look, name_columns, pair_rows, play
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.environments.simulations import find_mujoco

RULE = Rule(
    "RL818",
    "force that nothing computes",
    Severity.WARNING,
    meaning="""
        The observation or the reward reads an array of MuJoCo's data that mj_step does not fill: cfrc_ext,
        cfrc_int and cacc (unless a sensor needs them), qfrc_inverse, subtree_linvel. It stays zero.
    """,
    fix="""
        Call mujoco.mj_rnePostConstraint(model, data) after mj_step (mj_inverse for qfrc_inverse, mj_subtreeVel
        for the velocities of subtrees), or leave it out.
    """,
)

NEVER_COMPUTED = {
    "cfrc_ext": "mj_rnePostConstraint", "cfrc_int": "mj_rnePostConstraint", "cacc": "mj_rnePostConstraint",
    "qfrc_inverse": "mj_inverse", "subtree_linvel": "mj_subtreeVel", "subtree_angmom": "mj_subtreeVel",
}  # fmt: skip
"""Arrays that mj_step leaves at zero unless a sensor needs them, and what computes them."""
LARGE = 100.0  # [N], [N m], [m/s]: a contact is often a force above a limit
REPEATED = 2  # episodes that have to show it: what a reset leaves, such as a count of steps, may change one


@judges_trials(RULE, place=20)
def _find_never_computed(trials: MujocoTrials) -> Iterator[RuleFinding]:
    instance, calls, plain = trials.instance, trials.calls, trials.plain
    zero = set(NEVER_COMPUTED)

    def note(_: Any, data: Any) -> None:
        zero.difference_update([name for name in zero if getattr(data, name).any()])

    def after_forces(name: str) -> Callable[[Any, Any], None]:
        def fill(_: Any, data: Any) -> None:
            getattr(data, name)[:] = LARGE

        return fill

    play(instance, calls, after_step=note)
    for name in sorted(zero):
        changed = [_list_changed(plain, play(instance, calls, after_step=after_forces(name))) for _ in range(REPEATED)]
        if columns := sorted(set.intersection(*changed)):
            verb = "is" if len(columns) == 1 else "are"
            what = f"{name_columns(columns, plain[0])} {verb} computed from data.{name}"
            message = f"{what}, which stays zero: nothing calls {NEVER_COMPUTED[name]}"
            yield RuleFinding(RULE, message, {"element": f"data.{name}", "value": 0.0})
            simulation = find_mujoco(instance.env)
            if simulation is not None:
                getattr(simulation[1], name)[:] = 0


def _list_changed(plain: Sequence[Look], changed: Sequence[Look]) -> set[int]:
    pair = pair_rows(plain, changed)
    return set() if pair is None else set(np.flatnonzero((pair[0] != pair[1]).any(axis=0)).tolist())
