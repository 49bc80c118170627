"""How much memory an environment takes beyond its PyBullet world."""

from __future__ import annotations

import json
import subprocess
import sys

from tests.benchmarks.row import Row

COUNT = 16
ENVIRONMENTS = f"""
import json, psutil, rlctl
first = rlctl.make("reach"); first.reset(seed=0)
before = psutil.Process().memory_full_info().uss
envs = [rlctl.make("reach") for _ in range({COUNT})]
for env in envs:
    env.reset(seed=0)
    for _ in range(50):
        env.step(env.action_space.sample())
print(json.dumps((psutil.Process().memory_full_info().uss - before) / {COUNT}))
"""
WORLDS = f"""
import json, psutil, pybullet
from rlctl.task.model_files import MODELS
def build():
    client = pybullet.connect(pybullet.DIRECT)
    pybullet.setAdditionalSearchPath(str(MODELS), physicsClientId=client)
    pybullet.loadURDF("plane.urdf", physicsClientId=client)
    pybullet.loadURDF("kuka_iiwa.urdf", useFixedBase=True, physicsClientId=client)
    pybullet.saveState(physicsClientId=client)
    for _ in range(200):
        pybullet.stepSimulation(physicsClientId=client)
build()
before = psutil.Process().memory_full_info().uss
for _ in range({COUNT}):
    build()
print(json.dumps((psutil.Process().memory_full_info().uss - before) / {COUNT}))
"""


def per_environment(repeat: int) -> Row:
    """Compare environments of reach with bare worlds of the same bodies, each of them the average of 16."""
    ours, bare = (_measure(code) / 2**20 for code in (ENVIRONMENTS, WORLDS))
    return Row(
        "memory per environment",
        f"{ours:.1f} MB",
        f"{bare:.1f} MB",
        f"{ours - bare:+.2f} MB",
        "<= +2 MB",
        ours - bare <= 2,
        f"unique memory of {COUNT} environments of reach in one process, against as many bare PyBullet worlds",
    )


def _measure(code: str) -> float:
    done = subprocess.run([sys.executable, "-c", code], check=True, text=True, stdout=subprocess.PIPE)
    return float(json.loads(done.stdout.splitlines()[-1]))
