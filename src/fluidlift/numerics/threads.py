"""Parallel loops that compile as fast as serial ones.

Numba's `prange` compiles the body of a loop as a function of its own, with a wrapper around it, and the rest of the
kernel once more: three to five times the seconds of the same loop without threads. Here a kernel is written as a
serial function of a range (a slab), and the threads of Numba's own pool take a slab each:

    @njit(cache=True)
    def _scale_slab(begin, end, x, factor):
        for i in range(begin, end):
            x[i] *= factor

    @njit(cache=True)
    def scale(x, factor):
        over_slabs(_scale_slab, 0, len(x), (x, factor))

Slabs are cut as those of `prange`: one equal share per thread, or pieces of `numba.parallel_chunksize` that go to
whichever thread is free. Exceptions do not leave a slab: its function must not raise.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import extending, types
from numba.core import cgutils
from numba.core.compiler import Compiler
from numba.np.ufunc.parallel import _launch_threads

intrinsic: Any = extending.intrinsic
"""untyped: kernels call an intrinsic without its first argument"""

INT, INTEGER, POINTER = ir.IntType(32), ir.IntType(64), ir.IntType(8).as_pointer()

_launch_threads()  # the pool's entry must be known before a kernel is linked, also one from the cache


@intrinsic
def over_slabs(typingctx, slab, begin, end, arguments):
    """slab(b, e, *arguments) for ranges [b, e) that make up [begin, end), at the same time."""
    inner = slab.get_call_type(typingctx, (types.int64, types.int64, *arguments.types), {})
    if inner.return_type != types.none:
        raise TypeError("the function of a slab returns nothing")
    outer = types.void(slab, types.int64, types.int64, arguments)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        _, first, last, values = args
        context.add_linking_libs(getattr(context.get_function(slab, inner), "libs", ()))
        zero, one = ir.Constant(INTEGER, 0), ir.Constant(INTEGER, 1)
        module = builder.module
        length = builder.sub(last, first)
        threads = builder.call(_external(module, INT, [], "get_num_threads"), [])
        chunk = builder.call(_external(module, INTEGER, [], "get_parallel_chunksize"), [])
        pieces = builder.sdiv(builder.sub(builder.add(length, chunk), one), builder.select(
            builder.icmp_signed("==", chunk, zero), one, chunk))  # fmt: skip
        count = builder.select(builder.icmp_signed("==", chunk, zero), builder.sext(threads, INTEGER), pieces)
        count = builder.select(builder.icmp_signed("<", length, count), length, count)

        shared_type = ir.LiteralStructType([INTEGER, INTEGER, INTEGER, values.type])
        shared = cgutils.alloca_once(builder, shared_type)
        for n, value in enumerate((count, first, last, values)):
            builder.store(value, cgutils.gep_inbounds(builder, shared, 0, n))
        # the pool hands call n a pointer that lies n steps behind the first: from address 0 on, by 1, it is the number
        numbers = cgutils.alloca_once_value(builder, ir.Constant(POINTER, None))
        sizes, steps = cgutils.alloca_once_value(builder, count), cgutils.alloca_once_value(builder, one)
        some = INTEGER.as_pointer()
        pool = [POINTER, POINTER.as_pointer(), some, some, POINTER, INTEGER, INTEGER, INT]
        start = _external(module, ir.VoidType(), pool, "numba_parallel_for")
        call = builder.bitcast(_slab_of_number(context, module, slab, inner, shared_type), POINTER)
        with builder.if_then(builder.icmp_signed(">", length, zero)):
            builder.call(start, [call, numbers, sizes, steps, builder.bitcast(shared, POINTER), zero, one, threads])
        return context.get_dummy_value()

    return outer, codegen


def _external(module: Any, result: Any, arguments: Any, name: str) -> Any:
    return cgutils.get_or_insert_function(module, ir.FunctionType(result, arguments), name)


def _slab_of_number(context: Any, module: Any, slab: Any, inner: Any, shared_type: Any) -> Any:
    """What the pool calls: finds out which slab it is to do, and does it."""
    some = INTEGER.as_pointer()
    kind = ir.FunctionType(ir.VoidType(), [POINTER.as_pointer(), some, some, POINTER])
    function = ir.Function(module, kind, module.get_unique_name(f"{slab.dispatcher.py_func.__name__}_number"))
    function.linkage = "internal"
    builder = ir.IRBuilder(function.append_basic_block())
    number = builder.ptrtoint(builder.load(function.args[0]), INTEGER)
    shared = builder.bitcast(function.args[3], shared_type.as_pointer())
    count, first, last, values = (builder.load(cgutils.gep_inbounds(builder, shared, 0, n)) for n in range(4))

    def bound(n: Any) -> Any:
        return builder.add(first, builder.sdiv(builder.mul(n, builder.sub(last, first)), count))

    low, high = bound(number), bound(builder.add(number, ir.Constant(INTEGER, 1)))
    unpacked = [builder.extract_value(values, n) for n in range(len(inner.args) - 2)]
    fndesc = slab.dispatcher.overloads[inner.args].fndesc
    context.call_internal_no_propagate(builder, fndesc, inner, [low, high, *unpacked])
    builder.ret_void()
    return function


class Unaliased(Compiler):
    """Numba's compiler, told that no two arrays of a slab overlap, as `prange` assumes of its loops."""

    def __init__(self, typing: Any, target: Any, library: Any, args: Any, result: Any, flags: Any, names: Any) -> None:
        flags.noalias = True
        super().__init__(typing, target, library, args, result, flags, names)
