"""The factors of a product, as it is written."""

import ast

from rlctl.checking.assignments import read_converted


def list_product(node: ast.expr) -> list[ast.expr]:
    """Return the factors of a product."""
    match node:
        case ast.BinOp(left=left, op=ast.Mult(), right=right):
            return list_product(left) + list_product(right)
        case ast.Call(func=ast.Name(id="float"), args=[only]):
            return list_product(only)
    return [node]


def find_function_of_values(
    elt: ast.expr, target: ast.expr, through: ast.expr, dictionary: ast.expr
) -> ast.expr | None:
    """Return a factor that is another function of an entry's value than the value itself, such as its size."""
    values = {f"{ast.unparse(dictionary)}[{ast.unparse(target)}]"}
    match through, target:
        case ast.Call(func=ast.Attribute(attr="items")), ast.Tuple(elts=[_, value]):
            values.add(ast.unparse(value))
        case ast.Call(func=ast.Attribute(attr="values")), _:
            values.add(ast.unparse(target))
    for factor in list_product(elt):
        parts = [ast.unparse(part) for part in ast.walk(factor) if isinstance(part, ast.expr)]
        is_converted = read_converted(factor) is not None
        if values & set(parts) and ast.unparse(factor) not in values and not is_converted:
            return factor
    return None
