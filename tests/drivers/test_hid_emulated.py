"""The program on a WoodenHaptics and a SpaceMouse emulated by umockdev: enumeration, descriptor, servo loop, faults.

Each path of reports is tested: a hidraw node in the loop, threads with hidapi's hidraw backend, and threads with its
libusb backend if the device is only on the USB bus. Needs umockdev: `apt install umockdev gir1.2-umockdev-1.0
python3-gi` on Debian.
"""

import functools
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.closed_loop import assert_engine_agrees
from helpers.hid_devices import RIGS
from helpers.programs import run_program
from helpers.rig_files import write_rig

from softfinger.config.load import load_scene
from softfinger.proxy.record import AT

EMULATORS = Path(__file__).parents[1] / "emulators"
TESTBEDS = {"hidraw": "testbed.py", "usb": "hid_usb_testbed.py"}
"""Testbeds by the interface of the emulated device: key `bus` of a case."""
CONNECTIONS = {"node": ("hidraw", "auto"), "thread": ("hidraw", "thread"), "usb": ("usb", "auto")}
"""Interface of the emulated device, and `through` of the rig."""
CLOSED_LOOP = Path(__file__).parents[1] / "helpers" / "closed_loop.py"
SYSTEM_PYTHON = "/usr/bin/python3"
DAEMON = (sys.executable, "-m", "softfinger.server.cli", "run", "--endpoint", "tcp://127.0.0.1:*", "--realtime", "off")


def _umockdev() -> str | None:
    if shutil.which("umockdev-wrapper") is None:
        return "umockdev is not installed: apt install umockdev gir1.2-umockdev-1.0 python3-gi"
    code = "import gi; gi.require_version('UMockdev', '1.0'); from gi.repository import UMockdev"
    try:
        tried = run_program([SYSTEM_PYTHON, "-c", code])
    except OSError as error:
        return f"{SYSTEM_PYTHON}: {error.strerror}"
    return None if tried.returncode == 0 else f"{SYSTEM_PYTHON} has no gir1.2-umockdev-1.0: apt install it"


WHY_NOT = _umockdev()
pytestmark = [pytest.mark.real_time, pytest.mark.system, pytest.mark.skipif(WHY_NOT is not None, reason=str(WHY_NOT))]


def patient_rig(folder: Path, name: str, **keys: object) -> str:
    """Write a rig that waits ten times as long for a report: on a busy machine the emulated device answers late."""
    return str(write_rig(folder, name, timeout_s=1.0, **keys))


STROKE = {"place": [0.0, 0.0, 0.012], "press": 0.006, "drag": 0.02}


Run = tuple[subprocess.CompletedProcess[str], dict[str, Any]]
"""Ended program and the final state of its emulated device."""


def on_testbed(file: str, case: dict[str, Any], *command: str, code: int | None = None) -> Run:
    """Run a program with an emulated device; fail unless its exit code is `code`, if that is given."""
    process = run_program(
        ["umockdev-wrapper", SYSTEM_PYTHON, str(EMULATORS / file), json.dumps(case), *command],
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
    )
    lines = process.stdout.splitlines()
    assert lines and code in (None, process.returncode), process.stdout + process.stderr
    return process, json.loads(lines[-1])


def run_beside_device(case: dict[str, Any], *command: str, code: int | None = None) -> Run:
    return on_testbed(TESTBEDS[case.get("bus", "hidraw")], case, *command, code=code)


def run(case: dict[str, Any], rig: str, *words: str, code: int | None = None) -> Run:
    return run_beside_device(case, *DAEMON, "--rig", rig, "--scene", "frictionless-plane", *words, code=code)


@pytest.mark.parametrize(
    ("connection", "rig", "arm", "generation"),
    [
        ("node", "woodenhaptics-2019", "woody-2019", 2),
        ("node", "woodenhaptics-2015", "woody-2015", 1),
        ("thread", "woodenhaptics-2015", "woody-2015", 1),
        ("usb", "woodenhaptics-2019", "woody-2019", 2),
    ],
)  # fmt: skip
def test_closed_loop_under_the_daemon(connection: str, rig: str, arm: str, generation: int, tmp_path: Path) -> None:
    records_file = tmp_path / "records.npy"
    bus, through = CONNECTIONS[connection]
    name = patient_rig(tmp_path, rig, through=through)
    program = (sys.executable, str(CLOSED_LOOP), name, "paper-plane", "stroke", str(records_file))
    _, saw = run_beside_device({"bus": bus, "arm": arm, "generation": generation, **STROKE}, *program, code=0)
    records = np.load(records_file)
    assert set(np.diff(records[:, AT.tick])) == {1.0}, "the subscriber has lost ticks"
    modes = records[:, AT.contact_mode]
    assert {0.0, 1.0, 2.0} == set(modes)
    # The forces reached the arm, and stopped its hand above its goal.
    assert max(saw["most"][1:]) > 100 and not any(saw["last"])

    passed = assert_engine_agrees(records, load_scene("paper-plane"), 1000.0)
    assert passed > 50


OTHER_DESCRIPTOR = "06abff0a0002a1017508150026ff00952009018102954009029102c0"


@pytest.mark.parametrize(
    ("connection", "case", "code", "message"),
    [
        *((name, {"lost_after": 300}, 4, "is gone .status -1 on (read|write).*: plug it in") for name in CONNECTIONS),
        ("node", {"short_after": 300}, 4, "sent an answer that violates its protocol .status -3 on read."),
        ("usb", {"short_after": 300}, 4, "sent an answer that violates its protocol .status -3 on read."),
        ("node", {"mute_after": 300}, 4, "no answer to a read in time: check cable and power"),
        ("usb", {"mute_after": 300}, 4, "no answer to a read in time: check cable and power"),
        ("node", {"mute_after": 0}, 4, "sends no report: check its power, and its firmware"),
        # a node's write hangs the loop itself, which the supervisor detects
        ("node", {"block_after": 300}, 6, "no tick for 0.25 s .*the exchange with a device does not return"),
        ("thread", {"block_after": 300}, 4, r"no answer to a read in time \(a write has not returned for 1"),
        # libusb aborts a write after a second, while `stop` waits for the zero
        ("usb", {"block_after": 300}, 4, r"in time \((a write has not returned|hid writer: a write .* -1 after) "),
        (
            "node",
            {"descriptor": OTHER_DESCRIPTOR},
            4,
            "/dev/hidraw0 has different reports from the rig: the device reports input 32 bytes, output 64 bytes; "
            "the rig describes input 64 bytes, output 64 bytes: correct ",
        ),
        ("usb", {"descriptor": OTHER_DESCRIPTOR}, 4, "1-1:1.0 has different reports from the rig: .* input 32 b"),
        (
            "node", {"descriptor": "06abff0a0002a10175"}, 4,
            "its report descriptor is damaged: item 0x75 at byte 8 of 9 is truncated",
        ),
        ("node", {"generation": 1}, 4, "no HID device 16c0:0486 is attached: plug it in .*; attached are 1234:0006"),
        ("usb", {"generation": 1}, 4, "no HID device 16c0:0486 is attached: plug it in"),
        ("usb", {"claimed": True}, 4, "1-1:1.0 ./dev/bus/usb/001/002. cannot be claimed through hidapi: another pro"),
        ("node", {"permission": "0"}, 4, "/dev/hidraw0 may not be opened by this user: .*install --system"),
        ("usb", {"permission": "0"}, 4, "/dev/bus/usb/001/002 may not be opened by this user: .*install --system"),
    ],
)  # fmt: skip
def test_faults_end_in_order(connection: str, case: dict[str, Any], code: int, message: str, tmp_path: Path) -> None:
    bus, through = CONNECTIONS[connection]
    whole = {"bus": bus, "arm": "woody-2019", "generation": 2, "place": [0.0, 0.0, 0.005], **case}
    rig = patient_rig(tmp_path, "woodenhaptics-2019", through=through)
    process, saw = run(whole, rig, code=code)
    assert re.search(message, process.stderr), process.stderr
    if "short_after" in case or "mute_after" in case:
        assert not any(saw["last"]), "the last report was no zero"
    if "block_after" in case:
        assert re.search("zero force has not reached it: (hid writer: a write|a write|writes) ", process.stderr)


@pytest.mark.sampled(4)
@pytest.mark.parametrize(
    ("connection", "board", "rig"),
    [
        ("node", "teensy", "woodenhaptics-2019"),
        ("node", "teensy-swapped", "woodenhaptics-polhem-v1"),
        ("thread", "teensy-swapped", "woodenhaptics-2019"),
        ("usb", "teensy", "woodenhaptics-2019"),
        ("usb", "teensy-swapped", "woodenhaptics-2019"),
        ("node", "lpc1768-14", "woodenhaptics-polhem-v1-lpc1768"),
        ("usb", "lpc1768-14", "woodenhaptics-2019-lpc1768"),
        ("node", "lpc1768-8", "woodenhaptics-2015"),
    ],
)
def test_a_board_is_opened_by_its_reports(connection: str, board: str, rig: str, tmp_path: Path) -> None:
    bus, through = CONNECTIONS[connection]
    case = {"bus": bus, "board": board, "arm": RIGS[rig], "generation": 1 if board == "lpc1768-8" else 2}
    mine = patient_rig(tmp_path, rig, through=through)
    _, saw = run({**case, "place": [0.0, 0.0, 0.004]}, mine, "--duration", "0.5", code=0)
    assert saw["astray"] == 0 and max(saw["most"]) > 0
    assert not any(saw["last"])


@pytest.mark.parametrize("board", ["teensy", "teensy-swapped"])
def test_the_force_of_a_killed_daemon_ends(board: str, tmp_path: Path) -> None:
    case = {"bus": "usb", "board": board, "arm": "woody-2019", "generation": 2, "place": [0.0, 0.0, 0.004]}
    rig = patient_rig(tmp_path, "woodenhaptics-2019")
    process, saw = run(case | {"kill_after": 200}, rig, "--duration", "10", code=256 - signal.SIGKILL)
    assert "the daemon has died: zero force was written to /dev/bus/usb/001/002" in process.stderr
    assert max(saw["most"]) > 0 and not any(saw["last"]) and saw["astray"] == 0


def test_the_error_names_the_format_of_another_firmware() -> None:
    case = {"board": "lpc1768-14", "arm": "woody-2019", "generation": 2}
    process, saw = run(case, "woodenhaptics-2015", "--duration", "0.1", code=4)
    message = 'reports input 14 .*: set reports to "woodenhaptics-v2-lpc1768", which has'
    assert re.search(message, process.stderr), process.stderr
    assert saw["reports"] == 0


def test_the_serial_number_selects_the_device(tmp_path: Path) -> None:
    for serial, message in (("SN42", "stopped after 5 ticks"), ("SN43", "'SN43': attached are 'SN42'")):
        rig = patient_rig(tmp_path, "woodenhaptics-2019", serial=serial)
        process, _ = run({"arm": "woody-2019", "generation": 2}, rig, "--duration", "0.005")
        assert message in process.stderr


TRY = """
import sys
from softfinger.config.errors import DeviceError
from softfinger.config.load import load_rig
from softfinger.drivers.registry import open_device
for name in sys.argv[1:]:
    try:
        with open_device(load_rig(name).device, 1000.0):
            print("opened")
    except DeviceError as error:
        print(type(error).__name__, error)
"""
"""Program that opens the device of each rig and prints a line with the result."""


def test_a_listed_node_that_does_not_exist(tmp_path: Path) -> None:
    tries: list[tuple[dict[str, object], str]] = [
        ({}, "opened"),
        ({"through": "thread", "serial": "SN42"}, "opened"),
        ({"path": "1-1:1.0"}, "opened"),
        (
            {"serial": "SN43"},
            "DeviceNotFound no HID device 16c0:0486 has the serial number 'SN43': attached are 'SN42'",
        ),
        ({"path": "1-2:1.0"}, "DeviceNotFound there is no USB device at 1-2:1.0: plug"),
        ({"path": "/dev/hidraw0"}, "DeviceNotFound /dev/hidraw0 cannot be opened: No such file"),
        ({"through": "node"}, "DeviceNotFound /dev/hidraw0 cannot be opened: No such file"),
    ]
    rigs = [patient_rig(tmp_path, "woodenhaptics-2019", **keys) for keys, _ in tries]
    third_rig = patient_rig(tmp_path, "woodenhaptics-2015", path="1-1:1.0")
    case = {"bus": "usb", "listed": True, "arm": "woody-2019", "generation": 2}
    process, _ = run_beside_device(case, sys.executable, "-c", TRY, *rigs, third_rig, code=0)
    *lines, of_the_other = process.stdout.splitlines()[:-1]
    assert [line.startswith(wanted) for line, (_, wanted) in zip(lines, tries, strict=True)] == [True] * 7, lines
    assert of_the_other.startswith("DeviceError 1-1:1.0 is the device 16c0:0486, but the rig is for 1234:0006")


def test_the_error_for_a_missing_node_names_the_module(tmp_path: Path) -> None:
    rig = patient_rig(tmp_path, "woodenhaptics-2019", through="node")
    process, _ = run_beside_device({"bus": "usb", "arm": "woody-2019", "generation": 2}, sys.executable, "-c", TRY, rig)
    error = r"DeviceNotFound Emulated arm \(16c0:0486\) at /dev/bus/usb/001/002 has no usable node: `sudo modprobe"
    assert re.match(error, process.stdout), process.stderr


beside = functools.partial(on_testbed, "puck_testbed.py")


@pytest.mark.parametrize("reports", ["split", "combined"])
def test_the_fingertip_follows_through_a_hidraw_node(reports: str, tmp_path: Path) -> None:
    """A push down and to the right moves the daemon's fingertip into the plane, modes and forces equal the engine's on
    the same poses, buttons are read, and the lamp is switched on and off.

    It touches after some 1.4 s, and its force is clamped 0.8 s later: a pause of the emulated bus, after which the
    force fades in for half a second, leaves ticks to compare.
    """
    path = tmp_path / "records.npy"
    case = {"reports": reports, "push": {"up": -80, "right": 40}, "buttons": 5}
    _, saw = beside(case, sys.executable, str(CLOSED_LOOP), "spacemouse", "paper-plane", "3000", str(path), code=0)
    records = np.load(path)
    extent = np.ptp(records[:, AT.probe_position : AT.probe_position + 3], axis=0)
    assert extent[0] / extent[2] == pytest.approx((40 - 15) / (80 - 15), rel=1e-9)  # one time for both: only rounding
    assert extent[1] == 0.0
    assert extent[2] > 0.02, "the puck's reports came too late"
    assert {0.0, 1.0} <= set(records[:, AT.contact_mode])
    assert assert_engine_agrees(records, load_scene("paper-plane"), 1000.0) > 50
    assert records[-1, AT.buttons] == 5
    assert saw["written"] == ["0401", "0400"]


def test_an_unplugged_puck_ends_the_run() -> None:
    process, _ = beside({"unplug_after_s": 2.0}, *DAEMON, "--rig", "spacemouse", "--duration", "60", code=4)
    assert "spacemouse SpaceNavigator is gone (status -1 on read): plug it in again" in process.stderr


def test_a_daemon_that_does_not_use_the_puck_logs_its_removal(tmp_path: Path) -> None:
    socket = tmp_path / "telemetry"
    process, _ = beside(
        {"unplug_when": str(socket)}, *DAEMON, "--duration", "6", "--endpoint", f"ipc://{socket}", code=0
    )
    assert "detached: SpaceNavigator (046d:c626) at /dev/hidraw0" in process.stderr
    assert "stopped after 6000 ticks" in process.stderr
