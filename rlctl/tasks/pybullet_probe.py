"""Finds out whether PyBullet reads a model file as MuJoCo does, in a process of its own: some files crash PyBullet."""

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

_TIMEOUT_S = 60.0
_SCRIPT = """
import json, sys
from rlctl.task.pybullet.sim import PybulletSim
body = PybulletSim(control_dt=0.1, substeps=1).load("arm", sys.argv[1], fixed=True)
print("joints " + json.dumps(body.joint_names))
"""


def reads_in_pybullet(model: Path, joints: Sequence[str]) -> bool:
    """Return whether PyBullet loads a model, with these joints in this order; True if PyBullet is not installed.

    It reads no defaults of MJCF, and another order of joints would be another robot.
    """
    from rlctl.task.pybullet.library import is_installed

    if model.suffix != ".urdf":
        return False
    if not is_installed():
        return True
    command = [sys.executable, "-c", _SCRIPT, str(model.absolute())]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False)
    except subprocess.TimeoutExpired:
        return False
    return f"joints {json.dumps(list(joints))}" in done.stdout.splitlines()
