"""Compile what the tests of the guest run, on the machine outside: emulated, it takes minutes."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from driver_contract import RATE_HZ, pulling  # noqa: E402

from softfinger.config.load import load_rig, load_scene  # noqa: E402
from softfinger.drivers import falcon, hid, spacemouse  # noqa: E402, F401  (compiled by their import)
from softfinger.server.app import open_device  # noqa: E402
from softfinger.server.servo import Servo  # noqa: E402
from softfinger.server.tuning import make_tuning  # noqa: E402
from softfinger.server.warmup import compile_engine, prune  # noqa: E402

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
