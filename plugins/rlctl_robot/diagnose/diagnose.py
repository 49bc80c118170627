"""Finds what is wrong in the mapping between a robot and a policy, from a log of observations and actions."""

import contextlib
import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from rlctl.environments.spec import EnvSpec
from rlctl.errors import AnswerIsNo, ArtifactError
from rlctl.limits.limits import Limits, read_limits
from rlctl.policy.file import PolicyFile
from rlctl_robot.diagnose.actor import RIGHT, LoggedActor
from rlctl_robot.diagnose.candidates import (
    list_candidates,
    list_joint_mistakes,
    list_joint_orders,
    make_normalised,
)
from rlctl_robot.diagnose.correction import JOINTS, Correction, correct
from rlctl_robot.diagnose.evidence import Likelihood, Scorer
from rlctl_robot.diagnose.frozen import Frozen, find_frozen
from rlctl_robot.diagnose.inputs import ControllerInputs
from rlctl_robot.diagnose.joints import FEWEST_ROWS, Judgement, judge
from rlctl_robot.diagnose.limited import find_limited_rows
from rlctl_robot.diagnose.log import RobotLog, read_robot_log
from rlctl_robot.diagnose.mapping import CorrectedMapping, build_mapping
from rlctl_robot.diagnose.physics import make_physics
from rlctl_robot.diagnose.policy_match import SAME, Matcher, PolicyMatch, describe_in_log
from rlctl_robot.diagnose.reference import record_mistakes, record_reference
from rlctl_robot.diagnose.rows import ChosenRows, choose_rows
from rlctl_robot.diagnose.search import EVIDENCE, LEAST_SHARE, Found, Search
from rlctl_robot.diagnose.signals import ACTIONS, MAX_DELAY, Array, LoggedSignals

MOST = 5  # findings that are listed
_STEPS_PER_ELEMENT, _FEWEST_STEPS, _MOST_STEPS = 400, 16_000, 20_000  # of rollouts in simulation
_GUESSES, _GUESS_STEPS = 4, 300  # mistakes with which the robot is simulated again, and for how many steps each
_ROWS = 500  # of a log, for the answers in numbers
_CERTAIN = 1e4  # evidence of what needs no statistics [nats]
_SOMETHING = 0.005  # part of the difference that a finding must explain to say what is wrong
_MAIN_SHARE = 0.8  # of the difference that a finding explains beside which weaker ones are checked again
_WEAK_EVIDENCE = 0.1  # of the evidence of the first finding
_MOST_GAIN = 2.0  # factor of an action, or its inverse, that a mapping may have
_LARGE_ERROR = 1.15  # times the usual error, from which something differs
_LARGER = 1.1  # than the largest error of a sound robot
_LARGE_LOSS = 2.0  # the same of the simulation's prediction, relative to the worst episode of a sound robot
_FEWEST_FREE = 20  # rows in which a server has not limited the action, to compare it with the policy's
_FALLEN = 0.2  # by which the direction of gravity leaves what sound robots measure
_FALLEN_SHARE = 0.02  # of the rows
_SIMULATED = ("order", "sign", "scale", "offset")  # what the simulation judges, where it can follow a log
_TOO_SHORT = (
    f"the log cannot tell: no part of it has {FEWEST_ROWS} rows without a gap, which the simulation needs. "
    f"Record episodes of {FEWEST_ROWS} rows or more, from a stance in which the robot does not fall at once"
)


@dataclasses.dataclass(frozen=True)
class MappingFinding:
    """One mistake in the mapping."""

    question: Literal[1, 2, 3]
    term: str
    kind: str
    text: str
    evidence: float  # [nats]
    explains: float  # part of the difference, in [0, 1]
    also: tuple[str, ...] = ()  # what this log cannot tell from it
    correction: Correction | None = None
    is_weak: bool = False
    """Whether another mistake explains so much more that this one may be a consequence of it."""

    @property
    def is_mistake(self) -> bool:
        """Whether it says what is wrong: it explains a part of the difference."""
        return self.explains >= _SOMETHING

    def describe(self) -> str:
        """Return the finding as a sentence."""
        return f"{self.text}: explains {self.explains:.0%} of the difference" if self.is_mistake else self.text


@dataclasses.dataclass(frozen=True)
class Answers:
    """The three questions as numbers."""

    policy_difference: float | None
    """Mean |logged - computed action| in standard deviations, each at most 1; None if a server limited all rows."""
    policy_difference_corrected: float | None
    term_errors: dict[str, tuple[float, float]]
    """Per observation: how many times larger than in simulation errors are, as logged and corrected."""
    step_error: tuple[float, float]  # the same of the prediction of the next row from this row and the action
    unexplained: str = ""  # how the log differs although no mistake was found
    simulated_error: tuple[float, float] | None = None
    """Loss of the simulation that is set to each logged row, relative to the worst of a sound robot: as logged and
    corrected, where it decided what is wrong."""


@dataclasses.dataclass(frozen=True)
class Diagnosis:
    """What a log shows about the mapping between a robot and a policy."""

    log: Path
    policy: str
    task: str
    rows: int
    seconds: float
    notes: tuple[str, ...]
    answers: Answers
    findings: tuple[MappingFinding, ...]
    mapping: CorrectedMapping

    def check(self) -> None:
        """Raise `AnswerIsNo` if a mistake was found, or if something differs and nothing explains it."""
        count = sum(finding.is_mistake and not finding.is_weak for finding in self.findings)
        if count:
            raise AnswerIsNo(f"{self.log}: {count} mistake{'s' if count > 1 else ''} in the mapping; see above")
        if self.findings or self.answers.unexplained:
            raise AnswerIsNo(f"{self.log}: something differs, the cause is unknown; see above")


class Doctor:
    """Diagnoses logs of one policy; the rollouts in simulation are made once.

    Raises `UsageError` for a policy whose observations or actions are not vectors of numbers.
    """

    def __init__(
        self,
        policy: PolicyFile,
        spec: EnvSpec,
        seed: int = 0,
        others: Sequence[PolicyFile] = (),
        steps: int | None = None,
        report: Callable[[str], None] = lambda _: None,
    ) -> None:
        """`steps` of rollouts in simulation in total; by default as many as the observation needs.

        `report` is called with a line about each part of the work.
        """
        self.policy, self.spec, self._others, self._seed = policy, spec, others, seed
        self._report = report
        self.actor = LoggedActor(policy)
        width = int(np.prod(policy.info.env.spaces()[0].shape or ()))
        steps = steps or int(np.clip(_STEPS_PER_ELEMENT * width, _FEWEST_STEPS, _MOST_STEPS))
        report(f"simulating sound and faulty robots for {steps:,} control steps")
        reference = record_reference(spec, self.actor, steps, seed)
        report("learning how their signals depend on each other")
        self.likelihood = Likelihood(reference)
        statistics = reference.statistics
        self.joint_mistakes = list_joint_mistakes(policy.info.env, statistics)
        self.candidates = list_candidates(policy.info.env, statistics, self.actor.normalize)
        self.physics = make_physics(spec, policy.info.env, statistics, reference.held_out)
        # Relations are linear near what sound robots do; far from it only the simulation tells orders of joints apart.
        orders = list_joint_orders(policy.info.env, statistics, self.candidates)
        self._simulated_mistakes = [*self.joint_mistakes, *orders]
        if self.physics is None:
            self.candidates += self.joint_mistakes
        report(f"trying {len(self.candidates):,} corrections on sound robots")
        try:
            self.likelihood.learn_chances(self.candidates)
        except BaseException:  # it takes a minute, in which it may be interrupted
            self.close()
            raise

    def close(self) -> None:
        """Close the simulation."""
        if self.physics is not None:
            self.physics.close()

    def diagnose(
        self,
        signals: LoggedSignals,
        limits: Limits | None = None,
        limited: Array | None = None,
        inputs: ControllerInputs | None = None,
    ) -> tuple[list[MappingFinding], Answers, CorrectedMapping]:
        """Return the mistakes, the one with the most evidence first, the answers in numbers and the mapping.

        Actions that `limits` have changed, and those of the rows in `limited`, shape (T,), are not compared with those
        of the policy. The mapping is of `inputs` for the log of a program that runs a controller.
        """
        if not len(signals.inner_rows(self.likelihood.margin)):
            longest, needed = max(signals.lengths), 2 * self.likelihood.margin + 1
            raise ArtifactError(f"the longest part without gaps has {longest} rows; diagnose needs {needed}")
        reference = self.likelihood.reference
        frozen = find_frozen(signals, (reference.sound, reference.varied))
        if limits is not None:
            by_limits = find_limited_rows(limits, self.policy.info.env, signals, self.likelihood.margin)
            limited = by_limits if limited is None else limited | by_limits
        self._report("comparing the logged actions with those of the policy")
        inner = signals.inner_rows(MAX_DELAY + 1)
        is_unknown = limited is not None and int((~limited[inner]).sum()) < _FEWEST_FREE
        match = PolicyMatch(0.0, 0.0) if is_unknown else self._match(signals, frozen, limited)
        findings = [*self._describe_frozen(frozen, signals), *self._describe_match(match, signals, bool(frozen))]
        corrected = correct(signals, match.corrections)
        stuck = [(one.term, element) for one in frozen for element in one.elements]
        used = len(match.corrections) + bool(match.variant.text) + len(frozen)
        self._report("searching for corrections with which the signals depend on each other as in simulation")
        most = max(0, 2 - used)
        found = self._search(corrected, stuck, most)
        of_inputs = None
        if inputs is not None and most:
            of_inputs = self._find_input_mistake(inputs, corrected, match, found, stuck)
        if inputs is not None and of_inputs is not None:
            corrected = self._correct_input(inputs, of_inputs.correction, signals, match)
            found = self._search(corrected, stuck, most - 1)
            findings.append(_make_finding(of_inputs, of_inputs.correction.describe()))
        judgement, is_too_short = None, False
        if self.physics is not None and not frozen:
            self._report(
                f"simulating the log step by step, with {len(self._simulated_mistakes):,} mistakes of the joints"
            )
            judgement = judge(self.physics, corrected, found, self._simulated_mistakes)
            if judgement is None:
                certain = [one for one in found if one.correction.kind not in _SIMULATED]
                is_too_short, found = len(certain) < len(found), certain
            else:
                found = list(judgement.found)
        for one in found:
            findings.append(_make_finding(one, _describe_on_robot(one.correction, inputs)))
        findings.sort(key=lambda finding: (not finding.is_mistake, -finding.evidence))
        findings = _mark_weak(findings)[:MOST]
        weak = [finding.correction for finding in findings if finding.is_weak]
        of_robot = [one.correction for one in found]
        answers = self._answer(signals, corrected, of_robot, match, stuck)
        if judgement is not None and judgement.adds_mistake:
            answers = dataclasses.replace(
                answers, simulated_error=(judgement.times_usual_before, judgement.times_usual)
            )
        if is_unknown:
            answers = dataclasses.replace(answers, policy_difference=None, policy_difference_corrected=None)
        if not any(finding.is_mistake for finding in findings):
            unexplained = self._describe_unexplained(answers, signals, judgement)
            if is_too_short:
                unexplained = _TOO_SHORT
            answers = dataclasses.replace(answers, unexplained=unexplained)
        mapped = [one for one in of_robot if one not in weak and not _has_large_gain(one)]
        mapped = [one for one in mapped if not _list_sources(one, inputs)]
        if of_inputs is not None:
            mapped.append(of_inputs.correction)
        mapping = build_mapping(
            match.corrections,
            mapped,
            dict(signals.sizes),
            self.policy.info.env.joints,
            is_of_controller=inputs is not None,
            quaternions=() if inputs is None else inputs.quaternions,
        )
        return findings, answers, mapping

    def _describe_unexplained(self, answers: Answers, signals: LoggedSignals, judgement: Judgement | None) -> str:
        """Return how a log without a mistake that explains it differs; empty if it does not."""
        signs = []
        if judgement is not None:
            if judgement.times_usual > _LARGE_LOSS:
                signs.append("the simulation, set to each row, predicts the next one worse than for any sound robot")
        elif answers.step_error[0] > max(_LARGE_ERROR, _LARGER * self.likelihood.largest_error):
            signs.append(f"errors of the next row are {answers.step_error[0]:.3g} times the usual ones")
        if self._falls(signals):
            signs.append("the robot falls")
        if not signs:
            return ""
        tried = f"{len(self.candidates):,} single corrections of observations and actions, and pairs"
        if self.joint_mistakes:
            tried += f"; {len(self.joint_mistakes):,} orders and signs of whole joints"
        return f"{' and '.join(signs)}. Tried: {tried}. Not tried: the robot's masses, gains and friction, the ground"

    def _falls(self, signals: LoggedSignals) -> bool:
        """Return whether the trunk lies as that of a sound robot never does."""
        if signals.sizes.get("gravity") != 3:
            return False
        sound = self.likelihood.reference.sound.term("gravity")[:, 2]
        upright = signals.term("gravity")[:, 2]
        return bool((upright > sound.max() + _FALLEN).mean() > _FALLEN_SHARE)

    def _search(self, signals: LoggedSignals, stuck: Sequence[tuple[str, int]], most: int) -> list[Found]:
        """Return what the simulation says is wrong.

        Where something is, the search is repeated with relations that are also those of robots with such mistakes: they
        get where the other rollouts were not.
        """
        search = Search(self.likelihood, signals, self.candidates, stuck)
        found = search.find(most)
        if not found:
            return []
        first = [one.correction for one in found]
        mistakes = [first, *search.list_guesses(_GUESSES)]
        if len(first) < most:
            mistakes += search.list_guesses(_GUESSES, first)
        recordings = record_mistakes(self.spec, self.actor, mistakes, _GUESS_STEPS * len(mistakes), self._seed)
        return Search(self.likelihood.learn_more(recordings), signals, self.candidates, stuck).find(most) or found

    def _find_input_mistake(
        self,
        inputs: ControllerInputs,
        corrected: LoggedSignals,
        match: PolicyMatch,
        found: Sequence[Found],
        stuck: Sequence[tuple[str, int]],
    ) -> Found | None:
        """Return the mistake of an input that explains the log better than `found`, what was found without it."""
        rows = self._choose_rows(corrected)
        before = Scorer(self.likelihood, corrected, rows, stuck)
        nothing = before.score
        with_found = before.rebase([one.correction for one in found])
        before.rebase([])
        best = None
        for mistake in inputs.list_mistakes():
            right = self._correct_input(inputs, mistake, corrected, match)
            after = Scorer(self.likelihood, right, rows, stuck)
            evidence, share = nothing - after.score, before.share_of(after)
            is_convincing = evidence >= EVIDENCE and share >= LEAST_SHARE and after.score < with_found
            if is_convincing and (best is None or evidence > best.evidence):
                best = Found(mistake, evidence, share)
        return best

    def _correct_input(
        self, inputs: ControllerInputs, mistake: Correction, signals: LoggedSignals, match: PolicyMatch
    ) -> LoggedSignals:
        """Return the log as it were without a mistake of an input, with the corrections of the log alone."""
        observations = inputs.compute_observations(mistake)
        changed = dataclasses.replace(signals, observations=observations, actions=inputs.actions)
        return correct(changed, match.corrections)

    def _match(self, signals: LoggedSignals, frozen: Sequence[Frozen], limited: Array | None) -> PolicyMatch:
        std = self.likelihood.reference.statistics[ACTIONS].std
        if self.actor.in_rows:
            candidates = [one for one in self.candidates if not one.parts]
            match = Matcher(self.actor, signals, std, candidates, None, limited).match(pairs=not frozen)
            if frozen and not match.is_explained:  # the policy may have received what the log does not hold
                unknown = self._list_unknown(frozen, signals)
                if len(unknown) < len(std):
                    match = Matcher(self.actor, signals, std, candidates, unknown, limited).match(pairs=False)
            return self._decide_normalisation(match, signals)
        difference = np.minimum(np.abs(signals.actions - self.actor.act_on_log(signals)) / std, 1.0)
        difference = difference if limited is None else difference[~limited]
        return PolicyMatch(float(difference.mean()), float(difference.mean()))

    def _list_unknown(self, frozen: Sequence[Frozen], signals: LoggedSignals) -> dict[int, float]:
        """Return the columns of frozen elements, with their usual values."""
        statistics = self.likelihood.reference.statistics
        return {
            signals.slices[one.term].start + element: float(statistics[one.term].mean[element])
            for one in frozen
            for element in one.elements
        }

    def _decide_normalisation(self, match: PolicyMatch, signals: LoggedSignals) -> PolicyMatch:
        """Tell logged values that are normalised already from a network that got none: the actions are the same."""
        if self.actor.normalize is None or not match.is_explained:
            return match
        normalised = make_normalised(self.actor.normalize)
        is_variant = match.variant.normalizes == 0
        if not is_variant and normalised not in match.corrections:
            return match
        scorer = Scorer(self.likelihood, signals, self._choose_rows(signals))
        others = [one for one in match.corrections if one != normalised]
        scorer.rebase(others)
        if scorer.gain(normalised) > 0:
            return dataclasses.replace(match, corrections=(normalised, *others), variant=RIGHT, also=())
        variant = next(one for one in self.actor.variants() if one.normalizes == 0)
        return dataclasses.replace(match, corrections=tuple(others), variant=variant, also=())

    def _choose_rows(self, signals: LoggedSignals) -> ChosenRows:
        rows = signals.inner_rows(self.likelihood.margin)
        return choose_rows(signals, rows, self.likelihood.reference.statistics, _ROWS)

    def _describe_frozen(self, frozen: Sequence[Frozen], signals: LoggedSignals) -> list[MappingFinding]:
        return [
            MappingFinding(2, one.term, "frozen", one.describe(signals.sizes[one.term]), _CERTAIN + one.rows, 1.0)
            for one in frozen
        ]

    def _describe_match(self, match: PolicyMatch, signals: LoggedSignals, is_frozen: bool) -> list[MappingFinding]:
        if match.is_same:
            return []
        explains = max(0.0, 1 - match.corrected / match.difference)
        evidence = len(signals.actions) * float(np.log(match.difference / max(match.corrected, 1e-6)))
        if not match.is_explained:
            if is_frozen:  # the policy may have received what the log does not show
                return []
            text = self._find_other_policy(signals) or (
                "actions: the policy does not produce the logged actions from the logged observations, and no "
                "correction explains it: they may be of another policy file, sampled, or limited (--limits FILE)"
            )
            return [MappingFinding(1, "policy", "policy", text, _CERTAIN, 1.0 if "of the policy" in text else 0.0)]
        found = []
        if match.variant.text:
            text = f"policy: {match.variant.text}"
            found.append(MappingFinding(1, "policy", "variant", text, evidence, explains))
        also = tuple(" and ".join(one.describe() for one in some) for some in match.also)
        for one in match.corrections:
            text = describe_in_log(one)
            found.append(MappingFinding(1, one.term, one.kind, text, evidence, explains, also, one))
        return found

    def _find_other_policy(self, signals: LoggedSignals) -> str:
        std = self.likelihood.reference.statistics[ACTIONS].std
        for other in self._others:
            difference = np.abs(signals.actions - LoggedActor(other).act_on_log(signals)) / std
            if float(np.minimum(difference, 1.0).mean()) < SAME:
                return f"actions: they are those of the policy {other.path}"
        return ""

    def _answer(
        self,
        signals: LoggedSignals,
        corrected: LoggedSignals,
        of_robot: Sequence[Correction],
        match: PolicyMatch,
        stuck: Sequence[tuple[str, int]],
    ) -> Answers:
        rows = self._choose_rows(signals)
        before, after = Scorer(self.likelihood, signals, rows, stuck), Scorer(self.likelihood, corrected, rows, stuck)
        after.rebase(of_robot)
        terms = {name: (before.times_usual(name), after.times_usual(name)) for name in signals.sizes}
        step = before.times_usual(None), after.times_usual(None)
        return Answers(match.difference, match.corrected, terms, step)


def _mark_weak(findings: Sequence[MappingFinding]) -> list[MappingFinding]:
    """Mark what may be a consequence of a finding that explains most of what the simulation says."""
    of_robot = [finding for finding in findings if finding.question != 1 and finding.kind != "frozen"]
    if not of_robot or of_robot[0].explains < _MAIN_SHARE:
        return list(findings)
    main = of_robot[0]
    marked = []
    for finding in findings:
        is_other = finding in of_robot[1:] and finding.is_mistake
        is_smaller = finding.explains < _MAIN_SHARE or finding.evidence < _WEAK_EVIDENCE * main.evidence
        marked.append(dataclasses.replace(finding, is_weak=is_other and is_smaller))
    return marked


def _has_large_gain(one: Correction) -> bool:
    """Return whether a correction of the actions would multiply some of them by a large or small factor."""
    if one.term != ACTIONS or not one.factor or one.kind != "scale":
        return False
    factors = np.abs(one.factor)
    return bool((np.maximum(factors, 1 / factors) > _MOST_GAIN).any())


def _make_finding(one: Found, text: str) -> MappingFinding:
    correction = one.correction
    question: Literal[2, 3] = 3 if correction.term in (ACTIONS, JOINTS) else 2
    also = tuple(other.describe() for other in one.also)
    return MappingFinding(
        question, correction.term, correction.kind, text, one.evidence, one.explains, also, correction
    )


def _list_sources(one: Correction, inputs: ControllerInputs | None) -> tuple[str, ...]:
    """Return the inputs to correct instead of an observation that the program does not have."""
    return () if inputs is None else inputs.find_sources(one.term)


def _describe_on_robot(one: Correction, inputs: ControllerInputs | None = None) -> str:
    if sources := _list_sources(one, inputs):
        return f"{one.describe()} (not in the mapping: it is computed from {', '.join(sources)})"
    if not _has_large_gain(one):
        return one.describe()
    return f"{one.describe()} (not in the mapping: look for the cause at the motors, such as a sign or a gain)"


def diagnose_log(
    path: Path,
    policy: PolicyFile,
    spec: EnvSpec,
    *,
    columns: Path | None = None,
    limits: Path | None = None,
    seed: int = 0,
    others: Sequence[PolicyFile] = (),
    report: Callable[[str], None] = lambda _: None,
) -> Diagnosis:
    """Read a log and compare it with a policy and its task in simulation.

    Raises `ArtifactError` for a log that cannot be read or does not fit the policy, `UsageError` for a policy that
    cannot be diagnosed.
    """
    from threadpoolctl import threadpool_limits

    bounds = None if limits is None else read_limits(limits)
    log: RobotLog = read_robot_log(path, policy.info.env, columns)
    report(f"{len(log.signals.actions):,} rows")
    with (
        threadpool_limits(1, "blas"),  # with other programs on the same cores, threads wait for each other
        contextlib.closing(Doctor(policy, spec, seed, others, report=report)) as doctor,
    ):
        findings, answers, mapping = doctor.diagnose(log.signals, bounds, log.limited, log.inputs)
    rows = len(log.signals.actions)
    return Diagnosis(
        log=path,
        policy=str(policy.path),
        task=spec.task,
        rows=rows,
        seconds=rows * (policy.info.env.control_dt or 0.0),
        notes=log.notes,
        answers=answers,
        findings=tuple(findings),
        mapping=mapping,
    )
