"""No file and nothing from a network is unpickled, neither good files nor hostile ones: Python's audit events show it.

What is unpickled are messages between rlctl's own processes, by one reader that knows plain data only
(`rlctl/processes/messages.py`; `tests/processes/test_messages.py` shows what it refuses).
"""

import json
import pickle
import sys

import pytest

from tests import fork_server
from tests.test_layers import ROOT, files, imports
from tests.training.conftest import ENVS

WATCHED = """
import json, sys

events, messages = [], set()

def hook(event, arguments):
    if event == "pickle.find_class" and sys._getframe(1).f_globals["__name__"] == "rlctl.processes.messages":
        messages.add(arguments[0])
    elif event in ("pickle.find_class", "os.system"):
        events.append([event, *map(str, arguments)])

from rlctl.cli import run
sys.addaudithook(hook)  # can never be removed: a process of its own
codes = [run(arguments) for arguments in json.loads(sys.argv[1])]
print("@" + json.dumps([codes, events, sorted(messages)]), file=sys.stderr)
"""


def watched(folder, *commands):
    """Run commands in one process; return their exit codes and what was looked up for pickles.

    That is every class that anything but the reader of messages looked up, and the modules of those it looked up.
    """
    words = json.dumps([[str(word) for word in command] for command in commands])
    done = fork_server.for_commands().run([sys.executable, "-c", WATCHED, words], cwd=folder, timeout=240)
    printed = [line for line in done.stderr.splitlines() if line.startswith("@")]
    assert printed, done.stderr
    return json.loads(printed[-1][1:])


@pytest.mark.slow
def test_the_life_of_a_run(tmp_path):
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(
        "algo: sac\nn_envs: 2\neval: {episodes: 2, every_steps: 64}\nalgo_kwargs: {learning_starts: 16}\n"
        "policy_kwargs: {net_arch: [16]}\n"
    )
    codes, events, modules = watched(
        tmp_path,
        ["train", f"{ENVS}:Line", "--config", recipe, "-n", "64", "--no-check"],
        ["train", "--resume", "latest", "-n", "96"],
        ["eval", "latest", "--episodes", "2", "--n-envs", "1"],
        ["export", "latest", "--onnx"],
        ["eval", "runs/latest/exports/policy.onnx", "--episodes", "2", "--n-envs", "1"],
        ["replay", "latest"],
        ["replay", "--verify", "runs/latest/episodes/000000.npz"],
    )
    assert codes == [0] * 7
    assert events == []
    assert modules == ["rlctl.environments.info", "rlctl.play.messages"]


class Bait:
    def __reduce__(self):
        import os

        return (os.system, ("touch sprung",))


def test_files_that_are_pickles(tmp_path):
    import numpy as np
    import torch

    for suffix in ("safetensors", "onnx", "npz"):
        (tmp_path / f"plain.{suffix}").write_bytes(pickle.dumps(Bait()))
        torch.save(Bait(), tmp_path / f"torch.{suffix}")
    np.savez(tmp_path / "array.npz", info=np.array([Bait()], dtype=object))
    commands = [["eval", f"{name}.{suffix}"] for name in ("plain", "torch") for suffix in ("safetensors", "onnx")]
    commands += [["export", f"{name}.safetensors", "--onnx"] for name in ("plain", "torch")]
    commands += [["replay", "--verify", f"{name}.npz"] for name in ("plain", "torch", "array")]
    # A task's own code may unpickle what it likes; it is here to see that the watch sees it.
    probe = f"import json, pickle\npickle.loads({pickle.dumps(json.JSONDecoder)!r})\n"
    (tmp_path / "probe.py").write_text(probe)
    codes, events, _ = watched(tmp_path, *commands, ["train", "probe.py:Env"])
    assert codes == [5] * len(commands) + [2]
    assert [event[:3] for event in events] == [["pickle.find_class", "json.decoder", "JSONDecoder"]]
    assert not (tmp_path / "sprung").exists()


def test_one_module_reads_pickles_and_four_use_it():
    """Rooms that read files or listen to a network do not reach the reader of messages."""
    users: dict[str, set[str]] = {}
    for file in files("rlctl"):
        for name in imports(file):
            module = "rlctl.processes.messages" if name.startswith("rlctl.processes.messages") else name.split(".")[0]
            users.setdefault(module, set()).add(str(file.relative_to(ROOT / "rlctl")))
    for library in ("pickle", "cloudpickle", "dill", "joblib", "marshal", "shelve"):
        assert users.get(library, set()) <= {"processes/messages.py"}, library
    expected = {"checking/child.py", "processes/child_process.py", "processes/pool.py", "launching/child.py"}
    assert users["rlctl.processes.messages"] == expected
