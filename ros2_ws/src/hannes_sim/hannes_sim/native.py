"""Calls through addresses inside compiled code, so that one compiled loop drives any plant, law and effects.

Effects, control laws and plants are numba `cfunc`s; their addresses are plain integers.  A kernel that takes
addresses is compiled once, cached on disk, and needs no recompilation when effects are added.
A call costs about 3 ns.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from ._compile_cache import forgive_damage

forgive_damage()

_DOUBLE_P = types.CPointer(types.float64)

EFFECT_SIGNATURE = types.void(_DOUBLE_P, _DOUBLE_P, _DOUBLE_P, _DOUBLE_P)
"""contribute(x, p, s, y)"""

CONTROL_SIGNATURE = types.float64(_DOUBLE_P, _DOUBLE_P, _DOUBLE_P)
"""control(x, p, s) -> voltage"""

ADVANCE_SIGNATURE = types.void(types.CPointer(types.int64), types.float64, types.int64)
"""advance(handle, voltage, steps)"""


def needs_python(function: Any) -> bool:
    """Whether a numba cfunc calls what needs the interpreter, such as print.

    It fails there and keeps the interpreter's lock, so that the process stands still.  Of one that came from numba's
    cache this is not known (False).
    """
    return function.cache_hits == 0 and "missing Environment" in function.inspect_llvm()


def _call(result: Any, arguments: tuple[Any, ...]) -> Any:
    """An intrinsic that calls the C function at an int64 address with arguments of the given numba types."""

    def typer(typingctx: Any, address: Any, *given: Any) -> Any:
        signature = result(types.int64, *arguments)

        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            kinds = [context.get_value_type(t) for t in arguments]
            out = ir.VoidType() if result is types.void else context.get_value_type(result)
            function = builder.inttoptr(args[0], ir.FunctionType(out, kinds).as_pointer())
            value = builder.call(function, args[1:])
            return context.get_dummy_value() if result is types.void else value

        return signature, codegen

    return typer


@intrinsic
def call_effect(typingctx, address, x, p, s, y):  # type: ignore[no-untyped-def]
    """Call contribute(x, p, s, y) by address; all arguments are int64 addresses."""
    return _call(types.void, (types.int64,) * 4)(typingctx, address, x, p, s, y)


@intrinsic
def call_control(typingctx, address, x, p, s):  # type: ignore[no-untyped-def]
    """Call control(x, p, s) -> float64 by address; the arguments are int64 addresses."""
    return _call(types.float64, (types.int64,) * 3)(typingctx, address, x, p, s)


@intrinsic
def call_advance(typingctx, address, handle, voltage, steps):  # type: ignore[no-untyped-def]
    """Call advance(handle, voltage, steps) by address; handle is an int64 address."""
    return _call(types.void, (types.int64, types.float64, types.int64))(
        typingctx, address, handle, voltage, steps
    )


@intrinsic
def call_2(typingctx, address, a, b):  # type: ignore[no-untyped-def]
    """Call a void function of two pointers (such as mj_step(model, data)) by address."""
    return _call(types.void, (types.int64, types.int64))(typingctx, address, a, b)


@intrinsic
def pointer_f8(typingctx, address):  # type: ignore[no-untyped-def]
    """A float64 pointer from an int64 address."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.inttoptr(args[0], context.get_value_type(_DOUBLE_P))

    return _DOUBLE_P(types.int64), codegen


@intrinsic
def pointer_i8(typingctx, address):  # type: ignore[no-untyped-def]
    """An int64 pointer from an int64 address."""
    kind = types.CPointer(types.int64)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.inttoptr(args[0], context.get_value_type(kind))

    return kind(types.int64), codegen
