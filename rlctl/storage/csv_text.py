"""CSV as programs of other countries write it: columns by semicolons or tabs, and then commas in numbers."""

import csv
import math


class CsvReader:
    """Reads the lines of a file, whose header decides how columns are separated.

    With semicolons or tabs between columns `1,5` is 1.5. A file with both marks is refused: `1,234` may then be 1234.
    """

    def __init__(self, header: str) -> None:
        """`header` is the first line; what separates most columns in it separates them in all lines."""
        self.delimiter = max(",;\t", key=header.count)
        self._mark = ""  # the decimal mark of the first number that has one

    def split(self, line: str) -> list[str]:
        """Return the fields of a line; raises `csv.Error`."""
        return next(csv.reader([line], delimiter=self.delimiter), [])

    def read_number(self, text: str) -> float:
        """Return a number, NaN for text that is none, or that has another decimal mark than the numbers before it.

        `1_7`, which Python takes for 17, is no number in a file.
        """
        if "_" in text:
            return math.nan
        marks = [mark for mark in ".," if mark in text]
        if marks == [","] and self.delimiter == ",":  # in quotes: 1,234 may be 1234
            return math.nan
        if self._mark and marks and marks != [self._mark]:
            return math.nan
        try:
            number = float(text.replace(",", "."))
        except ValueError:
            return math.nan
        if marks:
            self._mark = marks[0]
        return number

    def explain_number(self, text: str) -> str:
        """Return why a text is no number where others are, as the end of an error; empty if unknown."""
        if self._mark and any(mark in text for mark in ".," if mark != self._mark):
            return f"; numbers before it have {self._mark!r} as decimal mark"
        return ""

    def explain_count(self, count: int, columns: int) -> str:
        """Return why a line has another number of values than columns, as the end of an error; empty if unknown."""
        if self.delimiter == "," and columns < count <= 2 * columns:
            return "; if commas are also in numbers, separate columns by semicolons"
        return ""
