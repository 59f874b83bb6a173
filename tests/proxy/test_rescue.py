"""`rescue.py` returns from MuJoCo's fatal errors; in subprocesses, since MuJoCo has one error handler per process."""

import os
import sys
from pathlib import Path

import pytest
from helpers.programs import run_program

pytestmark = pytest.mark.real_time

HEAD = """
import ctypes, os, sys, threading
import numpy as np
if sys.argv[1:]:  # keys of others, so that ours has another number
    spare = ctypes.c_uint32()
    for _ in range(int(sys.argv[1])):
        ctypes.CDLL(None).pthread_key_create(ctypes.byref(spare), None)
import mujoco
from softfinger.config.mjcf import load_library
from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.proxy.kernels.jit.rescue import RESCUE_ALIGNMENT, RESCUE_BYTES, jump_on_error, call_rescued, words_in
library = load_library(mujoco)
library.mju_setLogHandler.argtypes = (ctypes.c_void_p,)
library.mju_setLogHandler(jump_on_error.address)
STEP = ctypes.cast(library.mj_step, ctypes.c_void_p).value
XML = '<mujoco><worldbody><body><freejoint/><geom size="0.1"/></body></worldbody></mujoco>'

@entry
def steps(address: int, model: int, data: int, memory: int, count: int) -> tuple[int, float]:
    failed, total = 0, 0.0
    for i in range(count):
        half = 0.5 * i
        failed += call_rescued(address, model, data, memory)
        total += half  # a value from before the jump
    return failed, total

def model_and_data(integrator):
    model = mujoco.MjModel.from_xml_string(XML)
    model.opt.integrator = integrator
    return model, mujoco.MjData(model)

def stepped(model, data, count):
    buffer = np.zeros(RESCUE_BYTES + RESCUE_ALIGNMENT, np.uint8)
    memory = -(-buffer.ctypes.data // RESCUE_ALIGNMENT) * RESCUE_ALIGNMENT
    return *steps(STEP, model._address, data._address, memory, count), words_in(memory)
"""


def output_of(code: str, *words: str, **environment: str) -> str:
    variables = os.environ | {"NUMBA_DISABLE_JIT": "0"} | environment
    return run_program([sys.executable, "-c", HEAD + code, *words], env=variables, check=True).stdout.strip()


ERRORS = """
print(*stepped(*model_and_data(77), 3), jump_on_error._cache.cache_path != '')
"""
RETURN = """
model, data = model_and_data(77)
print(*stepped(model, data, 100))
model.opt.integrator = 0
mujoco.mj_resetData(model, data)
print(*stepped(model, data, 100), round(data.time, 6))
model.opt.integrator = 77
try:
    mujoco.mj_step(model, data)
except mujoco.FatalError as error:
    print(error)
"""
THREADS = """
outcome, cases = {}, [(k, *model_and_data(77 if k % 2 else 0)) for k in range(4)]
stepped(*cases[0][1:], 1)
gate = threading.Barrier(4)
def work(k, model, data):
    gate.wait()
    outcome[k] = stepped(model, data, 20000)
threads = [threading.Thread(target=work, args=case) for case in cases]
for thread in threads: thread.start()
for thread in threads: thread.join()
print(*(outcome[k][0] for k in range(4)), outcome[1][2])
"""
NO_WAY_BACK = """
model, data = model_and_data(77)
step = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)(STEP)
asleep = threading.Thread(target=lambda: step(model._address, data._address), daemon=True)
asleep.start()
asleep.join(1.0)
print(asleep.is_alive(), flush=True)
os._exit(0)
"""


def test_the_caller_continues_after_an_error(tmp_path: Path) -> None:
    """A hundred errors in a row return MuJoCo's message and leave the caller's values. After a reset the data advances,
    and Python's call still raises. Of four threads, two of which fail in each call, each jumps to its own call; a
    thread outside of `call_rescued` sleeps. One process compiles the handler, another with another thread key loads
    it."""
    cache, total = str(tmp_path / "kernels"), 0.5 * sum(range(100))
    first = output_of(ERRORS, "0", SOFTFINGER_CACHE_DIR=cache)
    assert first == "3 1.5 invalid integrator True"
    assert list(Path(cache).rglob("jump_on_error*.kernel"))
    lines = output_of(ERRORS + RETURN + THREADS + NO_WAY_BACK, "5", SOFTFINGER_CACHE_DIR=cache).splitlines()
    assert lines[:2] == [first, f"100 {total} invalid integrator"]
    assert lines[2].split() == ["0", str(total), "0.2"] and "invalid integrator" in lines[3]
    assert lines[4:] == ["0 20000 0 20000 invalid integrator", "True"]
