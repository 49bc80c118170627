"""How long a policy takes to choose one action."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import rlctl
from rlctl.policy.file import PolicyFile
from tests.benchmarks.row import Row, side_by_side
from tests.benchmarks.shipped import rlctl_command, short_run

CALLS = 300  # in a round


def onnx_runtime(repeat: int) -> Row:
    """Count calls for one observation; SB3's is `policy.predict` after the normalisation it was trained with."""
    run = short_run()
    onnx_file = run / "exports" / "policy.onnx"
    rlctl_command("export", str(run), "--onnx")
    sb3: Any = _torch_policy(run)
    exported: Any = rlctl.load_policy(onnx_file)
    env = rlctl.make("reach")
    observation, _ = env.reset(seed=0)
    env.close()
    batch = {"obs": observation[None]}

    def theirs() -> float:
        return _seconds(lambda: sb3.network.predict(sb3.normalize(observation), deterministic=True))

    bare = side_by_side(lambda: _seconds(lambda: exported.actor.session.run(["action"], batch)), theirs, 3 * repeat)
    pair = side_by_side(lambda: _seconds(lambda: exported.predict(observation)), theirs, 3 * repeat)
    faster = 1 / pair.ratio
    return Row(
        "ONNX Runtime, one observation",
        f"{pair.ours * 1e6:.1f} us",
        f"{pair.theirs * 1e6:.0f} us",
        f"{faster:.1f}x",
        ">= 8x",
        faster >= 8,
        f"rlctl.load_policy(onnx).predict; onnxruntime's own session.run alone: {1 / bare.ratio:.1f}x",
    )


def c_function(repeat: int) -> Row:
    """Time C for one observation, called through ctypes, beside onnxruntime's own `session.run`; both from Python."""
    from rlctl.exporting.c_source import build_library, find_compiler, write_c
    from rlctl.policy.c_policy import CActor
    from rlctl.policy.policy import Policy

    run = short_run()
    rlctl_command("export", str(run), "--onnx")
    exported: Any = rlctl.load_policy(run / "exports" / "policy.onnx")
    policy = PolicyFile.read(run / "policies" / "best.safetensors")
    info = policy.info
    compiler = find_compiler()
    assert compiler is not None, "no C compiler"
    code = write_c(policy, "policy")
    with tempfile.TemporaryDirectory() as folder:
        actor = CActor.load(build_library(code, info, Path(folder), compiler))
        policy = Policy(actor)
    observation = np.zeros(exported.observation_space.shape, np.float32)
    batch = {"obs": observation[None]}

    def theirs() -> float:
        return _seconds(lambda: exported.actor.session.run(["action"], batch))

    pair = side_by_side(lambda: _seconds(lambda: policy.predict(observation)), theirs, 3 * repeat)
    alone = side_by_side(lambda: _seconds(lambda: actor.repeat(observation, 10)) / 10, theirs, 3 * repeat)
    faster = 1 / alone.ratio
    return Row(
        "C, one observation",
        f"{alone.ours * 1e6:.1f} us",
        f"{pair.theirs * 1e6:.1f} us",
        f"{faster:.1f}x",
        ">= 2x",
        faster >= 2,
        f"the C function alone beside onnxruntime's session.run; called from Python as a policy: {1 / pair.ratio:.1f}x",
    )


def _torch_policy(run: Path) -> Any:
    from rlctl.policy.torch_policy import TorchActor, pin_threads

    # The best case for so small a network.
    pin_threads()
    return TorchActor.load(run / "policies" / "best.safetensors")


def _seconds(call: Callable[[], object]) -> float:
    """Return the median of many calls."""
    times = []
    for _ in range(CALLS):
        began = time.perf_counter()
        call()
        times.append(time.perf_counter() - began)
    return float(np.median(times))
