"""Compile the kernels of the guest's tests on the host: under emulation, it takes minutes."""

from softfinger.config.load import load_rig, load_scene
from softfinger.drivers.falcon import device as falcon  # noqa: F401  (compiled by their import)
from softfinger.drivers.hid import device as hid  # noqa: F401
from softfinger.drivers.registry import open_device
from softfinger.drivers.serial import device as serial  # noqa: F401
from softfinger.drivers.simulated import device as simulated  # noqa: F401
from softfinger.drivers.spacemouse import device as spacemouse  # noqa: F401  (compiled by their import)
from softfinger.proxy.engine import compile_steps
from softfinger.proxy.scene import start_state
from softfinger.server.driver_contract import RATE_HZ, make_pulling_tuning
from softfinger.server.loop.servo_thread import ServoThread
from softfinger.server.loop.tuning import make_tuning
from softfinger.server.verbs.warmup import prune
from softfinger.server.wire.native.relay import Relay

SCENES = ("paper-plane", "frictionless-plane")


def main() -> None:
    prune()
    rig = load_rig("replay")
    with open_device(rig.device, RATE_HZ) as device:
        for tuning in (
            *(make_tuning(load_scene(name), rig.guard, [device.info]) for name in SCENES),
            make_pulling_tuning(),
        ):
            servo = ServoThread([device], tuning, RATE_HZ)
            servo.compile()
            servo.close()
    scene = make_tuning(load_scene(SCENES[0]), rig.guard).scene
    compile_steps(scene, start_state(scene))
    Relay(1).close()


if __name__ == "__main__":
    main()
