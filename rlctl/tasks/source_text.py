"""Values as Python source, for the files of a starter plugin."""

from collections.abc import Iterable

LINE_WIDTH = 120


def write_number(number: float) -> str:
    """Return a number with four decimals at most."""
    return repr(round(float(number), 4))


def write_list(before: str, items: Iterable[str], after: str = "") -> str:
    """Return a list as code, an item per line where it does not fit behind `before`."""
    texts = list(items)
    line = f"[{', '.join(texts)}]"
    if len(before) + len(line) + len(after) <= LINE_WIDTH:
        return line
    indent = " " * (len(before) - len(before.lstrip()) + 4)
    return "[\n" + "".join(f"{indent}{text},\n" for text in texts) + indent[:-4] + "]"
