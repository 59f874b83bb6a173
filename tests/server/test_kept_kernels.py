"""Freshly compiled loop of a shipped scene: the functions it may call, its files in the kernel cache, their reuse."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.compiled_code import called_in, functions
from helpers.processes import COMMAND
from helpers.programs import Program, run_program

from softfinger.config.load import describe, load_scene
from softfinger.proxy.kernels.jit.decorators import CACHE_DIR

MAY_CALL = {"clock_gettime", "clock_nanosleep", "eventfd_write", "atan2", "sqrt"}
"""All external functions that the loop of a scene may call: clock, sleep, wake-up, and libm."""

COMPILER = """
from softfinger.server.loop.servo import run_servo_loop
from softfinger.server.services import scene_changes
scene_changes.main()
print(*run_servo_loop.inspect_llvm().values())
"""
"""Process in which a daemon compiles another scene; prints the IR at the end."""


LOOPS = ("run_servo_loop", "step_many", "run_ticks")
"""Kernels of the verbs, which are compiled again."""

SCENES = ["frictionless-plane", pytest.param("paper-plane", marks=pytest.mark.exhaustive)]


def run_compiler(scene: str, cache: Path) -> str:
    """Return the output of the daemon's compiler for a scene and a cache directory, followed by the IR."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    environment = os.environ | {"SOFTFINGER_CACHE_DIR": str(cache)}
    with Program([sys.executable, "-c", COMPILER], env=environment, **pipes) as compiler:
        compiler.stdin.write(json.dumps(describe(load_scene(scene))) + "\n")
        compiler.stdin.flush()  # left open, because closing would end the compiler
        output: str = compiler.stdout.read()
    assert compiler.returncode == 0
    return output


@pytest.fixture(scope="module", params=SCENES)
def fresh_loop(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path, str]:
    """Return a scene, a cache directory with its loop, and the compiler's output."""
    cache = tmp_path_factory.mktemp("kernels")
    if CACHE_DIR is not None and CACHE_DIR.is_dir():
        others = shutil.ignore_patterns(*(f"{name}-*" for name in LOOPS))
        shutil.copytree(CACHE_DIR, cache / CACHE_DIR.name, ignore=others)
    return request.param, cache, run_compiler(request.param, cache)


def list_kernels(cache: Path) -> dict[str, int]:
    """Return the kernels on disk by name, each with its time of modification, ns."""
    return {path.name: path.stat().st_mtime_ns for path in cache.rglob("*.kernel")}


def test_loop_calls_only_listed_functions(fresh_loop: tuple[str, Path, str]) -> None:
    bodies = functions(fresh_loop[2])
    assert any("servo_loop" in name for name in bodies)
    called = {name for body in bodies.values() for name in called_in(body)}
    outside = {name for name in called if name not in bodies and not name.startswith("llvm.")}
    assert outside == MAY_CALL
    # Otherwise only the device is called, through its two addresses: read, write, and the last zero, which healthy
    # devices get before failed ones.
    through_pointers = {
        name: len(re.findall(r"call [\w ]*%[\w.]+\(", body)) for name, body in bodies.items() if "call" in body
    }
    assert [count for count in through_pointers.values() if count] == [4]
    assert through_pointers[next(name for name in bodies if "servo_loop" in name)] == 4


def test_compiler_and_warmup_cache_all_kernels(fresh_loop: tuple[str, Path, str]) -> None:
    """`warmup` reuses the loop from a daemon's compiler; after it neither it nor a daemon compiles anything.

    `step_many`, which `Engine` calls, and the loop have the same kernels of contact: the second of them adds none.
    """
    scene, cache, output = fresh_loop
    before = list_kernels(cache)
    loops = {name: written for name, written in before.items() if name.startswith("run_servo_loop-")}
    assert len(loops) == 1
    assert output.startswith("compiling ") and re.search(r"^compiling kernel \d+ \(about \d+ ", output, re.MULTILINE)
    assert not run_compiler(scene, cache).startswith("compiling ")  # cached kernels are only loaded
    environment = os.environ | {"SOFTFINGER_CACHE_DIR": str(cache)}
    warm = [*COMMAND, "warmup", scene]
    first = run_program(warm, env=environment, check=True)
    assert str(cache) in first.stdout
    after = list_kernels(cache)
    assert loops.items() <= after.items()
    have, added = ({name.rpartition("-")[0] for name in names} for names in (before, after.keys() - before.keys()))
    assert {"step_many", "run_ticks"} <= added
    assert added & have <= {"disarm_and_zero"}  # each driver has one
    old_version, foreign = cache / "0123456789abcdef", cache / "notes"
    old_version.mkdir()
    foreign.mkdir()
    run_program([*warm, "--prune"], env=environment, check=True)
    assert not old_version.exists() and foreign.exists()  # kernels of another version, and an unrelated folder
    brief = ["--duration", "0.2", "--realtime", "off", "--endpoint", "tcp://127.0.0.1:*", "--commands", "off"]
    run_program([*COMMAND, "run", "--scene", scene, *brief], env=environment, check=True)
    assert list_kernels(cache) == after
