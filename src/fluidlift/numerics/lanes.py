"""Four or eight single-precision numbers at once, for Numba kernels.

Numba's own vectoriser leaves short loops, such as the three samples of a spline, scalar. With the types here a kernel
says what goes side by side; LLVM makes vector instructions of it on any processor. Products and sums may be fused.

    a = load4(field, n)                # field float32, one-dimensional, contiguous; n is not checked
    store(field, n, a * weight + b)    # vector times vector or float32, vector plus vector
"""

from __future__ import annotations

import operator
from typing import Any

from llvmlite import ir
from numba import extending, types
from numba.extending import models, overload, register_model

intrinsic: Any = extending.intrinsic
"""untyped: kernels call an intrinsic without its first argument"""


class FloatVector(types.Type):
    """Numba's name for a vector of `lanes` single-precision numbers."""

    def __init__(self, lanes: int) -> None:
        self.lanes = lanes
        super().__init__(name=f"FloatVector({lanes})")


@register_model(FloatVector)
class _FloatVectorModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: FloatVector) -> None:
        super().__init__(dmm, fe_type, ir.VectorType(ir.FloatType(), fe_type.lanes))


FOUR, EIGHT = FloatVector(4), FloatVector(8)


def _address(context: Any, builder: Any, array_type: Any, array: Any, index: Any, vector: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), vector.as_pointer())


def _load(result: FloatVector) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        address = _address(context, builder, signature.args[0], args[0], args[1], context.get_value_type(result))
        return builder.load(address, align=4)

    return codegen


@intrinsic
def load4(typingctx, array, index):
    """array[index : index + 4]."""
    return FOUR(array, types.intp), _load(FOUR)


@intrinsic
def load8(typingctx, array, index):
    """array[index : index + 8]."""
    return EIGHT(array, types.intp), _load(EIGHT)


@intrinsic
def store(typingctx, array, index, vector):
    """array[index : index + lanes] = vector."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        address = _address(context, builder, signature.args[0], args[0], args[1], args[2].type)
        builder.store(args[2], address, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, vector), codegen


def _pack(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    vector = ir.Constant(context.get_value_type(signature.return_type), ir.Undefined)
    for lane, number in enumerate(args):
        vector = builder.insert_element(vector, number, ir.IntType(32)(lane))
    return vector


@intrinsic
def vector4(typingctx, a, b, c, d):
    """The vector (a, b, c, d)."""
    return FOUR(*[types.float32] * 4), _pack


@intrinsic
def vector8(typingctx, a, b, c, d, e, f, g, h):
    """The vector (a, b, c, d, e, f, g, h)."""
    return EIGHT(*[types.float32] * 8), _pack


def _shuffle(pattern: list[int]) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        mask = ir.Constant(ir.VectorType(ir.IntType(32), len(pattern)), pattern)
        return builder.shuffle_vector(args[0], args[0], mask)

    return codegen


@intrinsic
def twice(typingctx, vector):
    """(a, b, c, d) becomes (a, b, c, d, a, b, c, d)."""
    return EIGHT(FOUR), _shuffle([0, 1, 2, 3, 0, 1, 2, 3])


@intrinsic
def first_half(typingctx, vector):
    """The first four of eight."""
    return FOUR(EIGHT), _shuffle([0, 1, 2, 3])


@intrinsic(prefer_literal=True)
def lane(typingctx, vector, number):
    """One number of the vector; `number` is a literal."""
    index = number.literal_value

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.extract_element(args[0], ir.IntType(32)(index))

    return types.float32(vector, number), codegen


@intrinsic
def _sum(typingctx, a, b):
    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fadd(*args, flags=("contract",))

    return a(a, a), codegen


@intrinsic
def _product(typingctx, a, b):
    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fmul(*args, flags=("contract",))

    return a(a, a), codegen


@overload(operator.add)
def _add(a, b):
    if isinstance(a, FloatVector) and a == b:
        return lambda a, b: _sum(a, b)
    return None


@overload(operator.mul)
def _multiply(a, b):
    if isinstance(a, FloatVector) and a == b:
        return lambda a, b: _product(a, b)
    if a == FOUR and b == types.float32:
        return lambda a, b: _product(a, vector4(b, b, b, b))
    if a == EIGHT and b == types.float32:
        return lambda a, b: _product(a, vector8(b, b, b, b, b, b, b, b))
    return None
