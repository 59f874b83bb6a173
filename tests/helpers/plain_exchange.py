"""Replace the C functions of the drivers by plain Python behind a C address, for `tests/sweep.py`.

Compiling the exchange of one driver would take half a minute of CPU time for each planted mistake. `install` is called
with NUMBA_DISABLE_JIT set, before a driver is imported. Operations that only machine code can do (calls of the C
library and of vendor libraries, atomic words) are done by ctypes.
"""

from __future__ import annotations

import ctypes
import struct
import threading
from collections.abc import Callable
from typing import Any, Final

from numba import types

_C: Final = ctypes.CDLL(None, use_errno=True)
_OF_TYPE: Final = {
    types.int64: ctypes.c_int64,
    types.int32: ctypes.c_int32,
    types.uint32: ctypes.c_uint32,
    types.uint64: ctypes.c_uint64,
    types.float64: ctypes.c_double,
    types.void: None,
}
_ATOMIC: Final = threading.Lock()


def _in_c(kind: Any, result: bool = False) -> Any:
    if isinstance(kind, types.CPointer):
        return ctypes.c_void_p if result else ctypes.POINTER(_OF_TYPE[kind.dtype])
    return _OF_TYPE[kind]


def _external(name: str, signature: Any) -> Any:
    """Call a function of the C library, named as by types.ExternalFunction."""
    if name == "__errno_location":
        return lambda: [ctypes.get_errno()]
    function = _C[name]
    function.restype = _in_c(signature.return_type, result=True)
    function.argtypes = [
        ctypes.c_void_p if isinstance(kind, types.CPointer) else _in_c(kind) for kind in signature.args
    ]
    return function


def _called(result: Any) -> Callable[[int, tuple[Any, ...]], Any]:
    """Call the function at an address with the values of a tuple, like proxy.kernels.jit.foreign."""

    def call(address: int, arguments: tuple[Any, ...]) -> Any:
        values = [ctypes.c_double(value) if isinstance(value, float) else _whole(value) for value in arguments]
        return ctypes.CFUNCTYPE(result, *(type(value) for value in values))(int(address))(*values)

    return call


def _whole(value: Any) -> Any:
    if isinstance(value, int):
        return ctypes.c_int64(value)
    if hasattr(value, "dtype"):
        return ctypes.c_int32(int(value)) if value.itemsize == 4 else ctypes.c_int64(int(value))
    return ctypes.cast(value, ctypes.c_void_p)


class _Both(ctypes.Structure):
    _fields_ = (("first", ctypes.c_int64), ("second", ctypes.c_int64))


def _call_two_int64(address: int, arguments: tuple[Any, ...]) -> tuple[int, int]:
    both = _called(_Both)(address, arguments)
    return both.first, both.second


def exchange_int64(address: int, value: int) -> int:
    """Like the function in proxy.kernels.jit.memory."""
    with _ATOMIC:
        word = ctypes.c_int64.from_address(int(address))
        before, word.value = word.value, value
        return before


def unpack_at(like: Any, address: int) -> Any:
    """Like the function in proxy.kernels.jit.pack."""
    from softfinger.proxy.kernels.jit import pack

    leaves = len(pack.flatten(like))
    return pack.unflatten(like, list((ctypes.c_double * leaves).from_address(int(address))))


def _load(array: Any, index: int) -> int:
    return int(array[index])


def _store(array: Any, index: int, value: int) -> None:
    array[index] = value


def _no_fence() -> None:
    """Do nothing: plain Python executes in order."""


ORDERED: Final[dict[str, Callable[..., Any]]] = {
    "load_acquire": _load, "load_relaxed": _load, "store_release": _store, "store_relaxed": _store,
    "fence_acquire": _no_fence, "fence_release": _no_fence,
}  # fmt: skip
"""Words of memory, like those of proxy.kernels.jit.atomics."""


def _put_big_endian(array: Any, index: int, value: float) -> None:
    array[index : index + 8] = list(struct.pack(">d" if isinstance(value, float) else ">q", value))


def _in_c_function(self: Any) -> Any:
    """Return the function behind a C address; it is cached because an address is not a reference."""
    if not hasattr(self, "plain"):
        signature = self._sig
        arguments = [_in_c(kind) for kind in signature.args]
        self.plain = ctypes.CFUNCTYPE(_in_c(signature.return_type), *arguments)(
            lambda *arguments: self._pyfunc(*arguments)  # looked up at each call: a mistake may have been planted since
        )
    return self.plain


def install() -> None:
    types.ExternalFunction = _external
    from softfinger.proxy.kernels.jit import atomics, foreign, memory, pack
    from softfinger.proxy.kernels.jit.compiler.numba_internals import CFunction

    memory.exchange_int64, memory.put_big_endian = exchange_int64, _put_big_endian
    memory.address_of = lambda array, index: array.ctypes.data + index * array.itemsize
    foreign.call_int32, foreign.call_void = _called(ctypes.c_int32), _called(None)  # type: ignore[assignment]
    foreign.call_two_int64 = _call_two_int64
    for name, does in ORDERED.items():
        setattr(atomics, name, does)
    device = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64, ctypes.c_void_p)
    atomics.call_device = lambda address, handle, values: device(address)(handle, values.ctypes.data)

    pack.unpack_at = unpack_at
    CFunction.address = property(lambda self: ctypes.cast(_in_c_function(self), ctypes.c_void_p).value)
    CFunction.ctypes = property(_in_c_function)
