"""Every command that rlctl prints as a hint can be typed as it is printed."""

import shlex

import pytest

from tests.cli.printed_commands import ROOT, VALUE, Printed, find_all
from tests.test_docs import parse

CHEAP = [
    "rlctl check-env --explain RL001",
    "rlctl check-env --list",
    "rlctl recipe reach",
    "rlctl runs",
    "rlctl tasks",
]


def check(printed: Printed) -> None:
    """Raise for a command line that rlctl refuses; words after a complete command are the rest of the sentence."""
    words = printed.words
    if words[-1].startswith("-"):
        words = [*words, VALUE]  # a text may name an option alone
    options = [number for number, word in enumerate(words, start=1) if word.startswith("-")]
    shortest = max(options, default=1)
    error: Exception | None = None
    for end in range(len(words), shortest - 1, -1):
        try:
            parse(words[:end])
        except Exception as refused:
            error = refused
            if end == shortest and "Missing parameter" in str(refused):  # a text may name a command alone
                return
        else:
            return
    raise AssertionError(f"{printed}: {error!r}")


@pytest.fixture(scope="module")
def found():
    """The printed commands. No parameters of a test: every process that collects tests would look for them."""
    return find_all()


def test_every_printed_command_is_one(found):
    refused = []
    for printed in found:
        try:
            check(printed)
        except AssertionError as error:
            refused.append(str(error))
    assert refused == []


def test_all_kinds_of_texts_are_searched(found):
    files = {printed.file.suffix for printed in found}
    assert files == {".py", ".yaml", ".html", ".tmpl"}
    assert len(found) > 80


@pytest.mark.parametrize(
    "text", ["rlctl evl latest", "rlctl eval latest --simm mujoco", "rlctl eval latest --episodes x"]
)
def test_a_wrong_command_would_be_noticed(text):
    with pytest.raises(AssertionError):
        check(Printed(ROOT / "README.md", 1, text))


@pytest.mark.slow_except("rlctl recipe reach", "rlctl check-env --list")
@pytest.mark.parametrize("command", CHEAP)
def test_cheap_ones_run(command, found, rlctl):
    assert any(printed.text.startswith(command) for printed in found)
    done = rlctl(*shlex.split(command)[1:])
    assert done.returncode == 0, done.stderr
    assert done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("words", [("tasks", "show", VALUE), ("replay", VALUE, "--policy", "zero")], ids=" ".join)
def test_what_is_printed_for_a_task_runs(words, found, rlctl):
    assert any(tuple(printed.words[: len(words)]) == words for printed in found)
    done = rlctl(*("reach" if word == VALUE else word for word in words))
    assert done.returncode == 0, done.stderr
