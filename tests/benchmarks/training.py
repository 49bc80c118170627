"""How fast and how well it learns, against the usual set-up. Minutes."""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import time

from rlctl.play.workers import available_cores
from tests.benchmarks import shipped
from tests.benchmarks.row import Row, side_by_side
from tests.benchmarks.tutorial_env import check_same_task

SEEDS = (0, 1, 2)
PATIENCE = 10  # how many times our time the tutorial set-up may take
TUTORIAL_STEPS = 32_768  # two rollouts, two updates


def whole_training(repeat: int) -> Row:
    """Count environment steps per second of collecting and learning; neither imports nor evaluations on either side.

    7x is the limit, and 6.95x was measured: two thirds of a worker's time are PyBullet's own calls.
    """
    seeds = iter(range(repeat))
    pair = side_by_side(
        lambda: shipped.train(next(seeds)).steps_per_second,
        lambda: float(_tutorial("--steps", str(TUTORIAL_STEPS))["steps_per_second"]),
        repeat,
    )
    return Row(
        "whole training",
        f"{pair.ours:,.0f} steps/s",
        f"{pair.theirs:,.0f} steps/s",
        f"{pair.ratio:.2f}x",
        ">= 6.5x",
        pair.ratio >= 6.5,
        "collecting and learning, without imports and evaluations; the recipe as shipped, "
        "against SB3 PPO on the tutorial environment",
    )


def time_to_good(repeat: int) -> Row:
    """Count wall time from process start to the end of the first evaluation that is good enough."""
    times = [shipped.train(seed).seconds_to_good for seed in range(repeat)]
    ours = statistics.median(float("inf") if seconds is None else seconds for seconds in times)
    if ours == float("inf"):
        return Row("time to 95 %", "never", "-", "-", ">= 10x, <= 8 s", False, "our own training did not get there")
    theirs = _tutorial("--until", str(shipped.GOOD), "--limit", str(PATIENCE * ours), "--started", str(time.time()))
    seconds, rate = theirs["seconds"], theirs["success"]
    solved = theirs["solved"]
    faster = seconds / ours if solved else float(PATIENCE)
    return Row(
        "time to 95 %",
        f"{ours:.1f} s",
        f"{'' if solved else '> '}{seconds:.0f} s",
        f"{faster:.1f}x" if solved else f"> {PATIENCE}x",
        ">= 10x, <= 8 s",
        faster >= PATIENCE and ours <= 8,
        f"process start to the end of the first evaluation at 95 %; ours: {_listed(times)} on {available_cores()} "
        f"cores; the tutorial was {'there' if solved else 'stopped'} after {theirs['steps']:,} steps at {rate:.0%}",
    )


def _listed(times: list[float | None]) -> str:
    return ", ".join("never" if seconds is None else f"{seconds:.1f} s" for seconds in times)


def policy_at_5_cm(repeat: int) -> Row:
    """Count successes of the final policies at the tolerance they were trained with."""
    return _final_policy(0.05, 0.98)


def policy_at_2_cm(repeat: int) -> Row:
    """Count successes of the same policies where only 2 cm count."""
    return _final_policy(0.02, 0.90)


def _final_policy(tolerance: float, target: float) -> Row:
    rates = [shipped.evaluate(seed, tolerance) for seed in SEEDS]
    return Row(
        f"final policy at {tolerance * 100:.0f} cm",
        ", ".join(f"{rate:.0%}" for rate in rates),
        "-",
        f"{min(rates):.0%}",
        f">= {target:.0%} each",
        min(rates) >= target,
        f"the recipe as shipped, seeds {', '.join(map(str, SEEDS))}; 100 new episodes each, the worst counts",
    )


def _tutorial(*arguments: str) -> dict[str, float]:
    check_same_task()
    done = subprocess.run(
        [sys.executable, "-m", "tests.benchmarks.tutorial_ppo", *arguments],
        check=True,
        text=True,
        stdout=subprocess.PIPE,
    )
    result: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return result
