"""The whole program on an emulated WoodenHaptics behind a hidraw node of umockdev: enumeration, descriptor, servo loop.

Needs Debian's umockdev, gir1.2-umockdev-1.0 and python3-gi: `apt install umockdev gir1.2-umockdev-1.0 python3-gi`.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from closed_loop import assert_engine_agrees

from softfinger.config.load import find, load_scene
from softfinger.config.schema import Rig
from softfinger.proxy.state import OFFSET

TESTBED = Path(__file__).with_name("emulators") / "testbed.py"
CLOSED_LOOP = Path(__file__).with_name("closed_loop.py")
SYSTEM_PYTHON = "/usr/bin/python3"


def _umockdev() -> str | None:
    """Why umockdev cannot be used here; None if it can."""
    if shutil.which("umockdev-wrapper") is None:
        return "umockdev is not installed: apt install umockdev gir1.2-umockdev-1.0 python3-gi"
    code = "import gi; gi.require_version('UMockdev', '1.0'); from gi.repository import UMockdev"
    try:
        tried = subprocess.run([SYSTEM_PYTHON, "-c", code], capture_output=True, text=True, check=False)
    except OSError as error:
        return f"{SYSTEM_PYTHON}: {error.strerror}"
    return None if tried.returncode == 0 else f"{SYSTEM_PYTHON} has no gir1.2-umockdev-1.0: apt install it"


WHY_NOT = _umockdev()
pytestmark = pytest.mark.skipif(WHY_NOT is not None, reason=str(WHY_NOT))

STROKE = {"place": [0.0, 0.0, 0.012], "press": 0.006, "drag": 0.02}


def beside(case: dict[str, Any], *command: str) -> tuple[subprocess.CompletedProcess[str], dict[str, Any]]:
    """A command beside an emulated device; what it printed, and what the device saw."""
    done = subprocess.run(
        ["umockdev-wrapper", SYSTEM_PYTHON, str(TESTBED), json.dumps(case), *command],
        capture_output=True, text=True, timeout=120, check=False, env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
    )  # fmt: skip
    lines = done.stdout.splitlines()
    assert lines, done.stderr
    return done, json.loads(lines[-1])


def run(case: dict[str, Any], rig: str, *words: str) -> tuple[subprocess.CompletedProcess[str], dict[str, Any]]:
    """The daemon on an emulated device."""
    endpoint = ("--endpoint", "tcp://127.0.0.1:*", "--realtime", "off")
    return beside(case, sys.executable, "-m", "softfinger.server.cli", "run", "--rig", rig, *endpoint, *words)


@pytest.mark.parametrize(
    ("rig", "arm", "generation"),
    [("woodenhaptics-2019", "woody-2019", 2), ("woodenhaptics-2015", "woody-2015", 1)],
)  # fmt: skip
def test_closed_loop_through_a_hidraw_node(rig: str, arm: str, generation: int, tmp_path: Path) -> None:
    """A hand presses into the plane, drags and lets go; modes and forces are the engine's on the same poses."""
    kept = tmp_path / "records.npy"
    program = (sys.executable, str(CLOSED_LOOP), rig, "paper-plane", "1700", str(kept))
    done, saw = beside({"arm": arm, "generation": generation, **STROKE}, *program)
    assert done.returncode == 0, done.stderr
    records = np.load(kept)
    modes = records[:, OFFSET["contact.mode"]]
    assert {0.0, 1.0, 2.0} == set(modes)
    # The forces reached the arm, and stopped its hand above where it meant to go.
    assert max(saw["most"][1:]) > 100
    assert not any(saw["last"])

    passed = assert_engine_agrees(records, load_scene("paper-plane"), 1000.0)
    assert passed > 300, "the guard left too few ticks in contact to compare"


def test_an_arm_pressed_through_the_plane_is_held() -> None:
    """The daemon itself: a hand that means to be 6 mm deeper than the plane's surface is held near it by the motors."""
    case = {"arm": "woody-2019", "generation": 2, "place": [0.0, 0.0, 0.004]}
    done, saw = run(case, "woodenhaptics-2019", "--duration", "2", "--scene", "frictionless-plane")
    assert done.returncode == 0, done.stderr
    assert "device hid woodenhaptics-v2 16c0:0486 at 1000 Hz" in done.stderr
    assert "force is zero" in done.stderr
    assert saw["reports"] >= 2000
    # The hand's spring and the wall's share the depth; the last report, the zero, has let it go for a tick or two only.
    stiffness = load_scene("frictionless-plane").object[0].material.stiffness_n_per_m
    depth = (0.010 - 0.004) * 300.0 / (300.0 + stiffness)
    assert saw["place"][2] == pytest.approx(0.010 - depth, abs=3e-4)  # an encoder count is 0.1 mm, bearings hold none


@pytest.mark.parametrize(
    ("case", "code", "message"),
    [
        ({"lost_after": 300}, 4, "is gone .status -1 on (read|write).: plug it in again"),
        ({"short_after": 300}, 4, "answered what is not in its protocol .status -3 on read."),
        ({"mute_after": 300}, 4, "no answer to a read in time: check cable and power"),
        ({"mute_after": 0}, 4, "no answer to a read in time: check cable and power"),
        (
            {"descriptor": "06abff0a0002a1017508150026ff00952009018102954009029102c0"},
            4,
            "/dev/hidraw0 has other reports than the rig: the device announces input 32 bytes, output 64 bytes; "
            "the rig describes input 64 bytes, output 64 bytes: correct ",
        ),
        ({"descriptor": "06abff0a0002a10175"}, 4, "its report descriptor is damaged: item 0x75 at byte 8 of 9 is cut"),
        ({"generation": 1}, 4, "no HID device 16c0:0486 is attached: plug it in .*; attached are 1234:0006"),
    ],
    ids=["unplugged", "short", "mute", "mute-from-the-start", "descriptor", "damaged-descriptor", "another-device"],
)  # fmt: skip
def test_faults_end_in_order(case: dict[str, Any], code: int, message: str) -> None:
    """What goes wrong on the cable, or is another device, ends the daemon with its own message and exit code."""
    whole = {"arm": "woody-2019", "generation": 2, "place": [0.0, 0.0, 0.005], **case}
    done, saw = run(whole, "woodenhaptics-2019", "--duration", "3", "--scene", "frictionless-plane")
    assert done.returncode == code, done.stderr
    assert re.search(message, done.stderr), done.stderr
    if "short_after" in case or "mute_after" in case:
        assert not any(saw["last"]), "the last report was no zero"


def test_the_serial_number_tells_devices_apart(tmp_path: Path) -> None:
    """The emulated device has serial SN42: that one is opened, another one is asked for in vain."""
    text = find("woodenhaptics-2019", Rig).read_text()
    for serial, said in (("SN42", "stopped after 5 ticks"), ("SN43", "'SN43': attached are 'SN42'")):
        rig = tmp_path / "rig.toml"
        rig.write_text(text.replace('driver = "hid"', f'driver = "hid"\nserial = "{serial}"'))
        case = {"arm": "woody-2019", "generation": 2}
        done, _ = run(case, str(rig), "--duration", "0.005", "--scene", "frictionless-plane")
        assert said in done.stderr


def test_a_second_program_finds_the_device_held() -> None:
    """While one process has the device, the daemon is refused and told which process it is."""
    hold = (
        "import subprocess, sys\n"
        "from softfinger.config.load import load_rig\n"
        "from softfinger.server.app import open_device\n"
        "with open_device(load_rig('woodenhaptics-2019').device, 1000.0):\n"
        "    command = ['-m', 'softfinger.server.cli', 'run', '--rig', 'woodenhaptics-2019']\n"
        "    print(subprocess.run([sys.executable, *command, '--endpoint', 'tcp://127.0.0.1:*']).returncode)\n"
    )
    done, _ = beside({"arm": "woody-2019", "generation": 2}, sys.executable, "-c", hold)
    assert done.stdout.splitlines()[0] == "4"
    assert re.search(r"/dev/hidraw0 is held by process \d+ \(python", done.stderr), done.stderr
