"""Values as source text, for the files of a starter plugin: names of foreign files never become code.

A template's placeholder gets a `SourceText` as it is, and any other text as the language of its file quotes it.
"""

import math
import re
import string
import textwrap
from collections.abc import Callable, Iterable, Mapping

LINE_WIDTH = 120
_MARKDOWN = re.compile(r"[\\`*\[\]<>|&~!$]|(?<!\w)_|_(?!\w)")


class SourceText(str):
    """Text that is code already, with its names quoted."""

    __slots__ = ()


def quote_text(text: str) -> str:
    """Return a text as it stands between double quotes, in a docstring or in a comment of Python, YAML and TOML.

    The escapes of these three are the same as far as this uses them: `\\uXXXX` and `\\UXXXXXXXX` for what cannot be
    printed, such as the end of a line.
    """
    return "".join(map(_quote_character, text))


def _quote_character(character: str) -> str:
    if character in '"\\':
        return f"\\{character}"
    if character.isprintable():
        return character
    number = ord(character)
    return f"\\u{number:04x}" if number <= 0xFFFF else f"\\U{number:08x}"


def quote_markdown(text: str) -> str:
    """Return a text as it stands in a line or in the cell of a table of Markdown, outside code."""
    return _MARKDOWN.sub(r"\\\g<0>", _print_in_line(text))


def quote_code_of_markdown(text: str) -> SourceText:
    """Return a text as code in a line or in the cell of a table of Markdown."""
    text = _print_in_line(text).replace("|", "\\|")
    fence = "`" * (1 + max(map(len, re.findall("`+", text)), default=0))
    space = " " if "`" in (text[:1], text[-1:]) else ""
    return SourceText(f"{fence}{space}{text}{space}{fence}")


def _print_in_line(text: str) -> str:
    return "".join(character if character.isprintable() else "\N{REPLACEMENT CHARACTER}" for character in text)


QUOTES: Mapping[str, Callable[[str], str]] = {
    ".py": quote_text,
    ".yaml": quote_text,
    ".toml": quote_text,
    ".md": quote_markdown,
}
"""How a text is quoted, by the suffix of the file."""


def fill_template(template: str, values: Mapping[str, str], suffix: str) -> str:
    """Return a template of a file of that `suffix` with its placeholders replaced."""
    quote = QUOTES[suffix]
    quoted = {name: value if isinstance(value, SourceText) else quote(value) for name, value in values.items()}
    return string.Template(template).substitute(quoted)


def write_string(text: str) -> SourceText:
    """Return a text as a string of Python."""
    return SourceText(f'"{quote_text(text)}"')


def write_number(number: float, form: str = "") -> SourceText:
    """Return a number as code of Python, in a format such as `.3g`, by default with four decimals at most."""
    number = float(number)
    if math.isnan(number):
        return SourceText("np.nan")
    if math.isinf(number):
        return SourceText("np.inf" if number > 0 else "-np.inf")
    return SourceText(format(number, form) if form else repr(round(number, 4)))


def write_list(before: str, items: Iterable[SourceText], after: str = "") -> SourceText:
    """Return a list as code of Python, an item per line where it does not fit behind `before`."""
    texts = list(items)
    line = f"[{', '.join(texts)}]"
    if len(before) + len(line) + len(after) <= LINE_WIDTH:
        return SourceText(line)
    indent = " " * (len(before) - len(before.lstrip()) + 4)
    return SourceText("[\n" + "".join(f"{indent}{text},\n" for text in texts) + indent[:-4] + "]")


def join_source(items: Iterable[SourceText]) -> SourceText:
    """Return code of Python with commas between the items."""
    return SourceText(", ".join(items))


def write_comment(text: str) -> SourceText:
    """Return a text as comment lines of Python."""
    return SourceText(textwrap.fill(quote_text(text), LINE_WIDTH, initial_indent="# ", subsequent_indent="# "))
