"""A call of a C library that may fail by ending the process: it comes back with a number instead.

MuJoCo meets an error deep inside a step, tells a handler, and ends the process when that returns. So the handler does
not return: it jumps back to before the call (setjmp, longjmp). What follows from that, and is nowhere else:

- A function in which setjmp returns twice is not optimised and not inlined, or a value that was kept in a register
  would be lost. `_call_between` is that function, and nothing else is in it.
- The handler is one for the process, a jump belongs to a thread: where to jump is a thread's own (a key of pthread).
- The handler is kept on disk like every kernel, and the number of the key is of this process: the handler reads it
  under a symbol, KEY_SYMBOL.
- What the library had begun is not undone: after an error its data are to be reset or thrown away.

Sources: ISO C 7.13 (nonlocal jumps); POSIX pthread_getspecific.
"""

import ctypes
from typing import Any, Final

import llvmlite.binding as llvm
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from softfinger.proxy.kernels.jit.decorators import c_function, jit
from softfinger.proxy.kernels.jit.memory import int32_at, uint8_at

JUMP_BYTES: Final = 1024
"""Room for a jmp_buf: 200 bytes with glibc on x86-64, 312 on AArch64."""
SAID_BYTES: Final = 256
RESCUE_BYTES: Final = JUMP_BYTES + SAID_BYTES
RESCUE_ALIGNMENT: Final = 16
"""Memory of `rescued`: where to jump to, and then what the error said, up to a zero; its address is a multiple."""

KEY_SYMBOL: Final = "softfinger_rescue_key"
LOG_ERROR: Final = 3
"""Level of a message (mjtLogLevel), its first int32."""
SUBJECT: Final = 8
"""Where the words of a message (mjLogMessage) begin."""

_key: Final = ctypes.c_uint32()
if ctypes.CDLL(None).pthread_key_create(ctypes.byref(_key), None) != 0:
    raise ImportError("this process has no more keys for memory of threads (pthread_key_create)")
llvm.add_symbol(KEY_SYMBOL, ctypes.addressof(_key))

_getspecific: Any = types.ExternalFunction("pthread_getspecific", types.int64(types.uint32))
_setspecific: Any = types.ExternalFunction("pthread_setspecific", types.int32(types.uint32, types.int64))
_longjmp: Any = types.ExternalFunction("longjmp", types.void(types.int64, types.int32))
_pause: Any = types.ExternalFunction("pause", types.int32())


def _read_key(typing_context: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        known = builder.module.globals.get(KEY_SYMBOL)
        return builder.load(known or ir.GlobalVariable(builder.module, ir.IntType(32), KEY_SYMBOL))

    return types.uint32(), build


_rescue_key: Any = intrinsic(_read_key)
"""The key under which a thread has the memory of the call that it is in, 0 outside of `rescued`."""


def _between(module: Any) -> Any:
    """int32 f(int64 address, int64 a, int64 b, int64 memory): 0 once the call is over, 1 where it was jumped out of."""
    known = module.globals.get("rescue_call")
    if known is not None:
        return known
    word, status = ir.IntType(64), ir.IntType(32)
    function = ir.Function(module, ir.FunctionType(status, [word] * 4), "rescue_call")
    function.linkage = "internal"
    for attribute in ("noinline", "optnone"):
        function.attributes.add(attribute)
    name = "_setjmp"  # it leaves the mask of signals as it is, which would be a system call
    setjmp = module.globals.get(name) or ir.Function(module, ir.FunctionType(status, [word]), name)
    setjmp.attributes.add("returns_twice")
    builder = ir.IRBuilder(function.append_basic_block("begin"))
    address, a, b, memory = function.args
    back = builder.icmp_signed("!=", builder.call(setjmp, [memory]), ir.Constant(status, 0))
    with builder.if_then(back):
        builder.ret(ir.Constant(status, 1))
    builder.call(builder.inttoptr(address, ir.PointerType(ir.FunctionType(ir.VoidType(), [word, word]))), [a, b])
    builder.ret(ir.Constant(status, 0))
    return function


def _between_of(typing_context: Any, address: Any, a: Any, b: Any, memory: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.call(_between(builder.module), arguments)

    word = types.int64
    return types.int32(word, word, word, word), build


_call_between: Any = intrinsic(_between_of)


@jit
def rescued(address: int, a: int, b: int, memory: int) -> int:
    """void f(int64 a, int64 b) at `address`; 0, or 1 where it met an error, whose words are in `memory` then.

    memory  address of RESCUE_BYTES, of this call alone
    """
    _setspecific(_rescue_key(), memory)
    failed = _call_between(address, a, b, memory)
    _setspecific(_rescue_key(), 0)
    return int(failed)


@c_function(types.void(types.int64), on_demand=True)
def jump_on_error(message: int) -> None:
    """Handler of MuJoCo's messages: warnings are passed over, for they are counted; behind an error it may not return.

    An error outside of `rescued` has no way back: its thread sleeps for ever, rather than that the process ends with
    whatever force a device displays.
    """
    if int32_at(message)[0] != LOG_ERROR:
        return
    memory = _getspecific(_rescue_key())
    while memory == 0:
        _pause()
    said, words = uint8_at(memory + JUMP_BYTES), uint8_at(message + SUBJECT)
    for i in range(SAID_BYTES - 1):
        said[i] = words[i]
        said[i + 1] = 0
        if words[i] == 0:
            break
    _longjmp(memory, 1)


def words_in(memory: int) -> str:
    """What the error said that a call was jumped out of, in one line."""
    return " ".join(ctypes.string_at(memory + JUMP_BYTES).decode("utf-8", "replace").split())
