"""`python -m tests.benchmarks [ROW ...]`: measures, prints a table, and ends with 1 if a number is not reached."""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import json
import os
import sys
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table

from tests.benchmarks.row import Row

# Imported when they run: startup must not wait for torch, nor be measured beside its threads.
ROWS = {
    "step": "stepping:one_environment",
    "reset": "stepping:reset",
    "workers": "stepping:many_environments",
    "playing": "acting:reach",
    "playing-half-cheetah": "acting:half_cheetah",
    "evaluating": "acting:evaluation",
    "playing-256": "acting:per_step",
    "onnx": "inference:onnx_runtime",
    "c": "inference:c_function",
    "serve": "serving:one_client",
    "serve-16": "serving:sixteen_clients",
    "serve-memory": "serving:memory",
    "serve-plain": "serving:against_plain_server",
    "serve-start": "serving:start",
    "safety-filter": "serving:safety_filter",
    "help": "startup:help_page",
    "check": "checking:bundled_task",
    "check-cartpole": "checking:cart_pole",
    "check-rl3": "checking:determinism",
    "ant": "classics:ant",
    "half-cheetah": "classics:half_cheetah",
    "hopper": "classics:hopper",
    "walker2d": "classics:walker2d",
    "humanoid": "classics:humanoid",
    "biped": "robots:biped",
    "biped-3d": "robots:biped_3d",
    "quadruped": "robots:quadruped",
    "kuka-grasp": "robots:kuka_grasp",
    "reach-mujoco": "engines:one_world",
    "walk-batch": "engines:many_worlds",
    "walk": "engines:walk",
    "reach-batch": "engines:reach_batch",
    "reach-batch-learned": "engines:reach_batch_learns",
    "gear-arm": "robots:gear_arm",
    "reach-sparse": "robots:reach_sparse",
    "checkpoints-ppo": "checkpoints:while_ppo_trains",
    "checkpoints-sac": "checkpoints:while_sac_trains",
    "beside-training": "checkpoints:beside_training",
    "replay-buffer": "checkpoints:replay_buffer",
    "diagnose-reach": "diagnosing:reach",
    "diagnose-quadruped": "diagnosing:quadruped",
    "diagnose-gear-arm": "diagnosing:gear_arm",
    "diagnose-walk": "diagnosing:walk",
    "diagnose-swaps-reach": "swaps:reach",
    "diagnose-swaps-walk": "swaps:walk",
    "identify-arm": "identifying:arm",
    "identify-quadruped": "identifying:quadruped",
    "zoo-ppo-reach": "zoo:ppo_reach",
    "zoo-ppo-half-cheetah": "zoo:ppo_half_cheetah",
    "zoo-sac-half-cheetah": "zoo:sac_half_cheetah",
    "zoo-tqc-half-cheetah": "zoo:tqc_half_cheetah",
    "sbx-tqc-128": "sbx:tqc_128",
    "sbx-sac-128": "sbx:sac_128",
    "sbx-sac-256": "sbx:sac_256",
    "sbx-sac-mujoco": "sbx:sac_mujoco",
    "sbx-crossq-mujoco": "sbx:crossq_mujoco",
    "learner-ppo": "learner:ppo",
    "learner-tqc": "learner:tqc",
    "memory": "memory:per_environment",
    "training": "training:whole_training",
    "policy-5cm": "training:policy_at_5_cm",
    "policy-2cm": "training:policy_at_2_cm",
    "time-to-95": "training:time_to_good",
}


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks", description=__doc__)
    parser.add_argument("rows", nargs="*", metavar="ROW", help=f"which to measure: {', '.join(ROWS)}; default: all")
    parser.add_argument("--repeat", type=int, default=3, metavar="N", help="rounds; a slow row takes N trainings")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows as JSON too")
    options = parser.parse_args()
    if unknown := [name for name in options.rows if name not in ROWS]:
        parser.error(f"no row {unknown[0]!r}; there are: {', '.join(ROWS)}")
    load = _load()
    rows = [_measured(name, options.repeat) for name in ROWS if name in options.rows or not options.rows]
    _show(rows, load)
    if options.json:
        options.json.write_text(json.dumps([dataclasses.asdict(row) for row in rows], indent=2) + "\n")
    return 0 if all(row.reached for row in rows) else 1


def _measured(name: str, repeat: int) -> Row:
    module, _, function = ROWS[name].partition(":")
    began = time.monotonic()
    try:
        row: Row = getattr(importlib.import_module(f"tests.benchmarks.{module}"), function)(repeat)
    except Exception as error:  # one that cannot be measured is missed; the others still count
        row = Row(name, "-", "-", "-", "-", False, f"not measured: {type(error).__name__}: {error}")
    result = "reached" if row.reached else "MISSED"
    print(f"{name}: {row.ratio} ({row.target}) {result}, {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
    return row


def _load() -> str:
    """Say what else was running when the measuring began."""
    load = os.getloadavg()[0]
    # Eight processes get more of a core that others want too than two do: a busy machine favours SubprocVecEnv.
    busy = ": BUSY, the speeds say little" if load > 0.7 else ""
    return f"{os.cpu_count()} cores, load {load:.1f} before{busy}"


def _show(rows: list[Row], load: str) -> None:
    table = Table("what", "rlctl", "against", "ratio", "to reach", "", title="Numbers to reach")
    for row in rows:
        mark = "[green]reached[/]" if row.reached else "[red]missed[/]"
        table.add_row(row.what, row.ours, row.theirs, row.ratio, row.target, mark)
    # As wide as it needs to be where there is no terminal.
    console = Console(width=None if sys.stdout.isatty() else 110)
    console.print(table)
    console.print(load)
    for row in rows:
        console.print(f"{row.what}: {row.note}", style="dim", highlight=False, markup=False)


if __name__ == "__main__":
    sys.exit(main())
