"""Tests of the daemon for every device of the guest that displays force, as one class."""

import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from helpers.closed_loop import assert_engine_agrees
from helpers.waits import eventually
from test_hid_emulated import STROKE

from softfinger.config.load import load_scene
from softfinger.proxy.record import AT
from vm.guest import NOBODY, RATE_HZ, Gadget, Run, Wanted, attached, daemon, gadget, keep, other_daemon, pushing

PRESS: Mapping[str, Any] = {"place": [0.0, 0.0, 0.004]}
"""A hand that presses into the plane."""
IN_CONTACT = 100
"""Packets after which the guard passes the full force and the hand rests on the plane."""
TICKS = 1300
"""A stroke of the hand takes 1200 packets, one per tick."""


class Cases:
    """A module subclasses this with the attributes of its device, and defines a fixture `rig`, a rig file for it.

    kind       gadget that emulates it
    ids        vendor and product, as `devices` lists them
    name       of the device, in the hot-plug events
    node       pattern of the node that the driver opens
    bus        of the node
    packets    key in the gadget's state: number of packets
    force      key in the gadget's state: current force
    felt       minimum of `most` in that state when the forces have arrived
    held       pattern of the error for a second program; {pid} is the first program's
    forbidden  pattern of the error for another user
    """

    kind: ClassVar[str]
    ids: ClassVar[tuple[str, str]]
    name: ClassVar[str]
    node: ClassVar[str]
    bus: ClassVar[str]
    packets: ClassVar[str]
    force: ClassVar[str]
    felt: ClassVar[int]
    held: ClassVar[str]
    forbidden: ClassVar[str]

    def listed(self, user: int | None = None, rig: str | None = None) -> list[dict[str, Any]]:
        """Return the devices of this kind that `devices` lists."""
        return [device for device in attached(user, rig) if (device["vendor_id"], device["product_id"]) == self.ids]

    def exchanged(self, device: Gadget, count: int) -> Wanted:
        """Return a condition: more than `count` further packets."""
        before = device.seen()[self.packets]
        return lambda saw: bool(saw[self.packets] > before + count)

    def in_contact(self, device: Gadget) -> Wanted:
        """Return a condition: the hand rests on the plane and gets a force."""
        enough: Callable[[dict[str, Any]], bool] = self.exchanged(device, IN_CONTACT)
        return lambda saw: enough(saw) and any(saw[self.force])

    def works(self, device: Gadget, rig: str) -> None:
        """Check that a daemon opens the device, exchanges with it and ends with code 0."""
        with pushing(rig, device, self.exchanged(device, 20)) as running:
            assert running.stop() == 0, running.err

    @pytest.fixture
    def pressed(self) -> Iterator[Gadget]:
        with gadget(self.kind, **PRESS) as device:
            yield device

    def test_closed_loop(self, tmp_path: Path, rig: str) -> None:
        records_file = tmp_path / "records.npy"
        with gadget(self.kind, **STROKE) as device:
            keep(rig, "paper-plane", TICKS, records_file)
            saw = device.seen()
        self.agrees(np.load(records_file), saw)

    def agrees(self, records: Any, saw: dict[str, Any]) -> None:
        """Check that all modes and the engine's forces are recorded and reached the device, and the last is zero."""
        assert {0.0, 1.0, 2.0} == set(records[:, AT.contact_mode])
        assert max(saw["most"]) > self.felt
        assert not any(saw[self.force])
        assert assert_engine_agrees(records, load_scene("paper-plane"), RATE_HZ) > 100, "too few ticks in contact"

    def test_a_stopped_daemon_leaves_zero_force_and_a_usable_device(self, pressed: Gadget, rig: str) -> None:
        for _ in range(2):
            with pushing(rig, pressed, self.in_contact(pressed)) as running:
                assert running.stop() == 0, running.err
            assert "force is zero" in running.err
            assert not any(pressed.seen()[self.force])

    def test_the_force_of_a_killed_daemon_ends(self, pressed: Gadget, rig: str) -> None:
        with pushing(rig, pressed, self.in_contact(pressed)) as running:
            running.kill()
        assert eventually(lambda: not any(pressed.seen()[self.force]))
        self.works(pressed, rig)

    def test_unplugged_under_force(self, pressed: Gadget, rig: str) -> None:
        description = f"{self.name} ({':'.join(self.ids)}) at /dev/"
        with other_daemon() as watcher, pushing(rig, pressed, self.in_contact(pressed)) as running:
            pressed.ask("make lost")
            assert running.end() == 4, running.err
            assert re.search(r"is gone .status -1 on (read|write).*plug it in again", running.err), running.err
            watcher.says(f"detached: {description}")
            assert self.listed() == []
            pressed.ask("mend")
            watcher.says(f"attached: {description}")
            assert watcher.stop() == 0, watcher.err
        self.works(pressed, rig)

    def test_a_second_program_reports_a_busy_device(self, pressed: Gadget, rig: str) -> None:
        with pushing(rig, pressed, self.in_contact(pressed)) as running:
            with daemon(rig) as second:
                assert second.end() == 4, second.err
            assert re.search(self.held.format(pid=running.pid), second.err), second.err
            (device,) = self.listed()
            assert device["state"] == "busy"
            assert f"process {running.pid} " in device["reason"]
            assert running.stop() == 0, running.err

    def test_another_user_gets_instructions(self, pressed: Gadget, rig: str) -> None:
        with daemon(rig, "--commands", "off", user=NOBODY) as refused:  # it may not write to the folder of endpoints
            assert refused.end() == 4, refused.err
        assert re.search(self.forbidden, refused.err), refused.err
        (device,) = self.listed(user=NOBODY)
        assert device["state"] == "permission"
        assert pressed.seen()[self.packets] == 0

    def test_silent_under_force(self, pressed: Gadget, rig: str) -> None:
        with pushing(rig, pressed, self.in_contact(pressed)) as running:
            pressed.ask("make timeout")
            assert running.end() == 4, running.err
        assert "no answer to a read in time: check cable and power" in running.err
        assert not any(pressed.seen()[self.force])
        pressed.ask("mend")
        self.works(pressed, rig)

    def faulty(self, case: str, pressed: Gadget, rig: str) -> Run:
        """Run a daemon in contact until a fault of the gadget ends it."""
        with pushing(rig, pressed, self.in_contact(pressed)) as running:
            pressed.ask(f"make {case}")
            running.end()
        return running
