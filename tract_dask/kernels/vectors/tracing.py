"""Functions of vectors that are written out, instruction by instruction, into the compiled code that calls them.

A vector is LANES float32 that are computed on at once: every operation is one machine instruction a register. LANES
follows the processor's registers: 16 with AVX-512, 8 with AVX, else 4 (SSE2, NEON). A lane's result does not depend on
the other lanes. Vectors lie in memory as rows of float32 arrays (rows, LANES).

Numba compiles a function of a function anew at every level of calls, and a small matrix in memory costs more than the
arithmetic on it. A traced function is ordinary Python that runs once while its caller is compiled. Its arguments stand
for vectors; an operation on them adds an instruction. So Python's loops are unrolled, its lists are registers, and what
it calls needs no decorator. :func:`loop` makes a loop of the compiled code. Numbers mix with vectors and stand for all
lanes. Comparisons give masks, to be combined by ``&`` and ``|`` and used by :func:`select`.

What compiled functions themselves do with vectors, without tracing, is in :mod:`.simd`.
"""

from __future__ import annotations

import functools
import inspect
import math
from typing import Any, overload

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils, config
from numba.core.codegen import get_host_cpu_features
from numba.extending import intrinsic, models, register_model

INLINE: Any = {"inline": "always", "error_model": "numpy"}
"""How functions are compiled that only compiled functions call: as a part of these, so nothing is compiled twice."""


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

_FLOAT, _INT, _LONG = ir.FloatType(), ir.IntType(32), ir.IntType(64)
_FLOATS, _INTS, _BITS = (ir.VectorType(kind, LANES) for kind in (_FLOAT, _INT, ir.IntType(1)))
_FLAGS = ("contract",)  # a product and a sum may become one instruction


class _VectorType(types.Type):
    """LANES float32."""


class _MaskType(types.Type):
    """LANES bits."""


class _RowsType(types.Type):
    """Address of rows of LANES float32."""


VECTOR, MASK, ROWS = _VectorType(f"Vector{LANES}"), _MaskType(f"Mask{LANES}"), _RowsType(f"Rows{LANES}")
"""Numba's types of the variables that hold vectors, masks and the addresses of rows."""


def _model(held: Any) -> Any:
    """Return the model of a type that compiled code holds as ``held``."""

    class Model(models.PrimitiveModel):
        def __init__(self, manager: Any, kind: Any) -> None:
            super().__init__(manager, kind, held)

    return Model


for _kind, _held in ((_VectorType, _FLOATS), (_MaskType, _BITS), (_RowsType, _FLOAT.as_pointer())):
    register_model(_kind)(_model(_held))


class Index:
    """An integer of compiled code, while that is being traced; division is towards 0."""

    def __init__(self, builder: Any, ir_value: Any) -> None:
        self.builder, self.ir = builder, ir_value

    def of(self, other: Any) -> Any:
        """Return an integer as one of the same code."""
        return other.ir if isinstance(other, Index) else ir.Constant(_LONG, int(other))

    def constant(self, value: int) -> Index:
        """Return a constant of the same code."""
        return Index(self.builder, self.of(value))

    def __add__(self, other: Any) -> Index:
        return Index(self.builder, self.builder.add(self.ir, self.of(other)))

    def __sub__(self, other: Any) -> Index:
        return Index(self.builder, self.builder.sub(self.ir, self.of(other)))

    def __mul__(self, other: Any) -> Index:
        return Index(self.builder, self.builder.mul(self.ir, self.of(other)))

    def __floordiv__(self, other: Any) -> Index:
        return Index(self.builder, self.builder.sdiv(self.ir, self.of(other)))

    __radd__, __rmul__ = __add__, __mul__


class Mask:
    """A bit in each lane of compiled code, while that is being traced."""

    def __init__(self, builder: Any, ir_value: Any) -> None:
        self.builder, self.ir = builder, ir_value

    def __and__(self, other: Mask) -> Mask:
        return Mask(self.builder, self.builder.and_(self.ir, other.ir))

    def __or__(self, other: Mask) -> Mask:
        return Mask(self.builder, self.builder.or_(self.ir, other.ir))

    def __invert__(self) -> Mask:
        return Mask(self.builder, self.builder.not_(self.ir))


class Vector:
    """LANES float32 of compiled code, while that is being traced: arithmetic adds instructions to the code."""

    def __init__(self, builder: Any, ir_value: Any) -> None:
        self.builder, self.ir = builder, ir_value

    def of(self, other: Any) -> Vector:
        """Return a vector, or a number in all lanes, as a vector of the same code."""
        if isinstance(other, Vector):
            return other
        if isinstance(other, Index):
            return spread(other)
        return Vector(self.builder, ir.Constant(_FLOATS, [float(np.float32(other))] * LANES))

    def call(self, name: str, *others: Vector) -> Vector:
        """Call one of LLVM's functions of vectors."""
        kind = ir.FunctionType(_FLOATS, [_FLOATS] * (1 + len(others)))
        function = cgutils.get_or_insert_function(self.builder.module, kind, f"llvm.{name}.v{LANES}f32")
        return Vector(self.builder, self.builder.call(function, [self.ir, *(other.ir for other in others)]))

    def _with(self, name: str, x: Any, y: Any) -> Vector:
        return Vector(self.builder, getattr(self.builder, name)(self.of(x).ir, self.of(y).ir, flags=_FLAGS))

    def _compared(self, relation: str, other: Any) -> Mask:
        return Mask(self.builder, self.builder.fcmp_ordered(relation, self.ir, self.of(other).ir))

    def __add__(self, other: Any) -> Vector:
        return self._with("fadd", self, other)

    def __radd__(self, other: Any) -> Vector:
        return self._with("fadd", other, self)

    def __sub__(self, other: Any) -> Vector:
        return self._with("fsub", self, other)

    def __rsub__(self, other: Any) -> Vector:
        return self._with("fsub", other, self)

    def __mul__(self, other: Any) -> Vector:
        return self._with("fmul", self, other)

    def __rmul__(self, other: Any) -> Vector:
        return self._with("fmul", other, self)

    def __truediv__(self, other: Any) -> Vector:
        return self._with("fdiv", self, other)

    def __rtruediv__(self, other: Any) -> Vector:
        return self._with("fdiv", other, self)

    def __neg__(self) -> Vector:
        return Vector(self.builder, self.builder.fneg(self.ir))

    def __lt__(self, other: Any) -> Mask:
        return self._compared("<", other)

    def __le__(self, other: Any) -> Mask:
        return self._compared("<=", other)

    def __gt__(self, other: Any) -> Mask:
        return self._compared(">", other)

    def __ge__(self, other: Any) -> Mask:
        return self._compared(">=", other)

    def equals(self, other: Any) -> Mask:
        """Return where both are equal."""
        return self._compared("==", other)


class Number:
    """A single float32 of compiled code, while that is being traced."""

    def __init__(self, builder: Any, ir_value: Any) -> None:
        self.builder, self.ir = builder, ir_value


class Elements:
    """Numbers of some type in memory, counted flat, of compiled code, while that is being traced."""

    def __init__(self, builder: Any, ir_value: Any, kind: Any) -> None:
        self.builder, self.ir, self.kind = builder, ir_value, kind

    def at(self, index: Any) -> Any:
        """Return the address of an element."""
        return self.builder.gep(self.ir, [index.ir if isinstance(index, Index) else ir.Constant(_LONG, int(index))])

    def index(self, index: Any) -> Index:
        """Return an integer element."""
        return Index(self.builder, self.builder.load(self.at(index)))

    def vector(self, first: Any) -> Vector:
        """Return LANES elements, from any ``first`` on, as float32."""
        address = self.at(first)
        kind = ir.VectorType(address.type.pointee, LANES)
        values = self.builder.load(self.builder.bitcast(address, kind.as_pointer()))
        values.align = self.kind.bitwidth // 8
        if isinstance(self.kind, types.Integer):
            values = (self.builder.sitofp if self.kind.signed else self.builder.uitofp)(values, _FLOATS)
        elif self.kind != types.float32:
            values = self.builder.fptrunc(values, _FLOATS)
        return Vector(self.builder, values)


class Rows(Elements):
    """Rows of LANES float32 in memory, of compiled code, while that is being traced."""

    def __init__(self, builder: Any, ir_value: Any) -> None:
        super().__init__(builder, ir_value, types.float32)

    def __add__(self, row: Any) -> Rows:
        return Rows(self.builder, self.at(row * LANES))

    def __getitem__(self, row: Any) -> Vector:
        return self.vector(row * LANES)

    def __setitem__(self, row: Any, value: Any) -> None:
        self.write(row * LANES, value)

    def write(self, first: Any, value: Any) -> None:
        """Write a vector, or a number, to LANES elements from any ``first`` on, counted flat."""
        address = self.builder.bitcast(self.at(first), _FLOATS.as_pointer())
        self.builder.store(self.constant(value).ir, address).align = 4

    def put(self, index: Any, value: Vector) -> None:
        """Write the one number that is in all lanes of ``value`` to the element ``index``, counted flat."""
        self.builder.store(self.builder.extract_element(value.ir, _INT(0)), self.at(index))

    def constant(self, value: Any) -> Vector:
        """Return a number, or a vector, as a vector."""
        return Vector(self.builder, None).of(value)

    def integer(self, index: Any) -> Index:
        """Return the one element ``index``, counted flat, as an integer."""
        return Index(self.builder, self.builder.fptosi(self.builder.load(self.at(index)), _LONG))

    def number(self, index: Any) -> Number:
        """Return the one element ``index``, counted flat."""
        return Number(self.builder, self.builder.load(self.at(index)))

    def single(self, index: Any) -> Vector:
        """Return the one element ``index``, counted flat, in all lanes."""
        return Vector(self.builder, _in_all_lanes(self.builder, self.number(index).ir))


def _in_all_lanes(builder: Any, number: Any) -> Any:
    empty = ir.Constant(_FLOATS, ir.Undefined)
    first = builder.insert_element(empty, number, _INT(0))
    return builder.shuffle_vector(first, empty, ir.Constant(_INTS, [0] * LANES))


def loop(first: Index, end: Index, values: list[Vector], body: Any) -> list[Vector]:
    """Return what becomes of ``values`` by ``values = body(k, values)`` for k from ``first`` to before ``end``.

    The loop is one of the compiled code; the body is traced once.
    """
    builder = first.builder
    places = [cgutils.alloca_once_value(builder, value.ir) for value in values]
    with cgutils.for_range_slice(builder, first.ir, end.ir, ir.Constant(_LONG, 1), _LONG) as (k, _):
        changed = body(Index(builder, k), [Vector(builder, builder.load(place)) for place in places])
        for place, value in zip(places, changed, strict=True):
            builder.store(value.ir, place)
    return [Vector(builder, builder.load(place)) for place in places]


def stand_in(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    """Return the object that stands for a value of compiled code while that is traced.

    Of arrays, which must be contiguous, and tuples the elements; numbers that are no integers become vectors.
    """
    if isinstance(kind, types.BaseTuple):
        parts = [stand_in(context, builder, k, builder.extract_value(value, n)) for n, k in enumerate(kind.types)]
        return kind.instance_class(*parts) if isinstance(kind, types.BaseNamedTuple) else tuple(parts)
    if kind == types.none:
        return None
    if isinstance(kind, types.Integer | types.Boolean):
        return Index(builder, context.cast(builder, value, kind, types.int64))
    if isinstance(kind, types.Number):
        return Vector(builder, _in_all_lanes(builder, context.cast(builder, value, kind, types.float32)))
    if isinstance(kind, types.Array):
        data = context.make_array(kind)(context, builder, value).data
        return Rows(builder, data) if kind.dtype == types.float32 else Elements(builder, data, kind.dtype)
    return {VECTOR: Vector, MASK: Mask, ROWS: Rows}[kind](builder, value)


def traced(result: Any = types.none) -> Any:
    """Return a decorator that lets compiled code call a function of vectors, which is written out in place.

    The Python function runs once while its caller is compiled, with objects that stand for the vectors; each operation
    on them becomes an instruction. Arguments come as :func:`stand_in` makes them. ``result`` is Numba's type of what
    the function returns, or a function that gives it from those of the arguments.
    """

    def decorate(function: Any) -> Any:
        def definition(typing: Any, *kinds: Any) -> Any:
            def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
                found = function(*(stand_in(context, builder, *pair) for pair in zip(sig.args, args, strict=True)))
                return context.get_dummy_value() if found is None else found.ir

            kind = result if isinstance(result, types.Type) else result(*kinds)
            return kind(*kinds), emit

        functools.update_wrapper(definition, function)
        place = inspect.Parameter("typing", inspect.Parameter.POSITIONAL_OR_KEYWORD)
        parameters = [place, *inspect.signature(function).parameters.values()]
        definition.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        return intrinsic(definition)

    return decorate


@overload
def select(mask: Mask, x: Mask, y: Mask) -> Mask: ...
@overload
def select(mask: Mask, x: Vector | float, y: Vector | float) -> Vector: ...
def select(mask: Mask, x: Any, y: Any) -> Any:
    """Return x where the mask holds, else y: vectors or numbers, or two masks."""
    builder = mask.builder
    if isinstance(x, Mask):
        return Mask(builder, builder.select(mask.ir, x.ir, y.ir))
    any_vector = Vector(builder, None)
    return Vector(builder, builder.select(mask.ir, any_vector.of(x).ir, any_vector.of(y).ir))


def smaller(x: Vector, y: Vector | float) -> Vector:
    """Return the smaller of two, the second where one is NaN."""
    return select(x < y, x, y)


def larger(x: Vector, y: Vector | float) -> Vector:
    """Return the larger of two, the second where one is NaN."""
    return select(x > y, x, y)


def sqrt(x: Vector) -> Vector:
    """Return the square root."""
    return x.call("sqrt")


def absolute(x: Vector) -> Vector:
    """Return the number without its sign."""
    return x.call("fabs")


def exp(x: Vector) -> Vector:
    """Return exp(x) within 2e-7 of itself: 0 below x = -87 and for NaN, cut off at x = 88.

    That is 2^n times a polynomial in what is left of x / log(2) after its nearest integer n (Cephes' expf).
    """
    bounded = smaller(x, 88.0)
    n = (bounded * (1 / math.log(2))).call("rint")
    rest = bounded
    for part in (0.693359375, -2.12194440e-4):  # log(2), of which the first part is exact
        rest = rest - n * part
    value = x.of(1.9875691500e-4)
    for coefficient in (1.3981999507e-3, 8.3334519073e-3, 4.1665795894e-2, 1.6666665459e-1, 5.0000001201e-1, 1, 1):
        value = value * rest + coefficient
    return select(x > -87.0, value * _power_of_two(n), 0.0)


def _power_of_two(n: Vector) -> Vector:
    """Return 2^n for integers n: they are the exponents of float32."""
    builder = n.builder
    exponent = builder.add(builder.fptosi(n.ir, _INTS), ir.Constant(_INTS, [127] * LANES))
    return Vector(builder, builder.bitcast(builder.shl(exponent, ir.Constant(_INTS, [23] * LANES)), _FLOATS))


def spread(index: Index) -> Vector:
    """Return an integer as a number in all lanes."""
    return Vector(index.builder, _in_all_lanes(index.builder, index.builder.sitofp(index.ir, _FLOAT)))


def fewer(x: Index, y: Any) -> Index:
    """Return the smaller of two integers."""
    return Index(x.builder, x.builder.select(x.builder.icmp_signed("<", x.ir, x.of(y)), x.ir, x.of(y)))


def more(x: Index, y: Any) -> Index:
    """Return the larger of two integers."""
    return Index(x.builder, x.builder.select(x.builder.icmp_signed(">", x.ir, x.of(y)), x.ir, x.of(y)))


def count(mask: Mask) -> Index:
    """Return in how many lanes the mask holds."""
    builder = mask.builder
    bits = builder.bitcast(mask.ir, ir.IntType(LANES))
    return Index(builder, builder.zext(builder.ctpop(bits), _LONG))


def total(x: Vector) -> Number:
    """Return the sum over the lanes."""
    kind = ir.FunctionType(_FLOAT, [_FLOAT, _FLOATS])
    name = f"llvm.vector.reduce.fadd.v{LANES}f32"
    function = cgutils.get_or_insert_function(x.builder.module, kind, name)
    return Number(x.builder, x.builder.call(function, [ir.Constant(_FLOAT, -0.0), x.ir], fastmath=("reassoc",)))


def transpose(array: Rows, starts: Elements, column: Index, into: Rows, row: Index) -> None:
    """Write ``into[row + j, l] = array.flat[starts[l] + column + j]`` for lanes l and j < LANES."""
    builder = into.builder
    rows = [array.vector(starts.index(lane) + column) for lane in range(LANES)]

    def pick(one: Vector, other: Vector, lanes: list[int]) -> Vector:
        return Vector(builder, builder.shuffle_vector(one.ir, other.ir, ir.Constant(_INTS, lanes)))

    size = 1
    while size < LANES:  # swap the off-diagonal blocks of all squares of twice this size
        low = [k if not k & size else LANES + k - size for k in range(LANES)]
        high = [k + size if not k & size else LANES + k for k in range(LANES)]
        for k in range(LANES):
            if not k & size:
                one, other = rows[k], rows[k + size]
                rows[k], rows[k + size] = pick(one, other, low), pick(one, other, high)
        size *= 2
    for j, values in enumerate(rows):
        into[row + j] = values
