"""The program on an emulated Falcon behind the real libusb: contract, firmware, homing, servo loop, faults.

Needs umockdev: `apt install umockdev gir1.2-umockdev-1.0 python3-gi` on Debian.
"""

import functools
import json
import random
import re
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.closed_loop import assert_engine_agrees
from helpers.rig_files import write_rig
from test_hid_emulated import CLOSED_LOOP, DAEMON, STROKE, WHY_NOT, Run, on_testbed

from softfinger.config.load import load_scene
from softfinger.drivers.falcon import firmware, packets
from softfinger.proxy.record import AT

CONTRACT = Path(__file__).parents[1] / "helpers" / "falcon_contract.py"
pytestmark = [pytest.mark.real_time, pytest.mark.system, pytest.mark.skipif(WHY_NOT is not None, reason=str(WHY_NOT))]


beside = functools.partial(on_testbed, "falcon_testbed.py")


def rig_with(folder: Path, **keys: object) -> str:
    # A tick of the emulation waits for two other programs, so silences are longer than on a bus.
    return str(write_rig(folder, "falcon", **{"kick_s": 0.15, "timeout_s": 1.0, **keys}))


def run(case: dict[str, Any], rig: str, *words: str, code: int | None = None) -> Run:
    return beside(case, *DAEMON, "--rig", rig, "--scene", "frictionless-plane", *words, code=code)


def test_the_driver_contract() -> None:
    command = (sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(CONTRACT))
    process, saw = beside({"place": [0.0, 0.0, 0.02]}, *command, code=0)
    assert re.search(r"^\d+ passed in", process.stdout, re.MULTILINE), process.stdout
    assert saw["motors"] == [0, 0, 0]


def test_closed_loop_through_libusb(tmp_path: Path) -> None:
    records_file = tmp_path / "records.npy"
    program = (sys.executable, str(CLOSED_LOOP), rig_with(tmp_path), "paper-plane", "stroke", str(records_file))
    _, saw = beside(STROKE, *program, code=0)
    records = np.load(records_file)
    assert {0.0, 1.0, 2.0} == set(records[:, AT.contact_mode])
    assert max(saw["most"]) > 100  # the forces reached the motors: 1 N is some 240 counts
    assert saw["motors"] == [0, 0, 0]
    assert saw["state"] == 8, "the last packet leaves the light red"

    passed = assert_engine_agrees(records, load_scene("paper-plane"), 1000.0)
    assert passed > 100


@pytest.mark.sampled(1)
@pytest.mark.parametrize("reversed_motors", [True, False])
def test_the_motors_stop_a_knob_at_the_plane(reversed_motors: bool, tmp_path: Path) -> None:
    gain = -6000.0 if reversed_motors else 6000.0
    rig = rig_with(tmp_path, counts_per_nm=6000.0, motors_reversed=reversed_motors)
    process, saw = run({"place": [0.0, 0.0, 0.004], "gain": gain}, rig, "--duration", "3", code=0)
    assert "device Novint Falcon 0403:cb48 at 1000 Hz" in process.stderr
    assert "force is zero" in process.stderr and "not calibrated" not in process.stderr
    # Springs of hand and wall share the depth; up is the device's y.
    stiffness = load_scene("frictionless-plane").object[0].material.stiffness_n_per_m
    depth = (0.010 - 0.004) * 300.0 / (300.0 + stiffness)
    # counts are 30 um; the last zero releases the hand a little
    assert saw["place"][1] == pytest.approx(0.010 - depth, abs=3e-4)


def test_force_without_a_gain_is_flagged() -> None:
    process, saw = run({"place": [0.0, 0.0, 0.02]}, "falcon", "--duration", "0.02", code=0)
    assert "force is not calibrated: 10000 motor counts per N m are assumed" in process.stderr
    # Purge, latency 1 ms, 1.5 MBd, purge: the chip as the firmware expects it.
    assert saw["requests"] == [[0, 1], [0, 2], [9, 1], [3, 2], [0, 1], [0, 2]]


def test_late_replies_cost_ticks_and_not_the_loop(tmp_path: Path) -> None:
    _, saw = run({"place": [0.0, 0.0, 0.004], "late_every": 10}, rig_with(tmp_path), "--duration", "1", code=0)
    assert saw["steps"] > 30


@pytest.mark.parametrize(
    ("case", "message"),
    [
        ({"lost_after": 100}, r"is gone .status -1 on (read|write)"),
        ({"broken_after": 100}, r"is gone .status -1 on read.*libusb's error 1"),
        ({"mute_after": 100}, "no answer to a read in time: check cable and power"),
        ({"block_after": 100}, "no answer to a (read|write) in time"),
        ({"garble_after": 100}, "no answer to a read in time"),
        ({"unhomed_after": 100}, "lost its encoder zeros"),
    ],
    ids=["unplugged", "broken", "mute", "blocked", "noise", "unhomed"],
)
def test_faults_end_in_order(case: dict[str, Any], message: str, tmp_path: Path) -> None:
    process, saw = run({"place": [0.0, 0.0, 0.005], **case}, rig_with(tmp_path), "--duration", "10")
    assert process.returncode != 0, process.stderr
    assert re.search(message, process.stderr), process.stderr
    assert max(saw["most"]) > 0, "there was no force to take away"
    if not {"block_after", "broken_after"} & set(case):  # nothing is transmitted any more, not even a zero
        assert saw["motors"] == [0, 0, 0]


def test_the_force_of_a_killed_daemon_ends(tmp_path: Path) -> None:
    case = {"place": [0.0, 0.0, 0.005], "kill_after": 200}
    process, saw = run(case, rig_with(tmp_path), "--duration", "10", code=256 - signal.SIGKILL)
    assert "the daemon has died: zero force was written to /dev/bus/usb/001/002" in process.stderr
    assert max(saw["most"]) > 0 and saw["motors"] == [0, 0, 0] and saw["state"] == packets.RED


def test_homing(tmp_path: Path) -> None:
    rig = rig_with(tmp_path, counts_per_nm=10000.0)
    process, saw = run({"place": [0.0, 0.0, 0.004], "homed": False}, rig, "--duration", "1.5", code=0)
    assert "pull the knob out completely, then push it in, until the light is green" in process.stderr
    assert saw["found"] == [True, True, True]
    assert saw["place"][1] > 0.005, "the wall did not hold the hand, so its place was wrong"


def test_homing_times_out(tmp_path: Path) -> None:
    rig = rig_with(tmp_path, homing_s=0.1)
    process, saw = run({"place": [0.0, 0.0, 0.004], "homed": False}, rig, "--duration", "1", code=4)
    assert "was not homed in 0.1 s: pull the knob out" in process.stderr
    assert saw["most"] == [0, 0, 0]


FIRMWARE_BYTES = 7324


@pytest.mark.parametrize(
    ("size", "spoil", "message"),
    [
        (None, 0, "no firmware runs in the Falcon: set `firmware` in the rig"),
        (20, 0, "has 20 bytes, must have 7324 to 8492"),
        (3100, 99, "did not accept the firmware .* in 10 tries: byte 30\\d\\d of 3100 was returned as"),
    ],
    ids=["no-file", "not-a-firmware", "never-right"],
)
def test_firmware_that_cannot_be_sent(size: int | None, spoil: int, message: str, tmp_path: Path) -> None:
    keys = {}
    if size is not None:
        path = tmp_path / "firmware.bin"
        path.write_bytes(random.Random(size).randbytes(size))
        keys["firmware"] = str(path)
    process, saw = run(
        {"firmware": size or FIRMWARE_BYTES, "spoil": spoil}, rig_with(tmp_path, **keys), "--duration", "1"
    )
    assert process.returncode == 4, process.stderr
    assert re.search(message, process.stderr), process.stderr
    assert saw["loads"] == (firmware.ATTEMPTS_MAX if spoil else 0)


def test_the_serial_number_selects_the_device(tmp_path: Path) -> None:
    for serial, message in (("SN42", "stopped after 5 ticks"), ("SN43", "'SN43': attached are 'SN42'")):
        process, _ = run({}, rig_with(tmp_path, serial=serial), "--duration", "0.005")
        assert message in process.stderr


def test_a_weight_gives_the_gain() -> None:
    case = {"place": [0.0, 0.0, 0.0], "hand": False, "gain": -4000.0, "weight_kg": 0.1, "weight_after": 1500}
    words = ("calibrate", "--rig", "falcon", "--mass", "0.1", "--hang", "40", "--json")
    process, _ = beside(case, sys.executable, "-m", "softfinger.server.cli", *words, code=0)
    content = json.loads(process.stdout.rsplit("{", 1)[0])
    # tolerance: at rest the force of 0.39 N may change by up to 0.05 N from window to window
    assert content["counts_per_nm"] == pytest.approx(4000.0, rel=0.13)
    assert content["counts_per_nm_used"] == 10000.0


def test_a_force_of_the_wrong_sign_is_noticed() -> None:
    case = {"place": [0.0, 0.0, 0.0], "hand": False, "gain": 4000.0, "weight_kg": 0.1, "weight_after": 100}
    words = ("calibrate", "--rig", "falcon", "--mass", "0.1", "--hang", "20")
    process, saw = beside(case, sys.executable, "-m", "softfinger.server.cli", *words, code=4)
    assert "change motors_reversed in the rig" in process.stderr
    assert saw["motors"] == [0, 0, 0]
