"""Lengths of vectors, as they are written."""

import ast

from rlctl.checking.assignments import read_name


def read_vector(node: ast.expr) -> list[ast.expr] | None:
    """Return the vector, or its numbers, of which an expression is the length; None for other expressions."""
    match node:
        case ast.Call(func=function, args=[only]) if read_name(function) == "norm":
            return [only]
        case ast.Call(func=function, args=[only, *_]) if read_name(function) == "norm" and node.keywords:
            return [only]
        case ast.Call(func=function, args=[ast.Starred(value=only)]) if read_name(function) == "hypot":
            return [only]
        case ast.Call(func=function, args=[_, _, *_] as parts) if read_name(function) == "hypot":
            return parts
        case ast.Call(func=function, args=[inside]) if read_name(function) == "sqrt":
            return _read_squares(inside)
        case ast.BinOp(left=inside, op=ast.Pow(), right=ast.Constant(value=0.5)):
            return _read_squares(inside)
    return None


def _read_squares(node: ast.expr) -> list[ast.expr] | None:
    """Return what is squared in a sum of squares."""
    match node:
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            sides = [_read_squares(left), _read_squares(right)]
            return None if None in sides else [part for side in sides for part in side or ()]
        case ast.BinOp(left=base, op=ast.Pow(), right=ast.Constant(value=2)):
            return [base]
        case ast.BinOp(left=left, op=ast.Mult() | ast.MatMult(), right=right) if ast.dump(left) == ast.dump(right):
            return [left]
        case ast.Call(func=ast.Attribute(attr="sum", value=ast.expr() as owner), args=[]):
            return _read_squares(owner)
        case ast.Call(func=function, args=[inside, *_]) if read_name(function) in ("sum", "square"):
            return [inside] if read_name(function) == "square" else _read_squares(inside)
        case ast.Call(func=function, args=[left, right]) if read_name(function) in ("dot", "vdot", "inner"):
            return [left] if ast.dump(left) == ast.dump(right) else None
    return None
