"""Compiled exchanges of the drivers that call a library do not allocate."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import pytest

from softfinger.drivers.falcon import exchange as falcon
from softfinger.drivers.forcedimension import exchange as forcedimension

ALLOCATORS = ("NRT_Allocate", "NRT_MemInfo_alloc", "malloc")


@pytest.mark.parametrize("exchange", [falcon, forcedimension], ids=["falcon", "forcedimension"])
def test_exchange_allocates_nothing(exchange: Any) -> None:
    compile_fresh = numba.cfunc(exchange.IO_SIGNATURE, error_model="numpy")

    def allocates(handle: int, values: Any) -> int:
        return len(np.zeros(handle))

    assert any(name in compile_fresh(allocates).inspect_llvm() for name in ALLOCATORS)
    for function in (exchange.read, exchange.write):
        code = compile_fresh(function._pyfunc).inspect_llvm()
        assert "inttoptr" in code  # it is the code that calls the library
        assert not any(name in code for name in ALLOCATORS)
