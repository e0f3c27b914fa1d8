"""Vectors in compiled functions: what these may do with them without being traced.

A function compiled by Numba may hold the vectors, masks and rows of :mod:`.tracing` in variables, load and store them,
and write arithmetic and comparisons as for single numbers.
"""

from __future__ import annotations

import operator
from typing import Any

import numpy as np
from numba import types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import lower_builtin

from . import tracing
from .tracing import INLINE, LANES, MASK, ROWS, VECTOR, Elements, Index, Number, Rows, Vector, stand_in, traced

__all__ = [
    "INLINE",
    "LANES",
    "aligned_rows",
    "converted",
    "copy_row",
    "larger",
    "load",
    "load_at",
    "number",
    "put",
    "rows_of",
    "select",
    "smaller",
    "store",
    "store_at",
    "total",
    "transpose",
    "vector",
]

_ROW_BYTES = 64


def _is_operand(kind: Any) -> bool:
    return kind == VECTOR or isinstance(kind, types.Number)


def _define(function: Any, result: Any, kinds: Any, accepts: Any) -> None:
    """Let compiled code apply a Python operator as traced code does."""

    class Template(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            return signature(result, *args) if accepts(args) else None

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        operands = [stand_in(context, builder, *pair) for pair in zip(sig.args, args, strict=True)]
        if VECTOR in sig.args:
            operands = [Vector(builder, None).of(operand) for operand in operands]
        return function(*operands).ir

    infer_global(function)(Template)
    for pair in kinds:
        lower_builtin(function, *pair)(lower)


_ANY = type(VECTOR), types.Number
_PAIRS = [(one, other) for one in _ANY for other in _ANY if type(VECTOR) in (one, other)]
for _function in (operator.add, operator.sub, operator.mul, operator.truediv):
    for _variant in (_function, getattr(operator, f"i{_function.__name__}")):
        _define(_variant, VECTOR, _PAIRS, lambda args: VECTOR in args and all(map(_is_operand, args)))
for _function in (operator.lt, operator.le, operator.gt, operator.ge):
    _define(_function, MASK, _PAIRS, lambda args: VECTOR in args and all(map(_is_operand, args)))
for _function in (operator.and_, operator.or_):
    _define(_function, MASK, [(type(MASK), type(MASK))], lambda args: args == (MASK, MASK))
_define(
    operator.add,
    ROWS,
    [(type(ROWS), types.Integer)],
    lambda args: args[0] == ROWS and isinstance(args[1], types.Integer),
)

smaller = traced(VECTOR)(tracing.smaller)
larger = traced(VECTOR)(tracing.larger)
select = traced(lambda mask, x, y: MASK if x == MASK else VECTOR)(tracing.select)
total = traced(types.float32)(tracing.total)
transpose = traced()(tracing.transpose)


@traced(ROWS)
def rows_of(array: Rows) -> Rows:
    """Return the address of the rows of a contiguous float32 array, which must outlive it."""
    return array


@traced(types.float32)
def number(rows: Rows, index: Index) -> Number:
    """Return an element of rows, counted flat, as a single float32."""
    return rows.number(index)


@traced()
def put(rows: Rows, index: Index, value: Vector) -> None:
    """Write a single number to an element of rows, counted flat."""
    rows.put(index, value)


@traced(VECTOR)
def vector(number: Vector) -> Vector:
    """Return a vector with ``number``, which is not an integer, in all lanes."""
    return number


@traced(VECTOR)
def load(rows: Rows, row: Index) -> Vector:
    """Return a row of a contiguous float32 array (rows, LANES), or of rows."""
    return rows[row]


@traced(VECTOR)
def load_at(rows: Rows, first: Index) -> Vector:
    """Return LANES elements of a contiguous float32 array, or of rows, counted flat, from any ``first`` on."""
    return rows.vector(first)


@traced()
def store(rows: Rows, row: Index, value: Any) -> None:
    """Write a vector or number to a row of a contiguous float32 array (rows, LANES), or of rows."""
    rows[row] = value


@traced()
def store_at(rows: Rows, first: Index, value: Any) -> None:
    """Write a vector or number to LANES elements of a contiguous float32 array, or of rows, from any ``first`` on."""
    rows.write(first, value)


@traced()
def copy_row(source: Rows, row: Index, into: Rows, place: Index) -> None:
    """Copy a row to a place among other rows."""
    into[place] = source[row]


@traced(VECTOR)
def converted(array: Elements, first: Index) -> Vector:
    """Return LANES elements of a contiguous array of integers or real numbers, from any ``first`` on, as float32."""
    return array.vector(first)


def aligned_rows(rows: int) -> Any:
    """Return an uninitialised array (rows, LANES) of float32 whose rows do not straddle cache lines."""
    padding = _ROW_BYTES // 4
    room = np.empty(rows * LANES + padding, np.float32)
    first = -(room.ctypes.data // 4) % padding
    return room[first : first + rows * LANES].reshape(rows, LANES)
