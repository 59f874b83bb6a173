"""Guide of docs/devices/serial.md: its printed rig passes `check` and renders a floor on the board it describes."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from emulators.askedboard import AskedBoard
from emulators.guideboard import GuideBoard
from helpers.described_boards import settled
from helpers.waits import fresh
from test_pages import commands, fences

from softfinger.config.errors import DeviceTimeout
from softfinger.config.load import load_rig, load_scene
from softfinger.config.schema import Rig
from softfinger.drivers.base import Device
from softfinger.drivers.registry import open_device
from softfinger.server.app import Daemon
from softfinger.server.cli import main
from softfinger.server.driver_contract import Servo

PAGE = "devices/serial.md"


def write_example(folder: Path) -> Path:
    ((_, title, text),) = [fence for fence in fences(PAGE) if fence[1]]
    path = folder / title
    path.write_text(text)
    return path


def test_the_printed_rig_is_checked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_example(tmp_path)
    monkeypatch.chdir(tmp_path)
    lines = [line for kind, _, text in fences(PAGE) if kind == "sh" for line in commands(text)]
    assert lines == ["softfinger check my-board.toml"]
    assert main(lines[0].split()[1:]) == 0
    assert "on an arc, in its middle along (0.00, 0.00, 1.00) of the world" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("rig", "words"),
    [
        (
            "haply-2diy",
            "in the plane across (0.00, -1.00, 0.00) of the world; forces out of it are not displayed",
        ),
        (
            "hapkit",
            "on an arc, in its middle along (0.00, 0.00, 1.00) of the world; forces across it are not displayed",
        ),
    ],
)
def test_check_prints_the_motion_of_a_device(rig: str, words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", rig]) == 0
    assert words in capsys.readouterr().out
    assert main(["check", "woodenhaptics-v3"]) == 0
    assert "of the world" not in capsys.readouterr().out


@pytest.mark.real_time
def test_the_printed_rig_runs(tmp_path: Path) -> None:
    with GuideBoard() as board:
        board.angle = 0.3  # 24 mm up, and the fingertip has a radius of 10
        changes: dict[str, Any] = {
            "device.path": board.path, "device.quiet_s": 0.1, "device.timeout_s": 1.0, "guard.ramp_s": 0.01,
            "servo.realtime": "off", "telemetry.endpoint": "tcp://127.0.0.1:*",
        }  # fmt: skip
        with Daemon(load_rig(str(write_example(tmp_path)), changes), load_scene("paper-plane")) as daemon:
            daemon.start()
            time.sleep(0.1)
            assert board.most == 0.0
            board.angle = 0.12
            assert settled(lambda: board.torque, lambda torque: torque > 0.01) > 0.01
            # 0.3 N of the guard at 0.08 m, and steps of 1 uN m
            assert board.most <= 0.3 * 0.08 + 1e-6
        assert settled(lambda: board.torque, lambda torque: torque == 0.0) == 0.0


ASKED = """
[device]
driver = "serial"
path = "{path}"
force_max_n = 1.0
stiffness_max_n_per_m = 200.0
damping_max_ns_per_m = 1.0
workspace_radius_m = 0.06
quiet_s = 0.1
timeout_s = 0.5
wake_s = 0.5

[device.frames]
mode = "answer"
order = "big"

[device.frames.input]
bytes = 8
start = [0x7E]
check = {{ kind = "crc16-ccitt", offset = 6 }}
field = [
    {{ meaning = "buttons", offset = 1, type = "uint8" }},
    {{ meaning = "a", offset = 2, type = "int16", scale = 1.7453292519943296e-4, least = -0.5, most = 3.6 }},
    {{ meaning = "b", offset = 4, type = "int16", scale = 1.7453292519943296e-4, least = -0.5, most = 3.6 }},
]

[device.frames.output]
bytes = 8
start = [0x55, 0x54]
check = {{ kind = "{check}", offset = 6 }}
field = [
    {{ meaning = "torque_a", offset = 2, type = "int16", scale = 1e4 }},
    {{ meaning = "torque_b", offset = 4, type = "int16", scale = 1e4 }},
]

[device.kinematics]
kind = "pantograph"
base_m = 0.05
inner_m = 0.08
outer_m = 0.1
origin_m = [0.025, 0.12, 0.0]
torque_max_nm = 0.05
"""
"""A rig written by the page's instructions, for a board with another protocol."""


def load_asked_rig(folder: Path, board: AskedBoard, check: str) -> Rig:
    file = folder / "asked.toml"
    file.write_text(ASKED.format(path=board.path, check=check))
    return load_rig(str(file))


def open_rig_device(rig: Rig) -> Device:
    assert rig.device is not None
    return open_device(rig.device, rig.servo.rate_hz)


@pytest.mark.real_time
def test_a_board_with_another_protocol_runs(tmp_path: Path) -> None:
    out = np.deg2rad(60.0)
    with AskedBoard() as board:
        board.angles, board.buttons = (np.pi - out, out), 5
        with open_rig_device(load_asked_rig(tmp_path, board, "crc16-modbus")) as device:
            device.arm()
            servo = Servo(device)
            sample = fresh(servo)
            elbow = 0.025 + 0.08 * np.cos(out)  # from the middle
            height = 0.08 * np.sin(out) + np.sqrt(0.1**2 - elbow**2)
            # steps of 0.01 degrees, on links within 0.2 m
            np.testing.assert_allclose(sample[:3], (0.0, height - 0.12, 0.0), atol=0.2 * 1.75e-4)
            assert sample[8] == 5.0
            # along y, both links turned by da: dy = (l cos a - elbow / (height - l sin a) * l sin a) da
            slope = 0.08 * np.cos(out) + elbow / (height - 0.08 * np.sin(out)) * 0.08 * np.sin(out)
            servo.write(0.0, 0.5, 0.0, 0.0, 0.0, 0.0)
            first, two = settled(lambda: board.torques, lambda torques: any(torques))
            assert first == -two
            # of the two motors; steps of 0.1 mN m, and the angle's
            assert 2.0 * abs(two) == pytest.approx(0.5 * abs(slope), abs=2e-4)
        assert settled(lambda: board.torques, lambda torques: not any(torques)) == (0.0, 0.0)
    assert board.refused == []


@pytest.mark.real_time
def test_a_board_with_another_checksum_never_answers(tmp_path: Path) -> None:
    with AskedBoard() as board:
        with pytest.raises(DeviceTimeout, match=r"sends no frame within 0\.5 s.*has not answered 55 54 00 00 00 00 "):
            open_rig_device(load_asked_rig(tmp_path, board, "crc16-ccitt"))
        assert board.refused
