"""Compile what the tests of the guest run, on the machine outside: emulated, it takes minutes."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from driver_contract import RATE_HZ, pulling

from softfinger.config.load import load_rig, load_scene
from softfinger.drivers import falcon, hid, serial, spacemouse  # noqa: F401  (compiled by their import)
from softfinger.server.app import open_device
from softfinger.server.servo import Servo
from softfinger.server.tuning import make_tuning
from softfinger.server.warmup import compile_engine, prune

SCENES = ("paper-plane", "frictionless-plane")


def main() -> None:
    prune()
    rig = load_rig("replay")
    with open_device(rig.device, RATE_HZ) as device:
        for tuning in (*(make_tuning(load_scene(name), rig.guard, device.info) for name in SCENES), pulling()):
            servo = Servo(device, tuning, RATE_HZ)
            servo.compile()
            servo.close()
    compile_engine(make_tuning(load_scene(SCENES[0]), rig.guard).scene)


if __name__ == "__main__":
    main()
