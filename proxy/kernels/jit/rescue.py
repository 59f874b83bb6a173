"""Calls of a C library that would end the process on an error: they return an error number instead.

MuJoCo reports an error deep inside a step to a handler, and ends the process when that returns. So the handler does not
return: it jumps back to before the call (setjmp, longjmp). Consequences, all confined to this file:

- A function in which setjmp returns twice is neither optimised nor inlined: values in registers would be lost.
  `_make_jump` builds a function that only calls setjmp and the library.
- There is one handler for the process, but a jump belongs to a thread: the target of the jump is thread-specific data
  of pthread, found by a key.
- The handler is cached on disk like every kernel, but the number of the key belongs to this process: the handler reads
  it through a symbol, KEY_SYMBOL.
- Incomplete work of the library is not undone: after an error its data must be reset or discarded.

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
"""Size reserved for a jmp_buf: 200 bytes with glibc on x86-64, 312 on AArch64."""
MESSAGE_BYTES: Final = 256
RESCUE_BYTES: Final = JUMP_BYTES + MESSAGE_BYTES
RESCUE_ALIGNMENT: Final = 16
"""Alignment of the memory of `call_rescued`: the target of the jump, then the error message, zero-terminated."""

KEY_SYMBOL: Final = "softfinger_rescue_key"
LOG_ERROR: Final = 3
"""Level of an error message (mjtLogLevel); a message starts with its level, int32."""
TEXT_OFFSET: Final = 8
"""Offset of the text in a message (mjLogMessage)."""

_key: Final = ctypes.c_uint32()
if ctypes.CDLL(None).pthread_key_create(ctypes.byref(_key), None) != 0:
    raise ImportError("this process has no free key for thread-specific memory (pthread_key_create)")
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
"""Key of the thread-specific address of the memory of the current call; the address is 0 outside of `call_rescued`."""


def _make_jump(module: Any) -> Any:
    """Return int32 f(int64 address, int64 a, int64 b, int64 memory): 0 after a call, 1 after a jump out of it."""
    known = module.globals.get("rescue_call")
    if known is not None:
        return known
    word, status = ir.IntType(64), ir.IntType(32)
    function = ir.Function(module, ir.FunctionType(status, [word] * 4), "rescue_call")
    function.linkage = "internal"
    for attribute in ("noinline", "optnone"):
        function.attributes.add(attribute)
    name = "_setjmp"  # it does not save the signal mask, which would be a system call
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
        return builder.call(_make_jump(builder.module), arguments)

    word = types.int64
    return types.int32(word, word, word, word), build


_call_between: Any = intrinsic(_between_of)


@jit
def call_rescued(address: int, a: int, b: int, memory: int) -> int:
    """Call void f(int64 a, int64 b) at `address`; return 0, or 1 after an error, with its message in `memory`.

    memory  address of RESCUE_BYTES, used only by this call
    """
    _setspecific(_rescue_key(), memory)
    failed = _call_between(address, a, b, memory)
    _setspecific(_rescue_key(), 0)
    return int(failed)


@c_function(types.void(types.int64), on_demand=True)
def jump_on_error(message: int) -> None:
    """Handle MuJoCo's messages: ignore warnings, which are counted elsewhere, and do not return after an error.

    After an error outside of `call_rescued` there is no target to jump to. Its thread then sleeps forever: ending the
    process would leave the device with its present force.
    """
    if int32_at(message)[0] != LOG_ERROR:
        return
    memory = _getspecific(_rescue_key())
    while memory == 0:
        _pause()
    text, words = uint8_at(memory + JUMP_BYTES), uint8_at(message + TEXT_OFFSET)
    for i in range(MESSAGE_BYTES - 1):
        text[i] = words[i]
        text[i + 1] = 0
        if words[i] == 0:
            break
    _longjmp(memory, 1)


def words_in(memory: int) -> str:
    """Return the error message of an interrupted call, on one line."""
    return " ".join(ctypes.string_at(memory + JUMP_BYTES).decode("utf-8", "replace").split())
