"""Kernels compiled afresh, once: what the loop may call, what is kept of it and where, and who finds it there.

It compiles the loop of the shipped scene, some 15 s, for it is the compiler's own output that is looked at.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.compiled_code import called_in, functions

from softfinger.config.load import describe, load_scene
from softfinger.server.loop import servo_thread

MAY_CALL = {"clock_gettime", "clock_nanosleep", "eventfd_write", "atan2"}
"""Everything outside itself that the loop may name: clock, sleep, wake-up, and libm."""

COMPILER = """
from softfinger.server.loop.servo import servo_loop
from softfinger.server.services import compilation
compilation.main()
print(*servo_loop.inspect_llvm().values())
"""
"""The process that a daemon has compile another scene, which then says what it made."""


@pytest.fixture(scope="module")
def fresh(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A cache directory that was filled by the daemon's compiler, and the IR of what it compiled."""
    cache = tmp_path_factory.mktemp("kernels")
    compiler = subprocess.Popen(
        [sys.executable, "-c", COMPILER],
        env=os.environ | {"SOFTFINGER_CACHE_DIR": str(cache)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    with compiler:
        try:
            assert compiler.stdin is not None and compiler.stdout is not None
            compiler.stdin.write(json.dumps(describe(load_scene("paper-plane"))) + "\n")
            compiler.stdin.flush()  # and left open: its end would end the compiler
            told = compiler.stdout.read()
        finally:
            compiler.stdin.close()  # type: ignore[union-attr]
    assert compiler.returncode == 0
    return cache, told


def kept(cache: Path) -> dict[str, int]:
    """Kernels on disk by name, each with when it was written, ns."""
    return {path.name: path.stat().st_mtime_ns for path in cache.rglob("*.kernel")}


def test_loop_calls_only_what_is_listed(fresh: tuple[Path, str]) -> None:
    """A fresh compile of the loop and all it calls names no allocator, no reference count, no interpreter."""
    bodies = functions(fresh[1])
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


def test_what_the_compiler_and_warmup_leave_is_all_that_is_needed(fresh: tuple[Path, str]) -> None:
    """The compiler of a running daemon keeps the loop; `warmup` finds it there, adds what other verbs call, and says
    where; a second one, and a daemon, compile nothing."""
    cache, _ = fresh
    loops = {name: written for name, written in kept(cache).items() if name.startswith("servo_loop-")}
    assert len(loops) == 1
    environment = os.environ | {"SOFTFINGER_CACHE_DIR": str(cache)}
    words = [sys.executable, "-m", "softfinger.server.cli"]
    warm = [*words, "warmup", "paper-plane"]
    first = subprocess.run(warm, env=environment, capture_output=True, text=True, check=True)
    assert str(cache) in first.stdout
    after = kept(cache)
    assert loops.items() <= after.items() and len(after) > len(loops)
    subprocess.run(warm, env=environment, capture_output=True, text=True, check=True)
    brief = ["run", "--duration", "0.2", "--realtime", "off", "--endpoint", "tcp://127.0.0.1:*", "--commands", "off"]
    subprocess.run([*words, *brief], env=environment, capture_output=True, text=True, check=True)
    assert kept(cache) == after


def test_allocating_kernel_does_not_compile() -> None:
    """The options of every kernel leave the allocator out, so a kernel that allocates is refused by the compiler."""
    import numba

    from softfinger.proxy.kernels.native.jit import jit

    @jit
    def allocates(n: int) -> float:
        return np.zeros(n)[0]

    with pytest.raises(numba.TypingError):
        allocates(3)


def test_changed_source_means_another_cache(tmp_path: Path) -> None:
    """An edit in any source file, also one that kernels only inline, moves the cache to another directory."""
    package = tmp_path / "softfinger"
    source = Path(servo_thread.__file__).resolve().parents[2]
    for folder in ("config", "drivers", "proxy", "server", "tools"):
        shutil.copytree(source / folder, package / folder, ignore=shutil.ignore_patterns("__pycache__"))
    code = "from softfinger.proxy.kernels.native.jit import CACHE_DIR; print(CACHE_DIR)"
    site = os.pathsep.join([str(tmp_path), *[path for path in sys.path if path.endswith("site-packages")]])

    def cache_dir() -> str:
        environment = os.environ | {"PYTHONPATH": site}
        command = [sys.executable, "-S", "-c", code]  # without site: the installed package must not come first
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.strip()

    before = cache_dir()
    assert cache_dir() == before
    kernel = package / "proxy" / "kernels" / "friction" / "torsion.py"
    kernel.write_text(kernel.read_text() + "\nTWICE = 2.0\n")
    assert cache_dir() != before
