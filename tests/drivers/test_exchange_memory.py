"""Compiled exchanges of the drivers: with a library they do not allocate, without one they call only libc."""

import re
from typing import Any

import numba
import numpy as np
import pytest
from helpers.compiled_code import called_in, functions
from numba import types

from softfinger.drivers import wrench_log
from softfinger.drivers.falcon import exchange as falcon
from softfinger.drivers.forcedimension import exchange as forcedimension
from softfinger.drivers.haply import exchange as haply
from softfinger.drivers.hid import exchange as hid
from softfinger.drivers.replay import device as replay
from softfinger.drivers.serial import exchange as serial
from softfinger.drivers.simulated import device as simulated
from softfinger.drivers.spacemouse import device as spacemouse
from softfinger.drivers.system.libc import IO_SIGNATURE

ALLOCATORS = ("NRT_Allocate", "NRT_MemInfo_alloc", "malloc")
EVERY = {"clock_gettime", "__errno_location", "NRT_MemInfo_call_dtor"}
"""Includes the destructor of a view on foreign memory, which is never reached."""
ARM = {"read", "write", "poll", "sin", "cos", "sqrt", "acos", "atan"}
PUCK = {"read", "sin", "cos", "atan2"}
FORCE_ON_SERIAL = types.int64(types.int64, types.UniTuple(types.float64, 3))
PACKETS = types.UniTuple(types.int64, 2)(types.int64, types.int64)
UNIT = re.compile("softfinger_unit_(_send|_read_packets)_")
"""Functions of the serial driver that are compiled separately."""


@pytest.mark.parametrize("exchange", [falcon, forcedimension], ids=["falcon", "forcedimension"])
def test_exchange_allocates_nothing(exchange: Any) -> None:
    compile_fresh = numba.cfunc(IO_SIGNATURE, error_model="numpy")

    def allocates(handle: int, values: Any) -> int:
        return len(np.zeros(handle))

    assert any(name in compile_fresh(allocates).inspect_llvm() for name in ALLOCATORS)
    for function in (exchange.read, exchange.write):
        code = compile_fresh(function._pyfunc).inspect_llvm()
        assert "inttoptr" in code  # it is the code that calls the library
        assert not any(name in code for name in ALLOCATORS)


@pytest.mark.parametrize(
    ("function", "signature", "allowed"),
    [
        (haply.read, IO_SIGNATURE, {"write", "sqrt"}), (haply.write, IO_SIGNATURE, {"write", "sqrt"}),
        (hid.read, IO_SIGNATURE, ARM), (hid.write, IO_SIGNATURE, ARM),
        (serial.read, IO_SIGNATURE, ARM | {"ioctl"}), (serial.write, IO_SIGNATURE, ARM | {"ioctl"}),
        (serial._send, FORCE_ON_SERIAL, ARM | {"ioctl"}), (serial._read_packets, PACKETS, ARM | {"ioctl"}),
        (spacemouse.read, IO_SIGNATURE, PUCK), (simulated._read_led_by_puck, IO_SIGNATURE, PUCK),
    ],
)  # fmt: skip
def test_exchange_calls_only_libc(function: Any, signature: Any, allowed: set[str]) -> None:
    # without the wrapper that would report an exception, which `error_model="numpy"` never raises
    bodies = functions(numba.cfunc(signature, error_model="numpy")(function.__wrapped__).inspect_llvm())
    called = {name for body in bodies.values() for name in called_in(body)}
    outside = {name for name in called if not name.startswith("llvm.") and name not in bodies}
    assert "read" in outside or allowed is not PUCK
    assert "write" in outside or function is not serial._send
    assert outside and ("clock_gettime" in outside or signature is not IO_SIGNATURE)
    assert {name for name in outside if not UNIT.match(name)} <= EVERY | allowed


@pytest.mark.parametrize(
    ("function", "allowed"),
    [(replay._read, set()), (wrench_log.write, set()), (wrench_log.silence, set()), (simulated._read, {"atan2"})],
)
def test_devices_without_hardware_neither_allocate_nor_raise(function: Any, allowed: set[str]) -> None:
    code = numba.cfunc(function._sig, error_model="numpy")(function._pyfunc).inspect_llvm()
    bodies = [part for part in re.findall(r"^define .*?^}", code, re.M | re.S) if "%retptr" in part.split("\n")[0]]
    assert bodies
    for body in bodies:
        assert set(re.findall(r"\bret (.*)", body)) == {"i32 0"}
        assert {name for name in re.findall(r"call [^@\n]*@([\w.]+)", body) if not name.startswith("llvm.")} <= allowed
