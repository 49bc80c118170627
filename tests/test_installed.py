"""Installed plugins: listed without being imported, and a broken one harms no other."""

import json
import os
import subprocess
import sys

import pytest

from rlctl.entry_points import find_module_file
from rlctl.environments import installed
from rlctl.tasks.listing import describe_entry

GOOD = """
    import gymnasium, numpy as np
    from gymnasium.spaces import Box
    print("hello from a plugin")

    class Good(gymnasium.Env):
        observation_space, action_space = Box(-1, 1, (2,)), Box(-1, 1, (1,))
        def reset(self, *, seed=None, options=None): return np.zeros(2, np.float32), {}
        def step(self, action): return np.zeros(2, np.float32), 0.0, False, True, {}
"""


@pytest.fixture
def site(install):
    """A distribution with a good task, and many that are not."""
    folder = install(
        "some-robots",
        {
            "good": "some_robots.good:Good",
            "raises": "some_robots.raises:Task",
            "leaves": "some_robots.leaves:Task",
            "vanishes": "some_robots.vanishes:Task",
            "absent": "some_robots.absent:Task",
            "nameless": "some_robots.good:Bad",
            "unreadable": "some_robots.unreadable:Task",
            "reach": "some_robots.good:Good",
        },
        {
            "some_robots/__init__.py": "raise RuntimeError('imported by a listing')",
            "some_robots/good.py": GOOD,
            "some_robots/good.yaml": "algo: sac\n",
            "some_robots/raises.py": "\nraise RuntimeError('boom\\nand more')",
            "some_robots/raises.yaml": "algo: [\n",
            "some_robots/leaves.py": "raise SystemExit(0)",
            "some_robots/vanishes.py": "import os; os.kill(os.getpid(), 9)",
            "some_robots/unreadable.py": "",
        },
    )
    (folder / "some_robots/unreadable.yaml").write_bytes(b"\xff\xfe")
    return folder


@pytest.fixture
def importable(site):
    (site / "some_robots" / "__init__.py").write_text("")
    return site


def listed(result):
    assert result.returncode == 0, result.stderr
    return {(task["name"], task["distribution"]): task for task in json.loads(result.stdout)["tasks"]}


@pytest.mark.slow
def test_a_listing_imports_no_plugin(rlctl, site):
    tasks = listed(rlctl("tasks", "--json", "-", path=site))
    assert tasks["good", "some-robots"] == {
        "name": "good",
        "target": "some_robots.good:Good",
        "distribution": "some-robots",
        "version": "1.2",
        "algo": "sac",
        "problem": None,
        "summary": "",
        "success": None,
        "mean_return": None,
    }
    assert tasks["absent", "some-robots"]["problem"] == "module 'some_robots.absent' is missing"
    # The bundled one wins; the other is reachable by its place.
    assert tasks["reach", "rlctl"]["problem"] is None
    assert tasks["reach", "some-robots"]["problem"] == "name taken by rlctl; use some_robots.good:Good"


def test_the_table(rlctl, site):
    result = rlctl("tasks", path=site)
    assert result.stderr == ""
    header, *rows = result.stdout.splitlines()
    assert header.split() == ["task", "success", "return", "algorithm", "origin", "what", "it", "does"]
    assert len(rows) >= 9  # long problems go over several lines
    (row,) = [row for row in rows if row.startswith("good")]
    assert row.split() == ["good", "sac", "some-robots", "1.2"]


@pytest.mark.slow
def test_check_shows_what_raises_in_a_line_each(importable, monkeypatch):
    monkeypatch.syspath_prepend(importable)
    monkeypatch.setenv("PYTHONPATH", str(importable))
    entries = [entry for entry in installed.list_installed() if entry.distribution == "some-robots"]
    problems = {entry.name: describe_entry(entry, check=True).problem for entry in entries}
    del problems["reach"]  # as without a check
    assert problems.pop("raises").startswith(f"{importable / 'some_robots/raises.yaml'}:2: expected the node content")
    assert problems.pop("unreadable").startswith(f"{importable / 'some_robots/unreadable.yaml'}: 'utf-8' codec can't")
    assert problems == {
        "good": None,
        "leaves": "task 'some_robots.leaves:Task': import failed: SystemExit: 0 (some_robots/leaves.py:1)",
        "vanishes": "import ended the process with exit code -9",
        "absent": "module 'some_robots.absent' is missing",
        "nameless": "some_robots.good has no 'Bad'. It defines: Good.",
    }


@pytest.mark.slow
def test_the_check_of_all_tasks(rlctl, importable):
    tasks = listed(rlctl("tasks", "--check", "--json", "-", path=importable))
    assert tasks["vanishes", "some-robots"]["problem"] == "import ended the process with exit code -9"
    assert [name for (name, origin), task in tasks.items() if origin == "rlctl" and task["problem"]] == []


@pytest.mark.slow
def test_a_broken_plugin_harms_only_itself(rlctl, importable, tmp_path):
    (importable / "some_robots" / "raises.yaml").unlink()
    code = (
        "import rlctl; from rlctl.environments import registry\n"
        "from rlctl.errors import RlctlError\n"
        "for name in ('raises', 'leaves', 'absent', 'good', 'reach'):\n"
        "    try: print(name, type(rlctl.make(name).unwrapped).__name__)\n"
        "    except RlctlError as error: print(name, type(error).__name__, str(error).splitlines()[0])\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(importable)},
    )
    assert result.stdout.splitlines() == [
        "raises TaskError task 'raises': import failed: RuntimeError: boom and more (some_robots/raises.py:2)",
        "leaves TaskError task 'leaves': import failed: SystemExit: 0 (some_robots/leaves.py:1)",
        "absent TaskError task 'absent' of some-robots 1.2: module 'some_robots.absent' is missing",
        "hello from a plugin",
        "good Good",
        "reach TaskEnv",
    ], result.stderr


@pytest.mark.slow
def test_metadata_that_is_half_there(rlctl, install):
    site = install("half", {"half": "half_there:Task"})
    (site / "half-1.2.dist-info" / "METADATA").unlink()
    tasks = listed(rlctl("tasks", "--json", "-", path=site))
    assert tasks["half", "?"]["version"] == "?"


@pytest.mark.slow
def test_a_checkout_beside_its_installation_is_one(rlctl, install, tmp_path):
    site = install("twice", {"twice": "twice_there:Task"}, {"twice_there.py": ""})
    install("twice", {"twice": "twice_there:Task"}, version="1.3")
    tasks = listed(rlctl("tasks", "--json", "-", path=site))
    assert [task["problem"] for (name, _), task in tasks.items() if name == "twice"] == [None]


def test_a_module_is_found_below_a_folder_without_init(tmp_path, monkeypatch):
    folder = tmp_path / "robots_below" / "envs" / "arms"
    folder.mkdir(parents=True)
    for package in ("robots_below", "robots_below/envs"):
        (tmp_path / package / "__init__.py").touch()
    (folder / "reach.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    assert find_module_file("robots_below.envs.arms.reach") == folder / "reach.py"
    assert find_module_file("robots_below.envs.legs.walk") is None
