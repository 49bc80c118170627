"""Units of angles: what names and comments say of them, and the factors that convert one into the other."""

import ast
import dataclasses
import enum
import re
from collections.abc import Sequence

from rlctl.checking.term_names import split_name


class Unit(enum.Enum):
    """What an expression is in."""

    NUMBER = "a number"  # of no unit: it fits to each
    DEGREES = "degrees"
    RADIANS = "radians"
    TO_DEGREES = "degrees per radian"
    TO_RADIANS = "radians per degree"
    PER_DEGREE = "something per degree"
    PER_RADIAN = "something per radian"


@dataclasses.dataclass(frozen=True)
class Angle:
    """The unit of an expression."""

    unit: Unit
    why: str = ""  # what shows it
    is_weighted: bool = False  # a number of the source is a factor, or a part is unknown: it may be a part of any sum

    @property
    def is_factor(self) -> bool:
        """Whether it converts angles."""
        return self.unit in TARGETS


CONSTANT = Angle(Unit.NUMBER, is_weighted=True)
NUMBER = Angle(Unit.NUMBER)
TARGETS = {Unit.TO_DEGREES: Unit.DEGREES, Unit.TO_RADIANS: Unit.RADIANS}
INVERSE = {Unit.TO_DEGREES: Unit.TO_RADIANS, Unit.TO_RADIANS: Unit.TO_DEGREES}
CONVERTED = {
    (Unit.RADIANS, Unit.TO_DEGREES): Unit.DEGREES,
    (Unit.DEGREES, Unit.TO_RADIANS): Unit.RADIANS,
    (Unit.PER_RADIAN, Unit.TO_RADIANS): Unit.PER_DEGREE,
    (Unit.PER_DEGREE, Unit.TO_DEGREES): Unit.PER_RADIAN,
}
DEGREE_WORDS = {"deg", "degs", "degree", "degrees"}
RADIAN_WORDS = {"rad", "rads", "radian", "radians"}
OTHER_WORDS = {"freedom", "dof", "poly", "polynomial", "n", "num", "number", "in", "is", "use", "node", "has"}
"""Words next to which these say nothing of a unit."""
IN_DEGREES, IN_RADIANS = "|".join(sorted(DEGREE_WORDS)), "|".join(sorted(RADIAN_WORDS))
FACTOR_NAMES = {
    Unit.TO_RADIANS: re.compile(rf"({IN_DEGREES})_?(2|to)_?({IN_RADIANS})|({IN_RADIANS})_per_({IN_DEGREES})|to_rad"),
    Unit.TO_DEGREES: re.compile(rf"({IN_RADIANS})_?(2|to)_?({IN_DEGREES})|({IN_DEGREES})_per_({IN_RADIANS})|to_deg"),
}
COMMENT = re.compile(
    rf"(?:^|\[|, )\s*(?P<gain>N[ *·]?m(?: ?s)?/)?(?P<unit>{IN_DEGREES}|°|{IN_RADIANS})(?!\w)(?! of )", re.IGNORECASE
)
DEGREES_PER_RADIAN, RADIANS_PER_DEGREE = 57.29578, 0.0174533
TOLERANCE = 3e-4  # relative: 57.3


def read_words(name: str) -> Angle | None:
    """Return the unit that a name tells."""
    for unit, pattern in FACTOR_NAMES.items():
        if pattern.fullmatch(name.lower().strip("_")):
            return Angle(unit, f"{name} says so")
    words = split_name(name)
    is_degrees, is_radians = bool(DEGREE_WORDS & {*words}), bool(RADIAN_WORDS & {*words})
    if is_degrees == is_radians or OTHER_WORDS & {*words}:
        return None
    if "per" in words:
        return Angle(Unit.PER_DEGREE if is_degrees else Unit.PER_RADIAN, f"{name} says so")
    return Angle(Unit.DEGREES if is_degrees else Unit.RADIANS, f"{name} says so")


def read_comment(comment: str, element: int | None = None) -> Angle | None:
    """Return the unit that the comment of an assignment tells, or of the target of that place."""
    units = list(COMMENT.finditer(comment.strip()))
    if not units or (element is not None and 1 < len(units) <= element):
        return None
    one = units[element if element is not None and len(units) > 1 else 0]
    is_radians = one["unit"].lower() in RADIAN_WORDS
    if one["gain"]:
        return Angle(Unit.PER_RADIAN if is_radians else Unit.PER_DEGREE, f"# {comment.strip()}")
    return Angle(Unit.RADIANS if is_radians else Unit.DEGREES, f"# {comment.strip()}")


@dataclasses.dataclass
class Factors:
    """A product: what converts angles, the number that is left, and all other factors with their exponents."""

    others: list[tuple[ast.expr, int]]
    conversions: list[Unit]
    pi: int  # its exponent
    number: float


def list_factors(node: ast.expr) -> Factors:
    """Return the factors of a product; of any other expression, itself."""
    numbers: list[tuple[float, int]] = []
    found = Factors([], [], 0, 1.0)
    waiting = [(node, 1)]
    while waiting:
        one, exponent = waiting.pop()
        match one:
            case ast.BinOp(left=left, op=ast.Mult() | ast.Div() as operator, right=right):
                waiting += [(left, exponent), (right, exponent if isinstance(operator, ast.Mult) else -exponent)]
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                waiting.append((operand, exponent))
                found.number *= -1
            case ast.Constant(value=int() | float() as value) if value:
                numbers.append((float(value), exponent))
            case ast.Attribute(attr="pi") | ast.Name(id="pi" | "PI"):
                found.pi += exponent
            case _:
                found.others.append((one, exponent))
    _take_conversions(found, numbers)
    for value, exponent in numbers:
        found.number *= value**exponent
    return found


def _take_conversions(found: Factors, numbers: list[tuple[float, int]]) -> None:
    for value, exponent in list(numbers):
        for known, unit in ((DEGREES_PER_RADIAN, Unit.TO_DEGREES), (RADIANS_PER_DEGREE, Unit.TO_RADIANS)):
            if abs(value / known - 1) < TOLERANCE:
                numbers.remove((value, exponent))
                found.conversions.append(unit if exponent > 0 else INVERSE[unit])
    for halves in ([(180.0, -found.pi)], [(360.0, -found.pi), (2.0, found.pi)]):
        if abs(found.pi) == 1 and all(one in numbers for one in halves):
            for one in halves:
                numbers.remove(one)
            found.conversions.append(Unit.TO_RADIANS if found.pi > 0 else Unit.TO_DEGREES)
            found.pi = 0


def unite(parts: Sequence[Angle | None]) -> Angle | None:
    """Return the unit that all parts have which have one."""
    known = [one for one in parts if one is not None]
    angles = {one.unit: one for one in known if one.unit is not Unit.NUMBER}
    if len(angles) == 1:
        return next(iter(angles.values()))
    return NUMBER if known and len(known) == len(parts) and not angles else None


def are_mixed(one: Angle | None, other: Angle | None) -> bool:
    """Say whether one is in degrees and the other in radians."""
    return one is not None and other is not None and {one.unit, other.unit} == {Unit.DEGREES, Unit.RADIANS}


def read_turn(node: ast.expr) -> Angle | None:
    """Return the unit in which a number is a half or a whole turn."""
    factors = list_factors(node)
    if factors.others or factors.conversions:
        return None
    if factors.pi == 1 and factors.number in (1.0, 2.0):
        return Angle(Unit.RADIANS, "of turns of 2 pi")
    return Angle(Unit.DEGREES, "of turns of 360") if not factors.pi and factors.number in (180.0, 360.0) else None
