"""Vectors of float32 for compiled code: LANES numbers that are computed on at once.

A function compiled by numba may hold vectors in variables, load and store them, and write arithmetic and comparisons as
for single numbers; every operation becomes one machine instruction a register. Numbers mix with vectors and stand for
all lanes. Comparisons give masks, to be combined by ``&`` and ``|`` and used by :func:`select`. Vectors lie in memory
as rows of float32 arrays (rows, LANES).

LANES follows the processor's registers: 16 with AVX-512, 8 with AVX, else 4 (SSE2, NEON). A lane's result does not
depend on the other lanes.
"""

from __future__ import annotations

import math
import operator
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils, config
from numba.core.codegen import get_host_cpu_features
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

__all__ = [
    "LANES",
    "absolute",
    "aligned_rows",
    "count",
    "exp",
    "larger",
    "load",
    "load_at",
    "negated",
    "number",
    "opaque",
    "put",
    "rows_of",
    "select",
    "smaller",
    "sqrt",
    "store",
    "transpose",
    "vector",
]

_ROW_BYTES = 64


def lanes_of(features: str) -> int:
    """Return how many float32 a register holds, given LLVM's list of a processor's features.

    Examples
    --------
    >>> lanes_of("+sse2,+avx,+avx2,-avx512f")
    8
    """
    present = features.split(",")
    if "+avx512f" in present:
        return 16
    return 8 if "+avx" in present else 4


LANES = lanes_of(get_host_cpu_features() if config.CPU_FEATURES is None else config.CPU_FEATURES)
"""Numbers in a vector."""

_FLOAT, _INT = ir.FloatType(), ir.IntType(32)
_FLOATS, _INTS, _BITS = (ir.VectorType(kind, LANES) for kind in (_FLOAT, _INT, ir.IntType(1)))
_FLAGS = ("contract",)  # a product and a sum may become one instruction


class _Vector(types.Type):
    """LANES float32."""


class _Mask(types.Type):
    """LANES bits."""


class _Rows(types.Type):
    """Address of rows of LANES float32."""


VECTOR, MASK, ROWS = _Vector(f"Vector{LANES}"), _Mask(f"Mask{LANES}"), _Rows(f"Rows{LANES}")


@register_model(_Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _FLOATS)


@register_model(_Mask)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _BITS)


@register_model(_Rows)
class _RowsModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _FLOAT.as_pointer())


def _constant(value: float) -> Any:
    return ir.Constant(_FLOATS, [float(np.float32(value))] * LANES)


def _integers(value: int) -> Any:
    return ir.Constant(_INTS, [value] * LANES)


def _spread(context: Any, builder: Any, value: Any, kind: Any) -> Any:
    """Return ``value`` as a vector: a number goes to all lanes."""
    if kind == VECTOR:
        return value
    number = context.cast(builder, value, kind, types.float32)
    empty = ir.Constant(_FLOATS, ir.Undefined)
    first = builder.insert_element(empty, number, _INT(0))
    return builder.shuffle_vector(first, empty, _integers(0))


def _is_operand(kind: Any) -> bool:
    return kind == VECTOR or isinstance(kind, types.Number)


def _define(function: Any, result: Any, emit: Any) -> None:
    """Let compiled code apply a Python operator to vectors, or to a vector and a number."""

    class Template(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            if VECTOR in args and all(map(_is_operand, args)):
                return signature(result, *args)
            return None

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        spread = (_spread(context, builder, *pair) for pair in zip(args, sig.args, strict=True))
        return emit(builder, *spread)

    infer_global(function)(Template)
    for kinds in ((_Vector, _Vector), (_Vector, types.Number), (types.Number, _Vector)):
        lower_builtin(function, *kinds)(lower)


for _function, _name in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _define(_function, VECTOR, lambda builder, x, y, name=_name: getattr(builder, name)(x, y, flags=_FLAGS))
    _define(
        getattr(operator, f"i{_function.__name__}"),
        VECTOR,
        lambda builder, x, y, name=_name: getattr(builder, name)(x, y, flags=_FLAGS),
    )
for _function, _name in (
    (operator.lt, "<"),
    (operator.le, "<="),
    (operator.gt, ">"),
    (operator.ge, ">="),
    (operator.eq, "=="),
):
    _define(_function, MASK, lambda builder, x, y, name=_name: builder.fcmp_ordered(name, x, y))


def _define_logic(function: Any, emit: Any) -> None:
    """Let compiled code combine two masks."""

    class Template(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            return signature(MASK, *args) if args == (MASK, MASK) else None

    infer_global(function)(Template)
    lower_builtin(function, _Mask, _Mask)(lambda context, builder, sig, args: emit(builder, *args))


_define_logic(operator.and_, lambda builder, x, y: builder.and_(x, y))
_define_logic(operator.or_, lambda builder, x, y: builder.or_(x, y))


def _first(context: Any, builder: Any, kind: Any, place: Any) -> Any:
    """Return the address of the first element of rows, or of a contiguous array."""
    return place if kind == ROWS else context.make_array(kind)(context, builder, place).data


def _address(context: Any, builder: Any, kind: Any, place: Any, index: Any) -> Any:
    """Return the place of an element of rows or of a contiguous array, as that of a vector."""
    data = _first(context, builder, kind, place)
    return builder.bitcast(builder.gep(data, [index]), _FLOATS.as_pointer())


def _row(builder: Any, index: Any) -> Any:
    return builder.mul(index, ir.Constant(index.type, LANES))


def _call(builder: Any, name: str, *args: Any) -> Any:
    """Call one of LLVM's functions of vectors."""
    kind = ir.FunctionType(_FLOATS, [_FLOATS] * len(args))
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f32"), args)


@infer_global(operator.add)
class _Further(AbstractTemplate):
    """Rows from a later one on."""

    def generic(self, args: Any, kws: Any) -> Any:
        if args[0] == ROWS and isinstance(args[1], types.Integer):
            return signature(ROWS, ROWS, types.intp)
        return None


@lower_builtin(operator.add, _Rows, types.Integer)
def _further(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.gep(args[0], [_row(builder, args[1])])


@intrinsic
def rows_of(typing: Any, array: Any) -> Any:
    """Return the address of the rows of a contiguous float32 array, which must outlive it."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _first(context, builder, sig.args[0], args[0])

    return ROWS(array), emit


@intrinsic
def number(typing: Any, rows: Any, index: Any) -> Any:
    """Return an element of rows, counted flat, as a single float32."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(builder.gep(args[0], [args[1]]))

    return types.float32(rows, types.intp), emit


@intrinsic
def put(typing: Any, rows: Any, index: Any, value: Any) -> Any:
    """Write a single number to an element of rows, counted flat."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store(args[2], builder.gep(args[0], [args[1]]))
        return context.get_dummy_value()

    return types.void(rows, types.intp, types.float32), emit


@intrinsic
def vector(typing: Any, number: Any) -> Any:
    """Return a vector with ``number`` in all lanes."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _spread(context, builder, args[0], sig.args[0])

    return VECTOR(number), emit


@intrinsic
def load(typing: Any, array: Any, row: Any) -> Any:
    """Return a row of a contiguous float32 array (rows, LANES), or of rows."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        result = builder.load(_address(context, builder, sig.args[0], args[0], _row(builder, args[1])))
        result.align = 4
        return result

    return VECTOR(array, types.intp), emit


@intrinsic
def load_at(typing: Any, array: Any, first: Any) -> Any:
    """Return LANES elements of a contiguous float32 array, counted flat, from any ``first`` on."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        result = builder.load(_address(context, builder, sig.args[0], *args))
        result.align = 4
        return result

    return VECTOR(array, types.intp), emit


@intrinsic
def store(typing: Any, array: Any, row: Any, value: Any) -> Any:
    """Write a vector or number to a row of a contiguous float32 array (rows, LANES), or of rows."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        address = _address(context, builder, sig.args[0], args[0], _row(builder, args[1]))
        builder.store(_spread(context, builder, args[2], sig.args[2]), address).align = 4
        return context.get_dummy_value()

    return types.void(array, types.intp, value), emit


@intrinsic
def transpose(typing: Any, array: Any, starts: Any, column: Any, into: Any, row: Any) -> Any:
    """Write ``into[row + j, l] = array.flat[starts[l] + column + j]`` for lanes l and j < LANES; contiguous."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        first = context.make_array(sig.args[1])(context, builder, args[1]).data
        rows = []
        for lane in range(LANES):
            start = builder.load(builder.gep(first, [_INT(lane)]))
            values = builder.load(_address(context, builder, sig.args[0], args[0], builder.add(start, args[2])))
            values.align = 4
            rows.append(values)
        size = 1
        while size < LANES:  # swap the off-diagonal blocks of all squares of twice this size
            low = [k if not k & size else LANES + k - size for k in range(LANES)]
            high = [k + size if not k & size else LANES + k for k in range(LANES)]
            for k in range(LANES):
                if not k & size:
                    one, other = rows[k], rows[k + size]
                    rows[k] = builder.shuffle_vector(one, other, ir.Constant(_INTS, low))
                    rows[k + size] = builder.shuffle_vector(one, other, ir.Constant(_INTS, high))
            size *= 2
        for j, values in enumerate(rows):
            index = _row(builder, builder.add(args[4], ir.Constant(args[4].type, j)))
            builder.store(values, _address(context, builder, sig.args[3], args[3], index)).align = 4
        return context.get_dummy_value()

    return types.void(array, starts, types.intp, into, types.intp), emit


@intrinsic
def opaque(typing: Any, number: Any) -> Any:
    """Return an integer, of which the compiler does not know that it is constant.

    A loop over so many rows stays a loop: unrolled, the loops over matrices would take long to compile and run no
    faster.
    """

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        value = context.cast(builder, args[0], sig.args[0], types.intp)
        kind = ir.FunctionType(value.type, [value.type])
        return builder.asm(kind, "", "=r,0", [value], side_effect=False)

    return types.intp(number), emit


def _unary(emit_vector: Any) -> Any:
    """Return an intrinsic of one vector."""

    @intrinsic
    def function(typing: Any, x: Any) -> Any:
        def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            return emit_vector(builder, args[0])

        return VECTOR(VECTOR), emit

    return function


def _exp(builder: Any, x: Any) -> Any:
    """2^n times a polynomial in what is left of x / log(2) after its nearest integer n (Cephes' expf)."""
    bounded = builder.select(builder.fcmp_ordered("<", x, _constant(88.0)), x, _constant(88.0))
    n = _call(builder, "rint", builder.fmul(bounded, _constant(1 / math.log(2))))
    log_2 = (0.693359375, -2.12194440e-4)  # in two parts, the first exact
    rest = bounded
    for part in log_2:
        rest = builder.fsub(rest, builder.fmul(n, _constant(part), flags=_FLAGS), flags=_FLAGS)
    value = _constant(1.9875691500e-4)
    for coefficient in (1.3981999507e-3, 8.3334519073e-3, 4.1665795894e-2, 1.6666665459e-1, 5.0000001201e-1, 1, 1):
        value = builder.fadd(builder.fmul(value, rest, flags=_FLAGS), _constant(coefficient), flags=_FLAGS)
    exponent = builder.shl(builder.add(builder.fptosi(n, _INTS), _integers(127)), _integers(23))
    value = builder.fmul(value, builder.bitcast(exponent, _FLOATS))
    return builder.select(builder.fcmp_ordered(">", x, _constant(-87.0)), value, _constant(0.0))


exp = _unary(_exp)
"""exp(x) within 2e-7 of itself: 0 below x = -87 and for NaN, cut off at x = 88."""
sqrt = _unary(lambda builder, x: _call(builder, "sqrt", x))
absolute = _unary(lambda builder, x: _call(builder, "fabs", x))
negated = _unary(lambda builder, x: builder.fneg(x))


def _pick(relation: str) -> Any:
    """Return an intrinsic that picks the one of two by a comparison, the second where that is of NaN."""

    @intrinsic
    def function(typing: Any, x: Any, y: Any) -> Any:
        def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            a, b = (_spread(context, builder, *pair) for pair in zip(args, sig.args, strict=True))
            return builder.select(builder.fcmp_ordered(relation, a, b), a, b)

        return VECTOR(x, y), emit

    return function


smaller = _pick("<")
larger = _pick(">")


@intrinsic
def select(typing: Any, mask: Any, x: Any, y: Any) -> Any:
    """Return x where the mask holds, else y."""
    result = MASK if x == MASK else VECTOR

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        if sig.args[1] == MASK:
            return builder.select(args[0], args[1], args[2])
        a, b = (_spread(context, builder, *pair) for pair in zip(args[1:], sig.args[1:], strict=True))
        return builder.select(args[0], a, b)

    return result(mask, x, y), emit


@intrinsic
def count(typing: Any, mask: Any) -> Any:
    """Return in how many lanes the mask holds."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], ir.IntType(LANES))
        return builder.zext(builder.ctpop(bits), ir.IntType(64))

    return types.int64(MASK), emit


def aligned_rows(rows: int) -> Any:
    """Return an uninitialised array (rows, LANES) of float32 whose rows do not straddle cache lines."""
    padding = _ROW_BYTES // 4
    room = np.empty(rows * LANES + padding, np.float32)
    first = -(room.ctypes.data // 4) % padding
    return room[first : first + rows * LANES].reshape(rows, LANES)
