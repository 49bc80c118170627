"""Commands that other packages add: listed without an import, called like rlctl's own; a broken one harms no other."""

import json
import re
import subprocess
import sys

import pytest

from rlctl.cli import plugin_commands
from rlctl.entry_points import find_module_file

GREET = '''
    """Commands of a robot."""
    import typer
    print("imported")

    def greet(name: str, loud: bool = False) -> None:
        """Greet a robot."""
        print(f"hello {name}" + "!" * loud)

    def fails() -> None:
        """Fail."""
        raise ValueError("no battery")

    arm = typer.Typer()

    @arm.command()
    def wave() -> None:
        print("waving")

    @arm.command()
    def rest() -> None:
        print("resting")
'''


@pytest.fixture
def site(install):
    """A distribution with three commands that work, and several that do not."""
    points = {
        "greet": "my_robot.greet:greet",
        "fails": "my_robot.greet:fails",
        "arm": "my_robot.greet:arm",
        "raises": "my_robot.raises:command",
        "nameless": "my_robot.greet:nobody",
        "absent": "my_robot.absent:command",
        "train": "my_robot.greet:greet",
        "serve": "my_robot.greet:greet",
        "unclear": "my_robot",
    }
    files = {"my_robot/__init__.py": "", "my_robot/greet.py": GREET, "my_robot/raises.py": "raise ImportError('boom')"}
    return install("a-robot", points, files, group="rlctl.commands")


def test_the_help_lists_what_can_be_called_and_imports_nothing(rlctl, site):
    result = rlctl("--help", path=site)
    assert result.returncode == 0, result.stderr
    text = result.stdout
    assert "imported" not in text
    assert text.index("─ Robot ") < text.index("─ Commands of a-robot ")
    assert "greet" in text.partition("Commands of a-robot")[2]
    assert "Greet a robot." in text
    assert "Commands of a robot." in text  # of the module, for an app
    for name in ("absent", "unclear"):
        assert re.search(rf"^│ {name} ", text, re.MULTILINE) is None
    assert len(re.findall(r"^│ (?:train|serve) ", text, re.MULTILINE)) == 2


def test_a_command_is_called(rlctl, site):
    result = rlctl("greet", "Ant", "--loud", path=site)
    assert (result.returncode, result.stdout) == (0, "imported\nhello Ant!\n"), result.stderr
    assert rlctl("arm", "wave", path=site).stdout == "imported\nwaving\n"
    assert "--loud" in rlctl("greet", "--help", path=site).stdout
    assert rlctl("greet", path=site).returncode == 2  # of Typer: NAME is missing


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("raises", "command 'raises' of a-robot 1.2: import failed: ImportError: boom (raises.py, line 1)"),
        ("fails", "command 'fails' of a-robot 1.2: ValueError: no battery (greet.py, line 12)"),
        ("absent", "command 'absent' of a-robot 1.2: module 'my_robot.absent' is missing"),
        ("unclear", "command 'unclear' of a-robot 1.2: its target 'my_robot' is not package.module:function"),
    ],
)
def test_a_broken_command_is_explained_in_a_line(rlctl, site, name, message):
    result = rlctl(name, path=site)
    assert result.returncode == 3
    assert result.stderr.splitlines()[-1] == f"error: {message}"
    assert "rlctl/cli" not in result.stderr


@pytest.mark.slow
def test_the_names_of_rlctl_stay_its_own(rlctl, site):
    assert "my_robot" not in rlctl("train", "--help", path=site).stdout
    assert "--max-clients" in rlctl("serve", "--help", path=site).stdout
    result = rlctl("tasks", path=site)
    assert result.returncode == 0
    lines = [line for line in result.stdout.splitlines() if line.startswith("command ")]
    assert lines == [
        "command absent of a-robot 1.2: module 'my_robot.absent' is missing",
        "command serve of a-robot 1.2: name taken by rlctl",
        "command train of a-robot 1.2: name taken by rlctl",
        "command unclear of a-robot 1.2: its target 'my_robot' is not package.module:function",
    ]


@pytest.mark.slow
def test_the_check_imports_each(site, monkeypatch):
    monkeypatch.syspath_prepend(site)
    monkeypatch.setenv("PYTHONPATH", str(site))
    entries = [entry for entry in plugin_commands.list_commands() if entry.distribution == "a-robot"]
    monkeypatch.setattr(plugin_commands, "list_commands", lambda: entries)
    problems = {listed.name: listed.problem for listed in plugin_commands.describe_all(check=True)}
    assert problems["greet"] is None
    assert problems["raises"].startswith("my_robot.raises:command: import failed: ImportError: boom")
    assert "has no attribute 'nobody'" in problems["nameless"]


def complete(words, site, tmp_path):
    code = "import sys; sys.argv[0] = 'rlctl'; from rlctl.cli import main; main()"
    asked = {"_RLCTL_COMPLETE": "complete_bash", "COMP_WORDS": " ".join(words), "COMP_CWORD": str(len(words) - 1)}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, env=with_path(site, asked)
    )
    return done.stdout.split(), done.stderr


def with_path(site, more):
    import os

    return {**os.environ, **more, "PYTHONPATH": os.pathsep.join([str(site), os.environ.get("PYTHONPATH", "")])}


@pytest.mark.slow
def test_the_shell_completes_names_and_options(site, tmp_path):
    assert complete(["rlctl", "gre"], site, tmp_path) == (["greet"], "")
    assert complete(["rlctl", "greet", "--lo"], site, tmp_path) == (["imported", "--loud"], "")
    assert complete(["rlctl", "raises", "--"], site, tmp_path)[1] == ""
    assert complete(["rlctl", "serve", "--max-c"], site, tmp_path) == (["--max-clients"], "")


def test_the_commands_that_come_with_rlctl():
    entries = [entry for entry in plugin_commands.list_commands() if entry.is_ours]
    assert {entry.name for entry in entries} == {"diagnose", "identify", "play", "robot", "serve"}
    for entry in entries:
        assert entry.problem is None
        assert entry.summary.endswith(".")
        assert find_module_file(entry.module).name == "command.py"


@pytest.mark.slow
def test_tasks_as_json_has_the_commands(rlctl, site):
    commands = json.loads(rlctl("tasks", "--json", "-", path=site).stdout)["commands"]
    greet = next(command for command in commands if command["name"] == "greet")
    assert greet == {
        "name": "greet",
        "target": "my_robot.greet:greet",
        "distribution": "a-robot",
        "version": "1.2",
        "summary": "Greet a robot.",
        "problem": None,
    }
