"""Finds every command that rlctl prints as a hint, in the texts of its own source."""

import ast
import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
VALUE = "1"  # instead of what is filled in: it can be a name, a path and a number
PHRASE = re.compile(r"\brlctl [a-z](?:[^\n`;,)\"<.:]|[.:](?! ))*")
NAMED = re.compile(r"\brlctl\b(?!\.| import)")
"""Where code names the program, and not a module: files without it need not be parsed."""
FILLED_IN = re.compile(r"\{[^{}\n]*\}|\$\w+")  # in templates
PROSE = {"are", "cannot", "does", "error", "finds", "have", "installed", "itself", "makes", "policy"}
PROSE |= {"repeated", "counts", "changed", "loads", "raise", "reads", "seeds", "takes", "uses", "with", "wrote"}
"""What follows the name of the program where no command is meant. A misspelt verb is not among them."""


@dataclasses.dataclass(frozen=True)
class Printed:
    """A command and the text after it, up to a mark that ends the command."""

    file: Path
    line: int
    text: str

    def __str__(self) -> str:
        return f"{self.file.relative_to(ROOT)}:{self.line} {self.text}"

    @property
    def words(self) -> list[str]:
        """The words after `rlctl`."""
        return self.text.split()[1:]


def find_all() -> list[Printed]:
    """Return the commands in the texts of the package: code without docstrings and comments, YAML, pages, templates."""
    found = []
    for file in sorted([*(ROOT / "rlctl").rglob("*"), *(ROOT / "plugins/rlctl_robot").rglob("*")]):
        if file.suffix not in (".py", ".yaml", ".html", ".tmpl"):
            continue
        content = file.read_text(encoding="utf-8")
        if not NAMED.search(content):
            continue
        texts = _find_in_code(content) if file.suffix == ".py" else _find_in_lines(content)
        for line, text in texts:
            for match in PHRASE.finditer(text):
                printed = Printed(file, line, match[0].strip().rstrip(".:'"))
                if printed.words[0] not in PROSE:
                    found.append(printed)
    return found


def _find_in_lines(content: str) -> Iterator[tuple[int, str]]:
    for number, line in enumerate(content.splitlines(), start=1):
        yield number, FILLED_IN.sub(VALUE, line)


def _find_in_code(content: str) -> Iterator[tuple[int, str]]:
    tree = ast.parse(content)
    nodes = list(ast.walk(tree))
    documentation = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    parts = {id(part) for node in nodes if isinstance(node, ast.JoinedStr) for part in node.values}
    for node in nodes:
        if id(node) in documentation or id(node) in parts:
            continue
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.lineno, node.value
        elif isinstance(node, ast.JoinedStr):
            yield node.lineno, "".join(_show(part) for part in node.values)
        elif isinstance(node, ast.List) and node.elts and _show(node.elts[0]) == "rlctl":
            yield node.lineno, " ".join(_show(part) for part in node.elts if not isinstance(part, ast.Starred))


def _show(node: ast.expr) -> str:
    return str(node.value) if isinstance(node, ast.Constant) else VALUE
