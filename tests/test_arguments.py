"""Options of the command line from the fields of a request."""

import dataclasses
import inspect
from pathlib import Path
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from rlctl.arguments import command, command_in_panels
from rlctl.cli import COMMANDS, GROUPS, build_app
from rlctl.options import Argument, Option


@dataclasses.dataclass(frozen=True)
class Picking:
    item: Annotated[str, Argument("What to pick.", metavar="ITEM")]
    limits: dict = dataclasses.field(default_factory=dict)
    check: Annotated[bool, Option("Do not look first.", (" /--no-check",))] = True
    folder: Annotated[Path, Option("Where to.", ("--output", "-o"))] = Path("here")
    tries: Annotated[int, Option("How often.", min=1)] = 3
    names: Annotated[list[str], Option("Names.", ("--name",))] = dataclasses.field(default_factory=list)


@pytest.fixture
def app():
    """A command that prints the request that it gets, and an option of its own."""

    def pick(
        request: Picking,
        loud: Annotated[bool, Option("Print twice.", ("--loud",))] = False,
        polite: Annotated[bool, Option("Do not say please.", (" /--rude",))] = True,
    ) -> None:
        """Pick."""
        print(request, loud, polite)

    app = typer.Typer()
    app.command()(command(pick))
    return app


@pytest.mark.parametrize(
    ("arguments", "filled", "loud"),
    [
        (["cup"], Picking("cup"), False),
        (["cup", "--no-check", "-o", "there", "--loud"], Picking("cup", check=False, folder=Path("there")), True),
        (["--tries", "7", "cup", "--name", "a", "--name", "b"], Picking("cup", tries=7, names=["a", "b"]), False),
    ],
)
def test_the_command_line_fills_a_request(app, arguments, filled, loud):
    result = CliRunner().invoke(app, arguments)
    assert result.output == f"{filled} {loud} True\n"


def test_a_flag_turns_a_parameter_off(app):
    assert CliRunner().invoke(app, ["cup", "--rude"]).output.endswith("False False\n")


def test_what_a_field_does_not_take_and_help(app):
    assert "Invalid value for '--tries'" in CliRunner().invoke(app, ["cup", "--tries", "0"]).output
    shown = CliRunner().invoke(app, ["--help"], terminal_width=200).output
    assert "ITEM" in shown
    assert "How often." in shown
    assert "--no-check" in shown
    assert "--check" not in shown
    assert "limits" not in shown


def test_help_in_panels():
    @command_in_panels({"Options": ["tries"], "How": ["loud", "check"], "Output": ["folder"]})
    def pick(request: Picking, loud: Annotated[bool, Option("Print twice.", ("--loud",))] = False) -> None:
        """Pick."""
        print(request, loud)

    app = typer.Typer()
    app.command()(pick)
    shown = CliRunner().invoke(app, ["--help"], terminal_width=100).output
    order = [
        "Arguments",
        "What to pick.",
        "─ Options",
        "Names.",
        "How often.",
        "─ How",
        "--loud",
        "--no-check",
        "─ Output",
        "--output",
    ]
    places = [shown.index(text) for text in order]
    assert places == sorted(places)
    result = CliRunner().invoke(app, ["--loud", "cup", "--tries", "7"])
    assert result.output == f"{Picking('cup', tries=7)} True\n"


@pytest.mark.parametrize("name", ["train", "tune", "eval", "check-env", "gate"])
def test_every_option_is_in_a_panel(name):
    parameters = inspect.signature(COMMANDS[name]).parameters.values()
    panels = {
        parameter.name: parameter.annotation.__metadata__[0].rich_help_panel
        for parameter in parameters
        if not isinstance(parameter.annotation.__metadata__[1], Argument)
    }
    assert [name for name, panel in panels.items() if panel is None] == []
    assert next(iter(panels.values())) == "Options"
    assert len(set(panels.values())) >= 4


def test_help_shows_the_commands_in_groups():
    shown = CliRunner().invoke(build_app(), ["--help"]).output
    order = [
        *("─ Learn", "│ train ", "─ Judge", "│ eval ", "─ Show", "│ replay "),
        *("─ Robot", "│ export ", "│ serve ", "─ Tools", "│ tasks "),
    ]
    places = [shown.index(text) for text in order]
    assert places == sorted(places)
    assert len(COMMANDS) == sum(map(len, GROUPS.values()))
