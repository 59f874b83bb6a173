"""Guide of docs/devices/serial.md: its printed rig passes `check` and renders a floor on the board it describes."""

import time
from pathlib import Path
from typing import Any

import pytest
from emulators.guideboard import GuideBoard
from helpers.described_boards import settled
from test_pages import commands, fences

from softfinger.config.load import load_rig, load_scene
from softfinger.server.app import Daemon
from softfinger.server.cli import main

PAGE = "devices/serial.md"


def write_example(folder: Path) -> Path:
    ((_, title, text),) = [fence for fence in fences(PAGE) if fence[1]]
    path = folder / title
    path.write_text(text)
    return path


def test_the_printed_rig_is_checked(tmp_path, monkeypatch, capsys):
    write_example(tmp_path)
    monkeypatch.chdir(tmp_path)
    lines = [line for kind, _, text in fences(PAGE) if kind == "sh" for line in commands(text)]
    assert lines == ["softfinger check my-board.toml"] and main(lines[0].split()[1:]) == 0
    assert "on an arc, in its middle along (0.00, 0.00, 1.00) of the world" in capsys.readouterr().out


def test_check_prints_the_motion_of_a_device(capsys: pytest.CaptureFixture[str]) -> None:
    plane = "in the plane across (0.00, -1.00, 0.00) of the world; forces out of it are not displayed"
    for rig, is_plane in (("haply-2diy", True), ("woodenhaptics-v3", False)):
        assert main(["check", rig]) == 0
        assert (plane in capsys.readouterr().out) == is_plane


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
