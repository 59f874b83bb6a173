"""3D Systems' devices under the servo and the daemon: closed loop, faults, signals, forces of the motors afterwards."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.c_stub import COMPILER, NO_COMPILER
from helpers.closed_loop import assert_engine_agrees, records_of_daemon
from helpers.hd_stub import HdStub, TouchBench, hd, hd_library, journal_in, touch
from helpers.programs import Program
from helpers.rig_files import load_rig_in_process
from helpers.waits import until

from softfinger.config.errors import DeviceLost, DeviceTimeout, HapticError, SafetyStop
from softfinger.config.load import load_rig, load_scene
from softfinger.config.schema import Rig
from softfinger.drivers.registry import read_options
from softfinger.proxy.record import AT, MODE_NAMES
from softfinger.server.app import Daemon
from softfinger.server.driver_contract import RATE_HZ
from softfinger.server.wire.client import subscribe

__all__ = ["hd", "hd_library", "touch"]  # fixtures

pytestmark = [pytest.mark.real_time, pytest.mark.skipif(COMPILER is None, reason=NO_COMPILER)]

PRESSING = {"y": 11.5, "ay": 3.5, "ax": 6.0, "az": 12.0, "hz": 1.0, "turn": 0.5}
"""Once a second the hand moves 2 mm deep into the plane z = 0 with a finger of 10 mm, rolls, slides and releases."""
DEEP = {"y": 8.0}
"""2 mm deep, without motion."""


def touch_rig(stub: HdStub, **changes: Any) -> Rig:
    # The age of a force counts real time, and this machine stalls threads.
    return load_rig_in_process("touch", {"library_file": str(stub.path), "force_age_max_s": 0.1}, changes)


def test_the_closed_loop_displays_the_forces_of_the_contact_step(hd: HdStub, touch: TouchBench) -> None:
    hd.update(**PRESSING)
    scene = load_scene("paper-plane")
    records = records_of_daemon(touch_rig(hd, **{"guard.ramp_s": 0.01}), scene, 2500)
    assert assert_engine_agrees(records, scene, RATE_HZ) > 300  # of each 1000 ticks, some 400 are in the plane
    assert set(records[:, AT.contact_mode].tolist()) == set(range(len(MODE_NAMES)))
    assert 0.5 < np.abs(records[:, AT.force + 2]).max() <= 2.5
    # A late force lets the hand go deeper for some ticks. For 2 % of the time the depth is within 0.4 % of the largest.
    depth = 0.01 - np.percentile(records[:, AT.probe_position + 2], 2)
    # Hand and wall, 1000 N/m each, share the 2 mm; two threads delay the force by two ticks at most, and inertia adds.
    assert depth == pytest.approx(0.001, rel=0.15)
    assert hd["misuse"] == hd["errors"] == 0
    assert not hd.journal()["force"][-1].any() and hd["peak"] > 0.5
    assert (hd["opens"], hd["closes"], hd["running"]) == (1, 1, 0)


@pytest.mark.parametrize(
    ("fault", "error", "words"),
    [
        ({"unplug_at": 50}, DeviceLost, r"Touch, serial 70001 is gone.*does not answer \(error 0x0302"),
        ({"error_at": 50, "error": 0x200}, SafetyStop, "disabled its force.*motors are too warm"),
        ({"drop_at": 50}, DeviceTimeout, "no answer to a read"),
        ({"hang_at": 50}, DeviceTimeout, "no answer to a read"),
        ({"delay_at": 50, "delay_s": 0.9}, DeviceTimeout, "no answer to a read"),
    ],
)
def test_every_fault_under_the_daemon_is_named_and_leaves_no_force(
    fault: dict[str, float], error: type[HapticError], words: str, hd: HdStub, touch: TouchBench
) -> None:
    hd.update(**DEEP)
    with Daemon(touch_rig(hd), load_scene("paper-plane")) as running:
        running.start()
        until(lambda: hd["peak"] > 0.5)
        now = hd["frames"]  # the library's thread counts frames from the opening on
        hd.update(**{name: value + now if name.endswith("_at") else value for name, value in fault.items()})
        with pytest.raises(error, match=words):
            running.wait(60.0)
        assert not any(hd.wrench())
    assert hd["peak"] > 0.5 and not any(hd.wrench())
    touch.mend()
    touch.open().close()


def test_forces_of_the_motors_after_a_signal(hd_library: Path, tmp_path: Path) -> None:
    """After SIGKILL the motors retain a force, within the limit. Other signals are in test_ways_out_at_far_ends.py."""
    rig, journal = tmp_path / "rig.toml", tmp_path / "journal"
    rig.write_text(
        f'[device]\ndriver = "openhaptics"\nlibrary_file = "{hd_library}"\nforce_age_max_s = 0.1\n'
        f'[guard]\nforce_max_n = 1.5\nramp_s = 0.01\n[telemetry]\nendpoint = "ipc://{tmp_path}/t"\n'
        '[servo]\nrealtime = "off"\n'
    )
    settings = ",".join(f"{name}={value}" for name, value in DEEP.items())
    words = [sys.executable, "-m", "softfinger.server.cli", "run", "--rig", str(rig), "--scene", "paper-plane"]
    environment = os.environ | {"STUB_HD_SET": settings, "STUB_HD_LOG": str(journal)}
    with Program(words, env=environment, stderr=subprocess.PIPE, text=True) as process:
        pressed = 0
        for sample in subscribe(f"ipc://{tmp_path}/t"):
            pressed += sample.force[2] > 0.5
            if pressed == 20:  # a published force reaches the motors a tick or two later
                break
        process.send_signal(signal.SIGKILL)
        process.communicate(timeout=60)
    last = np.linalg.norm(journal_in(journal)["force"], axis=1)
    assert last.max() > 0.5
    assert 0.0 < last[-1] <= 1.5, "the stub's motors do not keep their force"


def test_shipped_rig_opens_a_touch(hd: HdStub, touch: TouchBench) -> None:
    rig = load_rig("touch", {"device.library_file": str(hd.path)})
    assert rig.device is not None
    from softfinger.drivers.openhaptics.device import open_device

    with open_device(read_options(rig.device), rig.servo.rate_hz) as device:
        assert rig.guard.force_max_n <= device.info.force_max_n
        assert device.info.name.startswith("Touch")
