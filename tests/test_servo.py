"""The servo loop: what it may call, what it must not do, and how it ends."""

import ctypes
import os
import re
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from compiled_code import called_in, functions
from faulty_device import FaultyDevice, Options

from softfinger.config.load import load_rig, load_scene
from softfinger.proxy.state import OFFSET, RECORD_SIZE
from softfinger.server import servo as s
from softfinger.server.guard import POSE_REFUSED
from softfinger.server.tuning import make_tuning

MAY_CALL = {"clock_gettime", "clock_nanosleep", "eventfd_write", "atan2"}
"""Everything outside itself that the loop may name: clock, sleep, wake-up, and libm."""

AUDIT = """
import sys
from softfinger.config.load import load_rig, load_scene
from softfinger.server.app import open_device
from softfinger.server.servo import Servo, servo_loop
from softfinger.server.tuning import make_tuning
rig = load_rig("replay")
with open_device(rig.device, 1000.0) as device:
    servo = Servo(device, make_tuning(load_scene("paper-plane"), rig.guard), 1000.0)
    cached = servo.compile()
print("cached" if cached else "fresh", file=sys.stderr)
if not cached:
    print(*servo_loop.inspect_llvm().values())
"""


def run_python(code: str, cache: Path, **options: object) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"SOFTFINGER_CACHE_DIR": str(cache)}
    return subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True, **options
    )


@pytest.fixture(scope="module")
def fresh_cache(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A cache directory filled by a fresh compile in a process of its own, and the IR of that compile."""
    cache = tmp_path_factory.mktemp("kernels")
    done = run_python(AUDIT, cache)
    assert done.stderr.strip().endswith("fresh")
    return cache, done.stdout


def test_loop_calls_only_what_is_listed(fresh_cache):
    """A fresh compile of the loop and all it calls names no allocator, no reference count, no interpreter."""
    bodies = functions(fresh_cache[1])
    assert any("servo_loop" in name for name in bodies)
    called = {name for body in bodies.values() for name in called_in(body)}
    outside = {name for name in called if name not in bodies and not name.startswith("llvm.")}
    assert outside == MAY_CALL
    # Beside the named ones only the device is called, through its two addresses: read, write, and the last zero.
    through_pointers = {
        name: len(re.findall(r"call [\w ]*%[\w.]+\(", body)) for name, body in bodies.items() if "call" in body
    }
    assert [count for count in through_pointers.values() if count] == [3]
    assert through_pointers[next(name for name in bodies if "servo_loop" in name)] == 3


def test_second_process_starts_from_the_cache(fresh_cache):
    """What one process compiled, the next one loads."""
    assert run_python(AUDIT, fresh_cache[0]).stderr.strip().endswith("cached")


def test_allocating_kernel_does_not_compile():
    """The options of every kernel leave the allocator out, so a kernel that allocates is refused by the compiler."""
    import numba

    from softfinger.proxy.kernels.jit import jit

    @jit
    def allocates(n):
        return np.zeros(n)[0]

    with pytest.raises(numba.TypingError):
        allocates(3)


def test_changed_source_means_another_cache(tmp_path):
    """An edit in any source file, also one that kernels only inline, moves the cache to another directory."""
    package = tmp_path / "softfinger"
    source = Path(s.__file__).resolve().parents[1]
    for folder in ("config", "drivers", "proxy", "server", "tools"):
        shutil.copytree(source / folder, package / folder, ignore=shutil.ignore_patterns("__pycache__"))
    code = "from softfinger.proxy.kernels.jit import CACHE_DIR; print(CACHE_DIR)"
    site = os.pathsep.join([str(tmp_path), *[path for path in sys.path if path.endswith("site-packages")]])

    def cache_dir() -> str:
        environment = os.environ | {"PYTHONPATH": site}
        command = [sys.executable, "-S", "-c", code]  # without site: the installed package must not come first
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.strip()

    before = cache_dir()
    assert cache_dir() == before
    kernel = package / "proxy" / "kernels" / "torsion.py"
    kernel.write_text(kernel.read_text() + "\nTWICE = 2.0\n")
    assert cache_dir() != before


def make_servo(
    options: Options, ticks: int | None, prepare: Callable[[], Callable[[], None]] | None = None, rate: float = 1000.0
) -> tuple[FaultyDevice, s.Servo]:
    device = FaultyDevice(options)
    tuning = make_tuning(load_scene("paper-plane"), load_rig("replay").guard)
    servo = s.Servo(device, tuning, rate, ticks, prepare)
    servo.compile()
    return device, servo


def finish(servo: s.Servo) -> tuple[s.Ended, np.ndarray]:
    """Start, wait for the end, and take what the ring still holds."""
    servo.start()
    ended = servo.join(30.0)
    assert ended is not None
    out = np.empty((16384, RECORD_SIZE))
    records = out[: servo.take(out)]
    servo.close()
    return ended, records


@pytest.mark.parametrize(
    ("fault", "ending", "status"),
    [
        ("none", s.FINISHED, 0),
        ("lost", s.READ_FAILED, -1),
        ("timeout", s.READ_FAILED, -2),
        ("protocol", s.READ_FAILED, -3),
        ("write_lost", s.WRITE_FAILED, -1),
    ],
)
def test_every_end_of_the_loop_writes_zero(fault, ending, status):
    """However the loop ends, force was on before and the last wrench the device got is zero."""
    device, servo = make_servo(Options(fault=fault, at=300), 400)
    ended, _ = finish(servo)
    assert (ended.ending, ended.status, ended.error) == (ending, status, None)
    wrenches = device.wrenches
    assert np.abs(wrenches[-10:-2]).max() > 0.1
    assert not wrenches[-1].any()


def test_stop_word_ends_the_loop_with_zero():
    """A stop from another thread ends the loop in order, with zero force."""
    device, servo = make_servo(Options(), None)
    servo.start()
    while servo.ticks < 300:
        servo.wait_record()
    servo.stop()
    ended = servo.join(30.0)
    assert ended == s.Ended(s.STOPPED, 0)
    assert np.abs(device.wrenches[-3]).max() > 0.1 and not device.wrenches[-1].any()
    servo.close()


def test_exception_in_the_servo_thread_zeroes_the_device():
    """When the preparation of the thread fails, the device is stopped and the error is handed on."""

    def prepare():
        raise RuntimeError("refused")

    device, servo = make_servo(Options(), 100, prepare)
    ended, _ = finish(servo)
    assert ended.ending == s.CRASHED and str(ended.error) == "refused"
    assert len(device.wrenches) == 1 and not device.wrenches[-1].any()


@pytest.mark.parametrize("fault", ["nan", "zero_quaternion", "far"])
def test_unusable_pose_means_zero_force_at_once(fault):
    """A pose that is no pose zeroes the force in its tick; afterwards the force ramps in again from nothing."""
    device, servo = make_servo(Options(fault=fault, at=700), 900)
    _, records = finish(servo)
    wrenches = device.wrenches
    assert np.abs(wrenches[699, 2]) > 0.9 and not wrenches[700].any()
    assert 0.0 < wrenches[701, 2] < 0.01
    assert np.isfinite(wrenches).all() and np.isfinite(records).all()
    assert int(records[700, OFFSET["servo.guard"]]) == POSE_REFUSED
    assert records[700, OFFSET["contact.mode"]] == 0


@pytest.mark.parametrize("own_clock", [False, True])
def test_missed_deadlines_are_counted_and_not_caught_up(own_clock):
    """After a stall the loop goes on along the same grid, one tick each, and the time step tells the truth."""
    _, servo = make_servo(Options(fault="stall", at=50, stall_us=5500, own_clock=own_clock), 200)
    _, records = finish(servo)
    ticks, missed, dt = (records[:, OFFSET[name]] for name in ("tick", "servo.missed", "dt"))
    assert ticks.tolist() == list(range(200))
    assert missed[51] - missed[50] >= 5  # more, if the machine itself stalled in that moment
    steps = np.ones(200) if own_clock else 1.0 + np.diff(missed, prepend=0.0)
    assert dt.tolist() == (steps * 0.001).tolist()
    # Deadlines stay on one grid: wake-up time less lateness is a multiple of the period after the first.
    deadline = records[:, OFFSET["timestamp"]] - records[:, OFFSET["servo.late"]]
    phase = (deadline - deadline[0]) / 0.001
    # A float64 of the seconds since the epoch resolves 0.24 us, twice.
    assert np.abs(phase - np.round(phase)).max() < 1e-3
    assert np.array_equal(np.round(np.diff(phase)), 1.0 + np.diff(missed))


def test_loop_runs_while_python_holds_the_interpreter_lock():
    """Ticks go on while another thread sits in C code with the interpreter lock held."""
    _, servo = make_servo(Options(), None)
    servo.start()
    while servo.ticks < 10:
        servo.wait_record()
    before = int(servo.shared.progress[0])
    ctypes.PyDLL(None).usleep(300_000)  # PyDLL keeps the lock
    after = int(servo.shared.progress[0])
    servo.stop()
    servo.join(30.0)
    servo.close()
    assert after - before > 100  # of 300


def test_no_page_fault_in_the_loop():
    """Five thousand ticks cost no more page faults than fifty do."""

    def faults_of(ticks: int) -> int:
        seen = []

        def note() -> None:
            seen.append(resource.getrusage(resource.RUSAGE_THREAD).ru_minflt)

        def prepare() -> Callable[[], None]:
            note()
            return note

        _, servo = make_servo(Options(), ticks, prepare, rate=8000.0)
        finish(servo)
        return seen[1] - seen[0]

    faults_of(50)
    # The device keeps its wrenches in fresh memory: 48 bytes a tick, a page every 85 ticks.
    kept_by_device = 5000 * 48 // 4096 + 1
    assert faults_of(5000) - faults_of(50) <= kept_by_device + 2


SHIM = """
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stddef.h>
static __thread long count;
long allocations(void) { return count; }
extern void *__libc_malloc(size_t), *__libc_calloc(size_t, size_t), *__libc_realloc(void *, size_t);
void *malloc(size_t n) { count++; return __libc_malloc(n); }
void *calloc(size_t n, size_t m) { count++; return __libc_calloc(n, m); }
void *realloc(void *p, size_t n) { count++; return __libc_realloc(p, n); }
"""

COUNT = """
import ctypes, sys
sys.path.insert(0, sys.argv[1])
from faulty_device import Options
from test_servo import make_servo, finish
shim = ctypes.CDLL(None)
shim.allocations.restype = ctypes.c_long
def count(ticks):
    seen = []
    def prepare():
        seen.append(shim.allocations())
        return lambda: seen.append(shim.allocations())
    _, servo = make_servo(Options(), ticks, prepare, rate=8000.0)
    finish(servo)
    return seen[1] - seen[0]
count(10)
print(count(10), count(8000))
"""


@pytest.mark.skipif(shutil.which("cc") is None, reason="counting calls of malloc needs a C compiler to build the shim")
def test_loop_never_calls_malloc(tmp_path):
    """A shim that counts every malloc of the servo thread counts the same for ten ticks and for eight thousand."""
    source, library = tmp_path / "shim.c", tmp_path / "shim.so"
    source.write_text(SHIM)
    subprocess.run(["cc", "-shared", "-fPIC", "-o", str(library), str(source)], check=True)
    done = subprocess.run(
        [sys.executable, "-c", COUNT, str(Path(__file__).parent)],
        env=os.environ | {"LD_PRELOAD": str(library)}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    few, many = map(int, done.stdout.split())
    assert few > 0  # the shim does count: entering the loop from Python allocates
    assert many == few


def test_parameters_change_without_stopping():
    """A new friction coefficient takes effect at a later tick, in the loop that is already compiled."""
    device, servo = make_servo(Options(), None)
    tuning = make_tuning(load_scene("paper-plane"), load_rig("replay").guard)
    thing = tuning.scene.objects[0]
    friction = thing.material.friction._replace(static=0.1, kinetic=0.1)
    slippery = thing._replace(material=thing.material._replace(friction=friction))
    servo.start()
    while servo.ticks < 1000:
        servo.wait_record()
    changed_at = servo.ticks
    servo.tune(tuning._replace(scene=tuning.scene._replace(objects=(slippery,))))
    while servo.ticks < changed_at + 500:
        servo.wait_record()
    servo.stop()
    servo.join(30.0)
    servo.close()
    tangential = np.linalg.norm(device.wrenches[:, :2], axis=1)
    assert tangential[600:changed_at].max() > 0.4
    # The guard's slew limit takes at most a tick; 1 N pressed and mu 0.1 leave 0.1 N, to rounding.
    assert tangential[changed_at + 5 : -1].max() <= 0.1 * (1 + 1e-9)


def test_other_parts_are_refused():
    """A tuning with other parts than the compiled one would need another loop."""
    _, servo = make_servo(Options(), 10)
    tuning = make_tuning(load_scene("frictionless-plane"), load_rig("replay").guard)
    with pytest.raises(ValueError, match="other parts"):
        servo.tune(tuning)
    finish(servo)
