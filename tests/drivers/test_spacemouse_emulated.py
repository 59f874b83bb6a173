"""The program on a SpaceMouse emulated as a hidraw node of umockdev: found, opened, followed, unplugged."""

import functools
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.closed_loop import assert_engine_agrees
from test_hid_emulated import CLOSED_LOOP, DAEMON, WHY_NOT, on_testbed

from softfinger.config.load import load_scene
from softfinger.proxy.record import AT

pytestmark = [pytest.mark.real_time, pytest.mark.system, pytest.mark.skipif(WHY_NOT is not None, reason=str(WHY_NOT))]


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
