"""`warmup`: compile ahead, so that the first tick of a later start comes at once."""

from __future__ import annotations

import argparse
import shutil
import time
from typing import Any

import numba
import numpy as np

from softfinger.config import schema
from softfinger.config.load import load_rig, load_scene, shipped
from softfinger.proxy import engine
from softfinger.proxy.kernels.jit import CACHE_DIR
from softfinger.proxy.kernels.model import Scene
from softfinger.proxy.kernels.pack import flatten
from softfinger.proxy.scene import start_state
from softfinger.proxy.state import RECORD_SIZE
from softfinger.server.app import open_device
from softfinger.server.progress import progress
from softfinger.server.servo import Servo
from softfinger.server.simulate import simulate
from softfinger.server.tuning import make_tuning


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help="scenes to compile for (default: all shipped ones)")
    parser.add_argument("--prune", action="store_true", help="remove the kernels of other versions first")


def run(args: argparse.Namespace) -> int:
    if args.prune:
        prune()
    rig = load_rig("replay")
    for name in args.scenes or shipped(schema.Scene):
        scene = load_scene(name)
        begun = time.monotonic()
        with progress(f"compiling for {name}"), open_device(rig.device, rig.servo.rate_hz) as device:
            tuning = make_tuning(scene, rig.guard)
            servo = Servo(device, tuning, rig.servo.rate_hz)
            servo.compile()
            servo.close()
            simulate(tuning, np.array([[0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0]]), rig.servo.rate_hz)
            compile_engine(tuning.scene)
        print(f"{name}: ready after {time.monotonic() - begun:.1f} s")
    print(f"kernels are in {CACHE_DIR}")
    return 0


def compile_engine(scene: Scene) -> None:
    """Compile the engine's two entries for a scene, without running them."""
    start = start_state(scene)
    values, state = flatten(scene), flatten(start)
    pose, records = np.zeros(7), np.zeros((1, RECORD_SIZE))
    kernels: list[tuple[Any, tuple[Any, ...]]] = [
        (engine.step_once, (scene, values, start, state, pose, 0.0)),
        (engine.step_many, (scene, values, start, state, pose.reshape(1, 7), 0.0, 0, records)),
    ]
    for kernel, arguments in kernels:
        kernel.compile(tuple(numba.typeof(argument) for argument in arguments))


def prune() -> None:
    """Remove the compiled kernels of every other version of this program."""
    if CACHE_DIR.parent.is_dir():
        for path in CACHE_DIR.parent.iterdir():
            if path.is_dir() and path != CACHE_DIR and len(path.name) == len(CACHE_DIR.name):
                shutil.rmtree(path, ignore_errors=True)
