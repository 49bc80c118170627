"""Policies of other projects: scores, and what `rlctl diagnose` says of them, sound and with an injected mistake.

`python -m tests.benchmarks.foreign POLICIES.yaml [CASE ...]`: the file names public policies that somebody fetched,
none of which is bundled: of each `policy`, `deploy`, `model` and, where the import needs them, `terrain`, `motion`,
`motion_rate` and `set`. A case is `scores`, `sound`, `mistakes`, or one of them with a name: `sound:go2`,
`mistakes:b2-alphabetical`. A line per case; ends with 1 if fewer mistakes are named than expected, or a policy that
walks is called broken.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rlctl.evaluation.eval_request import EvalRequest
from rlctl.evaluation.evaluate import run_evaluation
from rlctl.importing.foreign.import_policy import ImportedPolicy, import_policy, make_policy, read_network
from rlctl.importing.foreign.request import ForeignFiles
from rlctl.policy.load import check_playable
from rlctl.task.deployment import Deployment
from rlctl.task.mujoco.robot import Robot, read_robot
from rlctl_robot.diagnose.deployed import DeploymentDiagnosis, diagnose_deployment

NAMED = 0.8  # of the mistakes
EPISODES = 20  # of a score
Values = dict[str, Any]  # of a deployment
Change = Callable[[Values, Robot], Values]
_OF_JOINTS = ("stiffness", "damping")


@dataclasses.dataclass(frozen=True)
class Mistake:
    """A mistake that is put into the mapping of a policy."""

    name: str
    policy: str
    kinds: tuple[str, ...]  # those of diagnose's variants that say what is wrong
    change: Change


def set_values(**values: Any) -> Change:
    """Return a change of keys of the deployment."""
    return lambda deployment, robot: {**deployment, **values}


def order_joints(choose: Callable[[Sequence[str], Robot], Sequence[str]]) -> Change:
    """Return a change of the order of joints, while gains and default pose stay where they are."""
    return lambda deployment, robot: {**deployment, "joints": list(choose(deployment["joints"], robot))}


def exchange_joints(one: int, other: int) -> Change:
    """Return a change in which two joints are exchanged."""

    def choose(joints: Sequence[str], robot: Robot) -> list[str]:
        names = list(joints)
        names[one], names[other] = joints[other], joints[one]
        return names

    return order_joints(choose)


def exchange_sides(joints: Sequence[str], robot: Robot) -> list[str]:
    """Return the joints' names with left and right exchanged."""
    return [name.replace("Left", "?").replace("Right", "Left").replace("?", "Right") for name in joints]


def list_as_model(names: Sequence[str], joints: Sequence[str]) -> list[str]:
    """Return joints in the order of names of a model."""
    return [name for name in names if name in joints]


def order_values(keys: Sequence[str], choose: Callable[[Robot], Sequence[str]]) -> Change:
    """Return a change in which values are in another order than their joints."""

    def change(deployment: Values, robot: Robot) -> Values:
        joints = deployment["joints"]
        names = list_as_model(choose(robot), joints)
        ordered = {key: [deployment[key][joints.index(name)] for name in names] for key in keys}
        return {**deployment, **ordered}

    return change


def multiply(key: str, factor: float) -> Change:
    """Return a change of values of all joints by a factor."""
    return lambda deployment, robot: {**deployment, key: (factor * np.array(deployment[key])).tolist()}


def change_part(kind: str, factor: Any = 1.0, **values: Any) -> Change:
    """Return a change of an observation: its scale times a factor, and other keys."""

    def change(deployment: Values, robot: Robot) -> Values:
        parts = []
        for part in deployment["observations"]:
            if part["kind"] == kind:
                scale = (np.asarray(part.get("scale", 1.0), float) * factor).tolist()
                part = {**part, "scale": scale, **values}
            parts.append(part)
        return {**deployment, "observations": parts}

    return change


def exchange_parts(one: str, other: str) -> Change:
    """Return a change in which two observations are exchanged."""

    def change(deployment: Values, robot: Robot) -> Values:
        parts = list(deployment["observations"])
        kinds = [part["kind"] for part in parts]
        first, second = kinds.index(one), kinds.index(other)
        parts[first], parts[second] = parts[second], parts[first]
        return {**deployment, "observations": parts}

    return change


def turn_joints(*indices: int) -> Change:
    """Return a change in which joints turn the other way, in what is observed and commanded."""

    def change(deployment: Values, robot: Robot) -> Values:
        signs = np.ones(len(deployment["joints"]))
        signs[list(indices)] = -1.0
        turned = {**deployment, "action_scale": (signs * np.array(deployment["action_scale"])).tolist()}
        for kind in ("joint_positions", "joint_velocities"):
            turned = change_part(kind, signs)(turned, robot)
        return turned

    return change


def stretch_leg(first: int, count: int) -> Change:
    """Return a change in which the default positions of one leg are zero."""

    def change(deployment: Values, robot: Robot) -> Values:
        pose = list(deployment["default_positions"])
        pose[first : first + count] = [0.0] * count
        return {**deployment, "default_positions": pose}

    return change


def _negate_pose(deployment: Values, robot: Robot) -> Values:
    return multiply("default_positions", -1.0)(deployment, robot)


MISTAKES = (
    Mistake(
        "go2-legs",
        "go2",
        ("joint order",),
        order_joints(lambda joints, _: [*joints[3:6], *joints[:3], *joints[9:], *joints[6:9]]),
    ),
    Mistake("lab-g1-alphabetical", "lab-g1", ("joint order",), order_joints(lambda joints, _: sorted(joints))),
    Mistake("lab-g1-two-joints", "lab-g1", ("joint order",), exchange_joints(0, 1)),
    Mistake("b2-alphabetical", "b2", ("joint order",), order_joints(lambda joints, _: sorted(joints))),
    Mistake("go1-two-joints", "go1", ("joint order",), exchange_joints(1, 2)),
    Mistake("t1-sides", "t1", ("joint order",), order_joints(exchange_sides)),
    Mistake(
        "sar-g1-of-model",
        "sar-g1",
        ("joint order",),
        order_joints(lambda joints, robot: list_as_model(robot.joints, joints)),
    ),
    Mistake("lab-g1-gains", "lab-g1", ("gains",), order_values(_OF_JOINTS, lambda robot: robot.joints)),
    Mistake("gym-g1-gains", "gym-g1", ("gains",), order_values(_OF_JOINTS, lambda robot: robot.breadth_first)),
    Mistake("h1-damping", "h1", ("gains",), multiply("damping", 10.0)),
    Mistake("go2-action-scale", "go2", ("scale",), multiply("action_scale", 4.0)),
    Mistake("go2-velocity-scale", "go2", ("scale",), change_part("joint_velocities", 20.0)),
    Mistake("go1-degrees", "go1", ("scale",), change_part("gyroscope", 57.29578)),
    Mistake("go2-gravity-sign", "go2", ("sign",), change_part("gravity", -1.0)),
    Mistake("go2-joint-sign", "go2", ("sign",), turn_joints(1)),
    Mistake("b2-hip-signs", "b2", ("sign",), turn_joints(0, 3)),
    Mistake(
        "lab-g1-pose", "lab-g1", ("default pose",), order_values(("default_positions",), lambda robot: robot.joints)
    ),
    Mistake("b2-pose-of-a-leg", "b2", ("default pose",), stretch_leg(0, 3)),
    Mistake("h1-2-pose-sign", "h1-2", ("default pose",), _negate_pose),
    Mistake("go1-world-velocity", "go1", ("frame",), change_part("velocity", frame="world")),
    Mistake("t1-world-velocity", "t1", ("frame",), change_part("velocity", frame="world")),
    Mistake("lab-g1-newest-first", "lab-g1", ("history",), set_values(newest_first=True)),
    Mistake("lab-g1-frames", "lab-g1", ("history",), set_values(history_order="frames")),
    Mistake("xbot-newest-first", "xbot", ("history",), set_values(newest_first=True)),
    Mistake("lab-g1-rate", "lab-g1", ("rate",), set_values(control_dt=0.08)),
    Mistake("xbot-rate", "xbot", ("rate",), set_values(control_dt=0.04)),
    Mistake("h1-exchanged", "h1", ("parts",), exchange_parts("gyroscope", "gravity")),
)


class Trials:
    """Imports policies, and diagnoses them."""

    def __init__(self, policies: Mapping[str, Mapping[str, Any]], folder: Path) -> None:
        self._policies, self._folder = policies, folder

    def import_named(self, name: str) -> ImportedPolicy:
        """Return a policy as its files say."""
        files = self._policies[name]
        paths = {name: Path(files[name]) for name in ("deploy", "motion") if name in files}
        others = {name: files[name] for name in ("terrain", "motion_rate") if name in files}
        return import_policy(
            Path(files["policy"]),
            ForeignFiles(model=str(files["model"]), **paths, **others),
            settings=files.get("set"),
            output=self._folder / f"{name}.safetensors",
        )

    def score(self, name: str) -> bool:
        """Import and evaluate a policy."""
        began = time.monotonic()
        imported = self.import_named(name)
        result = run_evaluation(EvalRequest(str(imported.policy.path), episodes=EPISODES))
        error = f"velocity error {result.metrics['velocity_error']:.3f} m/s"
        if imported.deployment.follows_motion:
            error = f"error of the joints {result.metrics['joint_error']:.3f} rad"
        text = f"success {result.success_rate:.0%} of {EPISODES}, {error}"
        print(f"scores {name}: {text}, {time.monotonic() - began:.0f} s", flush=True)
        return True

    def judge_sound(self, name: str) -> bool:
        """Return whether the diagnosis finds no mistake in a policy that is played as its files describe."""
        result = _diagnose(self.import_named(name))
        is_right = result.best is None
        verdict = "silent" if is_right else "FALSE WORD"
        _print(f"sound {name}: {verdict}", result)
        return is_right

    def judge_mistake(self, mistake: Mistake) -> bool:
        """Return whether a mistake is named."""
        imported = self.import_named(mistake.policy)
        network, _ = read_network(Path(self._policies[mistake.policy]["policy"]))
        parameters = imported.policy.info.spec.parameters
        places = {
            name: str(parameters[name]) for name in ("robot_file", "terrain", "motion_file") if parameters.get(name)
        }
        robot = read_robot(Path(places["robot_file"]))
        wrong = Deployment(**mistake.change(imported.deployment.model_dump(mode="json"), robot))
        path = self._folder / f"{mistake.name}.safetensors"
        policy = make_policy(network, wrong, places, path)
        result = _diagnose(dataclasses.replace(imported, policy=policy))
        is_named = result.best is not None and result.best.kind in mistake.kinds
        verdict = "named" if is_named else "MISSED"
        if result.own.walks and result.best is None:
            verdict = "MISSED (it walks)"
        _print(f"mistakes {mistake.name} ({mistake.kinds[0]}): {verdict}", result)
        return is_named


def _diagnose(imported: ImportedPolicy) -> DeploymentDiagnosis:
    policy = imported.policy
    return diagnose_deployment(check_playable(policy).actor_only(), policy.info.spec)


def _print(begin: str, result: DeploymentDiagnosis) -> None:
    own = result.own.describe()
    said = "nothing" if result.best is None else f"{result.best.kind}: {result.best.text}"
    also = "".join(f" | {text}" for text in result.also)
    print(f"{begin}; {own} -> {said}{also}; {result.tried} changes, {result.seconds:.0f} s", flush=True)


def _list_cases(trials: Trials, names: Sequence[str]) -> Iterator[tuple[str, str, Callable[[], bool]]]:
    """Yield kind, name and what judges, of all cases of the policies that are there."""
    for name in names:
        yield "scores", name, lambda name=name: trials.score(name)
    for name in names:
        yield "sound", name, lambda name=name: trials.judge_sound(name)
    for mistake in MISTAKES:
        if mistake.policy in names:
            yield "mistakes", mistake.name, lambda mistake=mistake: trials.judge_mistake(mistake)


def main(arguments: Sequence[str]) -> int:
    """Run the cases that were asked for."""
    parser = argparse.ArgumentParser(prog="tests.benchmarks.foreign", description=__doc__)
    parser.add_argument("policies", type=Path)
    parser.add_argument("cases", nargs="*", default=[])
    given = parser.parse_args(arguments)
    policies = yaml.safe_load(given.policies.read_text())
    counts = {kind: [0, 0] for kind in ("scores", "sound", "mistakes")}
    with tempfile.TemporaryDirectory(prefix="rlctl-") as folder:
        for kind, name, judge in _list_cases(Trials(policies, Path(folder)), list(policies)):
            if given.cases and kind not in given.cases and f"{kind}:{name}" not in given.cases:
                continue
            counts[kind][0] += judge()
            counts[kind][1] += 1
    sound, mistakes = counts["sound"], counts["mistakes"]
    print(
        f"{sound[0]} of {sound[1]} sound policies without a false word, {mistakes[0]} of {mistakes[1]} mistakes named"
    )
    return int(sound[0] < sound[1] or mistakes[0] < NAMED * mistakes[1])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
