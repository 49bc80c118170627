"""The table of installed tasks, and installed distributions that are broken."""

import json

import pytest

from rlctl import output
from rlctl.environments import installed
from rlctl.tasks.listing import list_tasks
from rlctl.version import __version__


def list_by_name(rlctl, site):
    done = rlctl("tasks", "--json", "-", path=site)
    assert done.returncode == 0, done.stderr
    return {task["name"]: task for task in json.loads(done.stdout)["tasks"]}


def test_a_row_says_what_a_task_does_and_how_well():
    (reach,) = [task for task in list_tasks() if task.name == "reach"]
    assert (reach.distribution, reach.version, reach.algo) == ("rlctl", __version__, "ppo")
    assert reach.summary.startswith("Bring the hand within `tolerance` of the goal")
    assert reach.success > 0.9
    assert 50 < reach.mean_return < 200


def test_every_bundled_task_has_a_summary():
    assert [task.name for task in list_tasks() if task.distribution == "rlctl" and not task.summary] == []


BROKEN = {
    "no_equals_sign": (b"[rlctl.tasks]\nlonely\n", "its entry-point line is not NAME = package.module:Class"),
    "not_utf8": (b"[rlctl.tasks]\nlatin = caf\xe9:Task\n", "its entry_points.txt is not UTF-8"),
    "slash": (b"[rlctl.tasks]\na/b = json:JSONDecoder\n", "a task's name has 1 to 100 letters, digits, _, - and ."),
    "long": (b"[rlctl.tasks]\n" + b"n" * 300 + b" = json:JSONDecoder\n", "a task's name has 1 to 100 letters"),
    "target": (b"[rlctl.tasks]\nodd = ../evil:Env\n", "its target '../evil:Env' is not package.module:Class"),
    "header": (b"[rlctl.tasks\nodd = json\n", "its target 'json' is not package.module:Class"),
    "gone": (b"[rlctl.tasks]\nodd = no_such_module:Env\n", "module 'no_such_module' is missing"),
    "empty_name": (b"[rlctl.tasks]\n = json:JSONDecoder\n", "a task's name has 1 to 100 letters"),
}


@pytest.mark.slow_except(first=1)
@pytest.mark.parametrize("kind", BROKEN)
def test_a_broken_distribution_is_one_broken_row(rlctl, install, kind):
    points, problem = BROKEN[kind]
    site = install("robots", {})
    (site / "robots-1.2.dist-info" / "entry_points.txt").write_bytes(points)
    tasks = list_by_name(rlctl, site)
    (broken,) = [task for task in tasks.values() if task["distribution"] == "robots"]
    assert broken["problem"].startswith(problem)
    assert tasks["reach"]["problem"] is None
    shown = rlctl("tasks", "show", "reach", path=site)
    assert (shown.returncode, shown.stderr) == (0, "")


@pytest.mark.slow_except(first=1)
@pytest.mark.parametrize("metadata", [None, b"Name: caf\xe9\n", b"nothing"])
def test_damaged_metadata(rlctl, install, metadata):
    site = install("robots", {"robot": "json:JSONDecoder"})
    file = site / "robots-1.2.dist-info" / "METADATA"
    file.unlink() if metadata is None else file.write_bytes(metadata)
    tasks = list_by_name(rlctl, site)
    assert tasks["robot"]["distribution"] == "?"
    assert tasks["reach"]["problem"] is None


@pytest.mark.slow
def test_a_broken_line_does_not_take_a_name(rlctl, install):
    site = install("arobots", {"arm": "not a target"})
    site = install("brobots", {"arm": "json:JSONDecoder"}) if not site.exists() else site
    other = site / "brobots-1.dist-info"
    other.mkdir()
    (other / "METADATA").write_text("Name: brobots\nVersion: 1\n")
    (other / "entry_points.txt").write_text("[rlctl.tasks]\narm = json:JSONDecoder\n")
    rows = json.loads(rlctl("tasks", "--json", "-", path=site).stdout)["tasks"]
    assert [(row["distribution"], row["problem"] is None) for row in rows if row["name"] == "arm"] == [
        ("brobots", True),
        ("arobots", False),
    ]


@pytest.mark.slow
def test_a_damaged_policy_has_no_score(rlctl, install):
    files = {"robots.py": 'class Env:\n    """Pick up a ball.\n\n    More."""\n', "policies/arm.safetensors": "damaged"}
    tasks = list_by_name(rlctl, install("robots", {"arm": "robots:Env"}, files))
    assert (tasks["arm"]["summary"], tasks["arm"]["success"]) == ("Pick up a ball.", None)


def test_columns_are_dropped_where_a_table_is_too_wide(monkeypatch, capsys):
    from rich.console import Console

    def print_at(width):
        monkeypatch.setattr(output, "out", lambda: Console(width=width, markup=False))
        rows = [("reach", "rlctl 0.1.0", "ppo", "Bring the hand to the goal")]
        output.print_table(["task", "origin", "algo", "what"], rows, left=("task", "what"), drop=("origin", "algo"))
        return capsys.readouterr().out.splitlines()

    assert print_at(80)[1] == "reach  rlctl 0.1.0   ppo  Bring the hand to the goal"
    assert print_at(40)[1] == "reach   ppo  Bring the hand to the goal"
    assert print_at(34)[1] == "reach  Bring the hand to the goal"
    assert [line.rstrip() for line in print_at(24)] == [
        "task   what",
        "reach  Bring the hand to",
        "       the goal",
    ]


def test_nothing_is_imported_to_list(install, rlctl, tmp_path):
    mark = tmp_path / "imported"
    site = install("robots", {"arm": "robots:Env"}, {"robots.py": f"open({str(mark)!r}, 'w')\nclass Env: pass\n"})
    assert list_by_name(rlctl, site)["arm"]["problem"] is None
    assert not mark.exists()
    assert installed.find("robots:Env") is None
