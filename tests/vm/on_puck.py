"""The daemon on a SpaceMouse of the guest's HID layer."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.closed_loop import assert_engine_agrees

from softfinger.config.load import load_scene
from softfinger.proxy.record import AT
from vm.guest import RATE_HZ, attached, daemon, gadget, keep, other_daemon
from vm.guest import loaded as loaded


def listed() -> list[dict[str, Any]]:
    return [device for device in attached() if device["driver"] == "spacemouse"]


@pytest.mark.parametrize("reports", ["split", "combined"])
def test_the_fingertip_follows(reports: str, tmp_path: Path) -> None:
    """A deflected puck is found and opened, the fingertip moves down and to the right into the plane, buttons are read,
    and the lamp is switched on and off."""
    records_file = tmp_path / "records.npy"
    with gadget("puck", reports=reports, push={"up": -200, "right": 100}, buttons=5) as puck:
        (device,) = listed()
        assert (device["state"], device["name"], device["rigs"]) == ("usable", "SpaceNavigator", ["spacemouse"])
        keep("spacemouse", "paper-plane", 200, records_file)
        assert puck.seen()["written"] == ["0401", "0400"]
    records = np.load(records_file)
    extent = np.ptp(records[:, AT.probe_position : AT.probe_position + 3], axis=0)
    assert extent[0] / extent[2] == pytest.approx((100 - 15) / (200 - 15), rel=1e-9)  # one time for both: only rounding
    assert extent[1] == 0.0
    assert {0.0, 1.0} <= set(records[:, AT.contact_mode])
    assert assert_engine_agrees(records, load_scene("paper-plane"), RATE_HZ) > 20
    assert records[-1, AT.buttons] == 5


def test_unplugged_in_use() -> None:
    with gadget("puck", push={"right": 50}) as puck, other_daemon() as watcher:
        with daemon("spacemouse") as running:
            running.says("scene")
            running.says("real time")
            puck.ask("make lost")
            assert running.end() == 4, running.err
        assert "spacemouse SpaceNavigator is gone (status -1 on read): plug it in again" in running.err
        watcher.says("detached: SpaceNavigator (256f:c635) at /dev/hidraw")
        puck.ask("mend")
        watcher.says("attached: SpaceNavigator (256f:c635) at /dev/hidraw")
        with daemon("spacemouse", "--duration", "0.2") as restarted:
            assert restarted.end() == 0, restarted.err
        assert watcher.stop() == 0, watcher.err
