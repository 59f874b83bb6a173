"""The daemon on an emulated board behind a pseudo terminal: closed loop, faults, a second program, signals."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from emulators.hand import stroke
from emulators.serialboard import Board, Cable
from helpers.closed_loop import assert_engine_agrees, records_of_daemon
from helpers.programs import Program, run_program
from helpers.rig_files import load_rig_in_process
from helpers.serial_devices import PLACE, RIG
from helpers.waits import eventually, until

from softfinger.config.load import load_scene
from softfinger.config.schema import Rig
from softfinger.config.sources import find
from softfinger.proxy.record import AT, MODE_NAMES

pytestmark = pytest.mark.real_time

LIFT_M = 0.012
"""Height of the hand over the plane: the fingertip of 10 mm is free by 2 mm."""


def comes_to_rest(board: Board) -> bool:
    return eventually(lambda: board.force == (0.0, 0.0, 0.0))


def rig(cable: Cable, **changes: Any) -> Rig:
    return load_rig_in_process(RIG, {"path": cable.path, "quiet_s": 0.1, "timeout_s": 1.0}, changes)


def test_closed_loop_through_the_daemon() -> None:
    board = Board(stroke((0.0, 0.0, LIFT_M), 0.006, 0.02), early_end=True)
    scene = load_scene("paper-plane")
    with Cable(board) as cable:
        patient = rig(cable, **{"device.timeout_s": 2.0, "guard.force_slew_n_per_s": 20_000.0})
        records = records_of_daemon(patient, scene, 5000)
        reached = np.array(board.sent)[:, :3] * 1e-3
    assert board.faults == []
    compared = assert_engine_agrees(records, scene, 1000.0)
    assert set(records[:, AT.contact_mode]) == set(range(len(MODE_NAMES)))
    assert compared > 300
    places = records[:, AT.probe_position : AT.probe_position + 3] * 1e6
    np.testing.assert_allclose(places, np.round(places), atol=1e-6)  # rounding of mm to m
    # The board received forces of the ticks, to the millinewton, in order.
    forces = iter(np.floor(records[:, AT.force : AT.force + 3] * 1e3 + 0.5).tolist())
    changes = [row for row in np.round(reached * 1e3).tolist() if any(row)]
    assert len(changes) > 300
    assert all(any(row == tick for tick in forces) for row in changes)
    # The hand's spring (300 N/m) and the wall's share the hand's depth; without a wall it would be 4 mm.
    stiffness = scene.object[0].material.stiffness_n_per_m
    # It presses half of the time: the middle of that half, since a late board lets the hand go deeper.
    depth = (0.010 - np.percentile(places[:, 2], 25) * 1e-6) / 0.004
    assert depth == pytest.approx(300.0 / (300.0 + stiffness), rel=0.15)  # it drags at the same time
    assert not reached[-1].any()
    assert comes_to_rest(board)


def test_the_command_line_on_a_port(tmp_path: Path) -> None:
    board = Board(lambda _: (*PLACE[:2], 0.006))
    with Cable(board) as cable:
        mine = tmp_path / "rig.toml"
        named = f'driver = "serial"\npath = "{cable.path}"\nquiet_s = 0.1\ntimeout_s = 2.0\n'
        mine.write_text(find(RIG, Rig).read_text().replace('driver = "serial"\n', named))
        command = [sys.executable, "-m", "softfinger.server.cli", "run", "--rig", str(mine), "--realtime", "off"]
        command += ["--scene", "paper-plane", "--endpoint"]
        words = [*command, f"ipc://{tmp_path}/a"]
        with Program(words, stderr=subprocess.PIPE, text=True, kill_at_end=True) as first:
            until(lambda: board.force[2] >= 0.5 or first.poll() is not None)
            assert first.poll() is None, first.communicate()[1]
            second = run_program([*command, f"ipc://{tmp_path}/b"])
            assert second.returncode == 4
            assert re.search(
                rf"{cable.path} is used by process {first.pid} \(python.*\): end that process", second.stderr
            )
            until(lambda: board.force[2] >= 0.5)  # also after the second
            first.send_signal(signal.SIGINT)
            stderr = first.communicate(timeout=60)[1]
        assert first.returncode == 0, stderr
        assert f"device serial 16c0:0483 at {cable.path} at 1000 Hz" in stderr
        assert "force is zero" in stderr
        assert comes_to_rest(board)
        assert board.faults == []
