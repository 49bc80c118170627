"""RL815: state is out of date."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.derived_fields import (
    DERIVED,
    FEWEST_TRIAL_LOOKS,
    POLLUTION,
    SAME_READING,
    RefreshAfterSteps,
    find_fields,
    find_stale_fields,
)
from rlctl.checking.experiment import judges_records
from rlctl.checking.experiments.attributes import find_log_without_engine
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.experiments.worlds import MujocoTrials, WatchedWorlds, judges_trials, judges_worlds
from rlctl.checking.instance import Instance
from rlctl.checking.late_readings import LateReadings
from rlctl.checking.mujoco_calls import MujocoCalls
from rlctl.checking.mujoco_trials import Look, name_columns, pair_rows, play
from rlctl.checking.old_entries import OldEntries
from rlctl.checking.old_ways import find_old_ways
from rlctl.checking.readings import FEWEST_LOOKS, MOST_ELEMENTS, NEARLY_ALL, name_features, read_features
from rlctl.checking.records import FIRST_SEED, Records
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names
from rlctl.checking.shared_frames import name_elements, name_part
from rlctl.checking.start_readings import StartReadings
from rlctl.checking.values import name_numbers
from rlctl.checking.world_logs import LoggedWorld, WorldLog
from rlctl.checking.worlds import Array
from rlctl.environments.bullet_calls import BulletCalls
from rlctl.environments.simulations import find_mujoco

RULE = Rule(
    "RL815",
    "state is out of date",
    Severity.INFO,
    meaning="""
        An observation or a reward is computed from a state before the last step of the physics, and so is late
        by that step, by more the faster the robot moves. PyBullet - getLinkState without
        computeForwardKinematics returns the position before that step (an info); or the state is read before
        the last stepSimulation. MuJoCo - mj_step leaves xpos, site_xpos, sensordata and all else that follows
        from positions as they were at the beginning of its last substep; and where reset writes qpos without
        mj_forward, they are of the episode before, or 0 after mj_resetData. A robot without an engine - the length
        of a vector follows where an attribute was before the step, and not where it is. With any engine or none -
        a line of the source reads a part of the state before the step moves the robot, and the observation has it
        afterwards, next to parts that are read later; or only reset computes a value that is seen from the robot, such
        as the way to the goal; or that way is taken from the oldest entry of a history.
    """,
    fix="""
        Read after the last step; call getLinkState(..., computeForwardKinematics=True), and
        mujoco.mj_forward(model, data) after mj_step and after qpos is written.
    """,
    shows_one=True,
)

TINY = 0.01  # of what a control step changes; less is an info
FORWARD = (
    "Call mujoco.mj_forward(model, data) after mj_step (mj_kinematics is enough for xpos and site_xpos) and before the "
    "observation and the reward are computed."
)
READ_MUJOCO = "Read after the last mj_step; then call mujoco.mj_forward(model, data) for what follows from positions."
READ_BULLET = "Read after the last stepSimulation; call getLinkState(..., computeForwardKinematics=True)."
READ_NEWEST = "Read the newest entry: of a deque with appended entries that is [-1]."
READ_LINES = "Read it after the last step of the physics, or after the robot's own equations."
READ_ATTRIBUTES = "Compute what is observed after the robot has moved."
FORWARD_AT_RESET = "Call mujoco.mj_forward(model, data) in reset, after qpos and qvel are written."
EXACT = 2e-6  # relative; the last bits of float32 and of sums
OLD = 1e-4  # An old value differs from the present one by more, in most looks [m], [rad], [m/s]
COMBINED, FAR_OFF = 1e-4, 0.02  # largest errors of a sum that is an element, and of one that is not, parts of its size
SUMMED = {
    "places seen from something": ("position of",),
    "velocities seen from something": ("velocity of", "angular velocity of", "speed of"),
}
SMALLEST = 1e-6  # singular value, part of the largest one
LOOKS_PER_NUMBER = 4  # that a sum needs
LATE_LINK = 0.001  # [m]


@judges_worlds(RULE)
def _judge_worlds(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    yield from _find_late_links(watched.calls)
    for world in watched.worlds:
        fix = READ_BULLET if find_mujoco(watched.instance.env) is None else READ_MUJOCO
        old = list(_find_old_elements(world, fix))
        yield from old
        if not old:
            yield from _find_elements_of_last_look(world, fix)


@judges_records(RULE, "worlds", "attributes", "action effects")
def _judge_attributes(records: Records) -> Iterator[RuleFinding]:
    """Yield the vectors that a robot without an engine observes from where it was a step before."""
    log = find_log_without_engine(records)
    if log is None:
        return
    if any(finding.rule == "RL115" for finding in records.findings):
        return  # all that is observed is late
    names, parts = name_elements(records.require_built())
    for elements, place in find_old_ways(log, parts):
        message = (
            f"{name_part(names[elements])} is a way from where {place} was before the step, and not from where it is"
        )
        evidence = {"element": names[elements.start], "value": place}
        yield RuleFinding(RULE, message, evidence, Severity.WARNING, fix=READ_ATTRIBUTES)
        return


@judges_expressions(RULE, decides=False)
def _judge_lines(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    """Yield the first value that the source reads before it moves the robot, and observes afterwards."""
    for one in noted.share(LateReadings).find():
        message = f"the observation has {one.read.text} (line {one.read.node.lineno}), for which {one.value.text} is"
        message += " read before the robot moves, and not again afterwards: it is one step older than the rest"
        evidence = {"element": one.read.text}
        same = ("RL115", "RL616", "RL617")  # all is late then
        yield RuleFinding(RULE, message, evidence, Severity.WARNING, fix=READ_LINES, where=one.value.where, same=same)
        return
    for start in StartReadings(noted).find():
        message = f"the observation has {start.read.text} (line {start.read.node.lineno}), and only a reset computes"
        message += f" {start.value.text} for it: after some steps the same expression is worth something else"
        place = noted.source.find_place(start.assignment.statement)
        evidence = {"element": start.read.text, "call": "reset"}
        yield RuleFinding(RULE, message, evidence, Severity.WARNING, fix=READ_LINES, where=place)
        return
    for old in OldEntries(noted).find():
        message = (
            f"{old.read.text} is the oldest entry of {old.key}, and {old.way.text} (line {old.way.node.lineno}) is a"
        )
        message += " way to a goal from there: not from where the robot is"
        evidence = {"element": old.read.text}
        yield RuleFinding(RULE, message, evidence, Severity.WARNING, fix=READ_NEWEST, where=old.read.where)
        return


@judges_trials(RULE, place=10)
def _judge_trials(trials: MujocoTrials) -> Iterator[RuleFinding]:
    yield from _find_stale(trials.instance, trials.calls, trials.plain)
    yield from _find_unforwarded(trials.instance, trials.calls, trials.plain)


def _find_stale(instance: Instance, calls: MujocoCalls, plain: Sequence[Look]) -> Iterator[RuleFinding]:
    pair = _pair_refreshed(instance, calls, plain)
    if pair is None:
        return
    old, new = (part[1:] for part in pair)  # a reset has no step
    off, moves = np.abs(new - old).max(axis=0), np.abs(np.diff(new, axis=0)).max(axis=0)
    columns = np.flatnonzero(off > SAME_READING * (1 + np.abs(new).max(axis=0))).tolist()
    if not columns:
        return
    fields = find_fields(instance, calls, columns)
    shown = sorted(columns, key=lambda c: c not in fields)
    texts = [f"{name_columns([c], plain[0])}{f' ({fields[c]})' if c in fields else ''}" for c in shown]
    verb, worst = "is" if len(columns) == 1 else "are", shown[0]
    value, step = float(off[worst]), int(np.abs(new - old)[:, worst].argmax())
    what = f"{list_names(texts, 4)} {verb} computed from what mj_step leaves one substep old"
    message = f"{what}: {texts[0]} is off by up to {value:.3g}, a step changes it by up to {moves[worst]:.3g}"
    evidence = {"element": name_columns([worst], plain[0]), "seed": FIRST_SEED, "step": step + 1}
    evidence |= {"value": float(old[step, worst]), "expected": float(new[step, worst])}
    severity = Severity.WARNING if (off[columns] > TINY * moves[columns]).any() else Severity.INFO
    yield RuleFinding(RULE, message, evidence, severity, fix=FORWARD)


def _pair_refreshed(instance: Instance, calls: MujocoCalls, plain: Sequence[Look]) -> tuple[Array, Array] | None:
    """Return what an episode observes, and what it would with all up to date after each step; None for too few rows."""
    refreshing = RefreshAfterSteps()
    hooks: dict[str, Any] = {"after_step": refreshing, "as_stepped": refreshing.as_stepped}
    pair = pair_rows(plain, play(instance, calls, **hooks))
    if pair is not None and len(pair[0]) >= FEWEST_TRIAL_LOOKS:
        return pair
    # A controller reads it too, and moves the robot otherwise: it gets what it had. A reward may compare both.
    hooks |= {"after_forward": refreshing.forget, "after_reset": refreshing.forget, "after_look": refreshing.restore}
    pair = pair_rows(plain, play(instance, calls, **hooks))
    if pair is None or len(pair[0]) < FEWEST_TRIAL_LOOKS:
        return None
    pair[1][:, -1] = pair[0][:, -1]
    return pair


def _find_unforwarded(instance: Instance, calls: MujocoCalls, plain: Sequence[Look]) -> Iterator[RuleFinding]:
    """Reset with other values in what is derived from positions, which a correct reset computes again."""
    simulation = find_mujoco(instance.env)
    if simulation is None:
        return
    _pollute(*simulation)
    columns = _find_changed(plain, play(instance, calls, 0, after_reset=_pollute))
    columns = columns or _find_forwarded_too_early(instance, calls, plain)
    if columns:
        size = plain[0].observation.size
        verb = "is" if len(columns) == 1 else "are"
        what = f"{name_columns(columns, plain[0])} of reset {verb} computed before mj_forward"
        message = f"{what}: from poses and sensors as they were before qpos was written"
        elements = [column for column in columns if column < size]
        if elements and not plain[0].observation[elements].any():
            message = (
                f"{name_columns(elements, plain[0])} of reset {verb} 0: nothing computes poses and sensors before the "
            )
            message += "first step"
        evidence = {"element": name_columns(columns[:1], plain[0]), "call": "reset", "seed": FIRST_SEED}
        yield RuleFinding(RULE, message, evidence, Severity.WARNING, fix=FORWARD_AT_RESET)


def _pollute(_: Any, data: Any) -> None:
    for name in DERIVED:
        getattr(data, name)[:] += POLLUTION


def _find_forwarded_too_early(instance: Instance, calls: MujocoCalls, plain: Sequence[Look]) -> list[int]:
    """Return the columns of a reset that follow from what is not up to date after its last mj_forward."""
    play(instance, calls, 0)
    stale = find_stale_fields(instance)
    if not stale:
        return []

    def pollute(_: Any, data: Any) -> None:
        for name, is_stale in stale.items():
            getattr(data, name)[is_stale] += POLLUTION

    return _find_changed(plain, play(instance, calls, 0, after_forward=pollute))


def _find_changed(plain: Sequence[Look], changed: Sequence[Look]) -> list[int]:
    """Return the columns of `pair_rows` in which what a reset returned is another one."""
    pair = pair_rows(plain, changed)
    return [] if pair is None else np.flatnonzero(pair[0][0] != pair[1][0]).tolist()


def _find_old_elements(world: LoggedWorld, fix: str) -> Iterator[RuleFinding]:
    """Yield the elements of the observation that equal the state before the last step of the physics, not the present
    one; an element may have its episode's constant added, such as a goal."""
    logs = [log for log in world.logs if sum(before is not None for before in log.before[1:]) >= FEWEST_LOOKS]
    if not logs or len({row.size for log in logs for row in log.observed}) != 1:
        return
    observed, now, before = ([_center(part) for part in parts] for parts in zip(*map(_read_log, logs), strict=True))
    names = name_features(logs[0])
    old: dict[int, str] = {}
    for column in range(min(MOST_ELEMENTS, observed[0].shape[1])):
        values = np.concatenate([part[:, column] for part in observed])
        if values.std() <= OLD:
            continue
        present, earlier = (_equals(values, np.concatenate(parts)) for parts in (now, before))
        if earlier.any() and not present.any():
            old[column] = names[int(earlier.argmax())]
    if old:
        yield _describe_old(logs[0], old, "before the last step of the physics, not of the present one", fix)


def _find_elements_of_last_look(world: LoggedWorld, fix: str) -> Iterator[RuleFinding]:
    """Yield the elements of the observation that equal the state at the observation before, whose present value is
    nowhere in the observation: else they are a history."""
    logs = [log for log in world.logs if len(log.observed) > FEWEST_LOOKS]
    if not logs or len({row.size for log in logs for row in log.observed}) != 1:
        return
    features = [
        np.stack([read_features(log, *look) for look in zip(log.states, log.poses, strict=True)]) for log in logs
    ]
    observed = np.concatenate([_center(np.nan_to_num(np.stack(log.observed[1:]).astype(np.float64))) for log in logs])
    now, before = (np.concatenate([_center(part[window]) for part in features]) for window in (np.s_[1:], np.s_[:-1]))
    columns = [c for c in range(min(MOST_ELEMENTS, observed.shape[1])) if observed[:, c].std() > OLD]
    if not columns:
        return
    present, earlier = (np.stack([_equals(observed[:, column], part) for column in columns]) for part in (now, before))
    only_earlier = earlier & ~present.any(axis=0) & ~present.any(axis=1, keepdims=True)  # shape (columns, features)
    names, found = name_features(logs[0]), zip(columns, only_earlier, strict=True)
    old = {column: names[int(row.argmax())] for column, row in found if row.any()}
    for what, kinds in SUMMED.items():
        of_kind = [place for place, name in enumerate(names) if name.startswith(kinds)]
        for column in _find_sums(observed[:, columns], now, before, of_kind):
            old.setdefault(columns[column], what)
    if old:
        yield _describe_old(logs[0], old, "before the whole step, not of the one after it", fix)


def _find_sums(observed: Array, now: Array, before: Array, features: Sequence[int]) -> list[int]:
    """Return the elements that are a sum of multiples of features at the observation before, such as a difference of
    two places in some axes, and no such sum of the present state; without those of which the present sum is observed
    too: they are a history. Shapes (looks, elements), and (looks, numbers) of both states."""
    size = observed.std(axis=0)
    fitted = [_fit(part, observed) for part in (before[:, features], now[:, features], now)]
    if any(one is None for one in fitted[:2]):
        return []
    weights, earlier = fitted[0] or (observed, size)
    present = np.min([one[1] for one in fitted[1:] if one is not None], axis=0)
    found = []
    for place in np.flatnonzero((earlier < COMBINED * size) & (present > FAR_OFF * size)).tolist():
        shown = np.abs(observed - (now[:, features] @ weights[:, place])[:, None]).max(axis=0)
        if shown.min() > FAR_OFF * size[place]:
            found.append(place)
    return found


def _fit(features: Array, observed: Array) -> tuple[Array, Array] | None:
    """Return the weights by which features add up to what is observed, from every other look, and the largest error in
    the rest of the looks; None for too few looks. Shapes (features, elements) and (elements,)."""
    half, rest = np.s_[::2], np.s_[1::2]
    moves = features.std(axis=0) > OLD
    weights = np.zeros((features.shape[1], observed.shape[1]))
    weights[moves], _, rank, _ = np.linalg.lstsq(features[half][:, moves], observed[half], rcond=SMALLEST)
    if len(features) < LOOKS_PER_NUMBER * max(1, int(rank)):
        return None
    return weights, np.asarray(np.abs(observed[rest] - features[rest] @ weights).max(axis=0))


def _describe_old(log: WorldLog, old: Mapping[int, str], when: str, fix: str) -> RuleFinding:
    names = [name_numbers(log.parts, column) for column in old]
    elements = [f"{name} ({what})" for name, what in zip(names, old.values(), strict=True)]
    verb = "is" if len(elements) == 1 else "are"
    message = f"{list_names(elements, 4)} {verb} of the state {when}"
    evidence = {"element": names[0], "elements": names[:8]}
    return RuleFinding(RULE, message, evidence, Severity.WARNING, fix=fix)


def _read_log(log: WorldLog) -> tuple[Array, Array, Array]:
    looks = [i for i, before in enumerate(log.before) if i and before is not None]
    observed = np.stack([log.observed[i] for i in looks]).astype(np.float64)
    now = [(log.states[i], log.poses[i]) for i in looks]
    before = [entry for entry in (log.before[i] for i in looks) if entry is not None]
    present, earlier = (np.stack([read_features(log, *entry) for entry in entries]) for entries in (now, before))
    return np.nan_to_num(observed), present, earlier


def _center(values: Array) -> Array:
    return values - values[0]


def _equals(values: Array, features: Array) -> NDArray[np.bool_]:
    """Say for each column of centered features whether centered values equal it, up to their sign. Shape (k,)."""
    scale = np.abs(values).max() + np.abs(features).max(axis=0)
    moves = features.std(axis=0) > OLD
    near = [np.abs(values[:, None] - sign * features) <= EXACT * (1 + scale) for sign in (1.0, -1.0)]
    result: NDArray[np.bool_] = moves & np.logical_or(*(part.mean(axis=0) >= NEARLY_ALL for part in near))
    return result


def _find_late_links(calls: BulletCalls) -> Iterator[RuleFinding]:
    call = max(calls.late_links, key=lambda call: calls.late_links[call], default=None)
    if call is not None and (distance := calls.late_links[call]) > LATE_LINK:
        message = f"getLinkState returns the position before the last physics step: up to {1e3 * distance:.3g} mm away"
        yield RuleFinding(
            RULE, message, {"value": distance, "expected": 0.0}, where=(call.file, call.line), fix=READ_BULLET
        )
