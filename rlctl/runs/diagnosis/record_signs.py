"""Signs in the values logged after updates, in the use of time and in the end of a run. Functions as in `signs`."""

import shlex
from typing import NamedTuple

import numpy as np

from rlctl.output import format_count
from rlctl.recipe.hindsight import has_sparse_reward, suggest_hindsight
from rlctl.recipe.recipe import Recipe
from rlctl.runs.diagnosis import usual_ranges
from rlctl.runs.diagnosis.history import FEW_ROWS, LEAST_ROWS, Curve, RunHistory

_USUAL_RATE = 1e-3  # the most that is usual
_YOUNG = 10  # lengths of an average: until then it is behind weights that change fast
_FAR_BELOW = 0.5  # of the range of the training's returns
_MOST_NORMALIZED_REWARD = 10.0  # where SB3's `VecNormalize` clips


def critic_explains_nothing(run: RunHistory) -> str | None:
    """The value function explains nothing of the returns."""
    explained = run.curve("explained_variance")
    if len(explained) < LEAST_ROWS:
        return None
    median = float(np.median(explained.values[len(explained) // 2 :]))
    return f"explained variance {median:.2f} (median of the second half)" if median < 0.1 else None


def values_explode(run: RunHistory) -> str | None:
    """The critic predicts more than rewards can add up to."""
    value, most = run.curve("value"), _largest_value(run)
    if len(value) < FEW_ROWS or most is None:
        return None
    peak, last = float(np.abs(value.values).max()), value.thirds()[1]
    # An entropy bonus comes on top of rewards, most at the beginning.
    if peak < 30 * most and abs(last) < 3 * most:
        return None
    return f"the critic predicts up to {peak:.3g} (last third: {last:.3g}), but rewards add up to {most:.3g} at most"


def gradients_explode(run: RunHistory) -> str | None:
    """Gradients are far larger than errors of the value function can explain."""
    norm, most = run.curve("gradient_norm"), _largest_value(run)
    if len(norm) < FEW_ROWS or most is None or (peak := float(norm.values.max())) < 1000 * max(most, 1.0):
        return None
    return f"the gradient norm reaches {peak:.2g}, but rewards add up to {most:.3g} at most"


def _largest_value(run: RunHistory) -> float | None:
    """Return the most that discounted rewards can add up to, as the critic sees them; None where it is not known."""
    gamma, settings = run.parameters.get("gamma"), run.recipe.get("normalize")
    if not isinstance(gamma, float) or not 0 <= gamma < 1 or not run.episodes:
        return None
    largest = max(float(np.abs(episode.rewards).max()) for episode in run.episodes)
    if isinstance(settings, dict) and settings.get("reward", True):
        largest = _MOST_NORMALIZED_REWARD
    return max(largest / (1 - gamma), float(np.abs(run.curve("return").values).max(initial=0.0)))


def policy_hardly_changes(run: RunHistory) -> str | None:
    """Updates change nothing, before a schedule has lowered the learning rate."""
    change = _read_change(run) if len(run.metrics) >= LEAST_ROWS else None
    return change.describe(".1e") if change and change.kl <= 1e-4 and change.clipped <= 1e-3 else None


def policy_jumps(run: RunHistory) -> str | None:
    """Updates change the policy several times more than PPO intends."""
    change = _read_change(run)
    return change.describe() if change and (change.kl >= 0.2 or change.clipped >= 0.55) else None


def updates_are_large(run: RunHistory) -> str | None:
    """Updates change the policy more than PPO intends, though what was learned may survive them."""
    change = _read_change(run)
    return change.describe() if change and (change.kl >= 0.08 or change.clipped >= 0.45) else None


def learning_rate_is_far_above(run: RunHistory) -> str | None:
    """The learning rate is at least ten times the usual most."""
    rate = usual_ranges.read_first_value(run.parameters.get("learning_rate"))
    return f"learning rate {rate:g}" if rate is not None and rate >= 10 * _USUAL_RATE else None


def setting_is_far_out(run: RunHistory) -> str | None:
    """A hyperparameter is far out of its usual range."""
    return "; ".join(usual_ranges.describe(setting, run.recipe.get("algo")) for setting in run.find_far_out()) or None


def policy_is_replaced(run: RunHistory) -> str | None:
    """Each update replaces the policy by a very different one, and none of them is good."""
    change = _read_change(run)
    return change.describe() if change and not run.is_good and change.kl >= 1 and change.clipped >= 0.7 else None


class _Change(NamedTuple):
    """How much updates change the policy: medians of the first two thirds, in which schedules still have an effect."""

    kl: float
    clipped: float

    def describe(self, form: str = ".2g") -> str:
        """Return the medians as text."""
        return f"approx_kl {self.kl:{form}}, clip fraction {self.clipped:.1%} (medians)"


def _read_change(run: RunHistory) -> _Change | None:
    curves = [run.curve(name).values for name in ("approx_kl", "clip_fraction")]
    early = [values[: (2 * len(values) + 2) // 3] for values in curves]
    return _Change(*(float(np.median(values)) for values in early)) if min(map(len, curves)) >= FEW_ROWS else None


def exploration_vanishes(run: RunHistory) -> str | None:
    """The policy is almost deterministic halfway through the training, or from the beginning."""
    if len(curve := _exploration(run)) < LEAST_ROWS:
        return None
    half = curve.values[max(0, len(curve) // 2 - 2) : len(curve) // 2 + 1].mean()
    if half > 0.1 * curve.values[0] and not (curve.values[0] < 0.02 and half < 0.02):
        return None
    return f"exploration {curve.values[0]:.2g} at first, {half:.2g} halfway (1 is half the range of an action)"


def _exploration(run: RunHistory) -> Curve:
    measured = run.curve("exploration")
    return measured if len(measured) else run.curve("std")


def exploration_does_not_fall(run: RunHistory) -> str | None:
    """The policy is as random at the end as at the beginning, or more so."""
    if len(curve := _exploration(run)) < LEAST_ROWS or run.progress < 0.5:
        return None
    first, last = curve.thirds()
    return f"exploration {first:.2g} in the first third, {last:.2g} in the last" if last >= 0.97 * first else None


def exploration_explodes(run: RunHistory) -> str | None:
    """The policy becomes far more random than the actions' range."""
    if len(curve := _exploration(run)) < FEW_ROWS:
        return None
    first, last = curve.thirds()
    grows = last > max(2 * first, 2.0)
    return f"exploration grows from {first:.2g} to {last:.2g} of half the action range" if grows else None


def saturated(run: RunHistory) -> str | None:
    """Nearly all actions are at a limit of their range."""
    curve = run.curve("action_saturation")
    if len(curve) < FEW_ROWS or (last := curve.thirds()[1]) < 0.8:
        return None
    return f"{last:.0%} of the actions are at a limit in the last third"


def learner_slow(run: RunHistory) -> str | None:
    """Updates take most of the time."""
    shares = _read_shares(run)
    return shares.describe() if shares and shares.learner >= 0.75 else None


def replays(run: RunHistory) -> str | None:
    """The algorithm learns from a replay buffer."""
    if "train_freq" not in run.parameters:
        return None
    return ", ".join(f"{name} {run.parameters[name]}" for name in ("train_freq", "gradient_steps"))


def average_is_young(run: RunHistory) -> str | None:
    """The last evaluation, of an averaged actor with few updates, is far below the training's return before it."""
    decay, evaluated = run.parameters.get("actor_average"), run.evaluation_curve("return")
    if not isinstance(decay, float) or not 0 < decay < 1 or not len(evaluated):
        return None
    step, score = evaluated.steps[-1], float(evaluated.values[-1])
    updates, returns = run.curve("n_updates"), run.curve("return")
    count = updates.values[updates.steps <= step][-1:]
    before = returns.values[returns.steps <= step]
    if len(before) < FEW_ROWS or not len(count) or count[0] > _YOUNG / (1 - decay):
        return None
    trained = float(np.median(before[-FEW_ROWS:]))
    if trained - score <= _FAR_BELOW * float(np.ptp(before)):
        return None
    return (
        f"the training's return before step {step:,.0f} is {trained:.4g}, the evaluation's {score:.4g}, after "
        f"{count[0]:,.0f} updates; the average is over {1 / (1 - decay):,.0f}"
    )


def policy_slow(run: RunHistory) -> str | None:
    """Choosing actions takes more time than stepping the environments."""
    shares = _read_shares(run)
    return shares.describe() if shares and shares.policy > max(0.4, shares.environments) else None


def environments_slow(run: RunHistory) -> str | None:
    """Slow environments take most of the time."""
    shares = _read_shares(run)
    if shares is None or shares.environments < 0.5 or shares.learner > 0.2 or shares.steps_per_s > 300:
        return None
    return shares.describe()


class _Shares(NamedTuple):
    """Fractions of the learner's time; environments that step during updates do not count."""

    environments: float
    policy: float
    learner: float
    steps_per_s: float

    def describe(self) -> str:
        """Return the shares as text."""
        return (
            f"{self.environments:.0%} of the time is spent in environments, {self.policy:.0%} in choosing actions, the "
            f"rest in updates; {self.steps_per_s:,.0f} steps/s"
        )


def _read_shares(run: RunHistory) -> _Shares | None:
    playing = run.curve("playing")
    if len(playing) < LEAST_ROWS:
        return None
    waited, acting = _median(playing), _median(run.curve("acting"))
    return _Shares(waited * (1 - acting), waited * acting, 1 - waited, _median(run.curve("fps")))


def _median(curve: Curve) -> float:
    return float(np.median(curve.values)) if len(curve) else 0.0


def observations_outside(run: RunHistory) -> str | None:
    """Observations were outside their space."""
    count = run.status.get("observations_outside")
    return f"outside their space: {format_count(count, 'observation')}" if isinstance(count, int) and count else None


def diverged(run: RunHistory) -> str | None:
    """Losses or weights were not finite."""
    return str(run.status.get("error")).partition("\n")[0] if run.status.get("status") == "diverged" else None


def model_file_missing(run: RunHistory) -> str | None:
    """The run failed because a model could not be loaded."""
    error = str(run.status.get("error") or "")
    names = (".urdf", ".xml", ".sdf", ".mjcf", ".obj", ".stl")
    if run.status.get("status") != "failed" or not any(name in error.lower() for name in names):
        return None
    return error.partition("\n")[0]


def last_stage_never_begun(run: RunHistory) -> str | None:
    """The training is over, and ended before the last stage of its curriculum."""
    reached = run.curve("stage").values
    if run.status.get("status") != "finished" or not len(reached) or reached[-1] >= run.stage_count:
        return None
    return f"the training ended in stage {reached[-1]:.0f} of {run.stage_count}"


def stage_never_succeeds(run: RunHistory) -> str | None:
    """A stage before the last took a large part of all steps, and none of its episodes succeeded."""
    reached, success = run.curve("stage"), run.curve("success")
    if not len(reached) or not len(success) or reached.values[-1] >= run.stage_count:
        return None
    stage, total = reached.values[-1], run.recipe.get("total_timesteps")
    began = float(reached.steps[reached.values == stage][0])
    spent = float(reached.steps[-1]) - began
    if not isinstance(total, int | float) or spent < 0.4 * total or success.values[success.steps >= began].any():
        return None
    return f"no episode succeeded in stage {stage:.0f} of {run.stage_count}, which has taken {spent:,.0f} steps"


def goals_without_hindsight(run: RunHistory) -> str | None:
    """The environment has goals and a sparse reward, and was trained without hindsight replay."""
    if run.env is None or not run.recipe or has_sparse_reward([episode.rewards for episode in run.episodes]) is False:
        return None
    if (options := suggest_hindsight(Recipe.model_validate(run.recipe), run.env)) is None:
        return None
    task = shlex.quote(str(run.status.get("task", "TASK")))
    return f"achieved_goal, desired_goal and compute_reward, but no hindsight: rlctl train {task} {options}"
