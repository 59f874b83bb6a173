"""`softfinger warmup`: compile kernels ahead, so that later starts need no compilation."""

from __future__ import annotations

import argparse
import re
import shutil
import time
from typing import Final

import numpy as np

from softfinger.config import schema
from softfinger.config.errors import ConfigError
from softfinger.config.load import load_scene
from softfinger.config.sources import list_shipped
from softfinger.proxy.engine import compile_steps
from softfinger.proxy.kernels.jit.decorators import CACHE_DIR, KERNEL_FOLDER
from softfinger.proxy.scene import start_state
from softfinger.server.loop.servo_thread import require_machine_code
from softfinger.server.offline.simulate import simulate
from softfinger.server.progress import report_compilation
from softfinger.server.services.scene_changes import compile_loop
from softfinger.server.wire.native.relay import Relay

RATE_HZ: Final = 1000.0
"""Arbitrary: kernels do not depend on the rate."""


def run(args: argparse.Namespace) -> int:
    require_machine_code("the kernel cache")
    if args.prune:
        prune()
    names = args.scenes or list_shipped(schema.Scene)
    for number, name in enumerate(names, 1):
        try:
            scene = load_scene(name)
        except ConfigError as error:  # a package that the scene needs is not installed
            if args.scenes:
                raise
            print(f"{name}: skipped: {error}")
            continue
        start_s = time.monotonic()
        with report_compilation(f"scene {number} of {len(names)}, {name}"):
            tuning = compile_loop(scene)
            simulate(tuning, np.array([[[0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0]] * len(scene.fingers)]), RATE_HZ)
            compile_steps(tuning.scene, start_state(tuning.scene))
        print(f"{name}: ready after {time.monotonic() - start_s:.1f} s")
    Relay(1).close()
    if (problem := KERNEL_FOLDER.problem()) is not None:
        raise ConfigError(f"compiled kernels are not cached: {problem}")
    print(f"kernels are in {CACHE_DIR}")
    return 0


def prune() -> None:
    if CACHE_DIR is not None and CACHE_DIR.parent.is_dir():
        for path in CACHE_DIR.parent.iterdir():
            if path.is_dir() and path != CACHE_DIR and re.fullmatch("[0-9a-f]{16}", path.name):
                shutil.rmtree(path, ignore_errors=True)
