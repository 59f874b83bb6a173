"""The daemon on a WoodenHaptics arm of the guest's kernel: a HID device on dummy_hcd's bus, its true hidraw node."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from closed_loop import assert_engine_agrees
from test_hid_emulated import STROKE

from softfinger.config.load import find, load_scene
from softfinger.config.schema import Rig
from softfinger.proxy.state import OFFSET
from vm import contract_hid
from vm.guest import NOBODY, RATE_HZ, Gadget, attached, contract, daemon, gadget, keep, measured, other_daemon, pushing
from vm.guest import loaded as loaded
from vm.on_falcon import TICKS, exchanges

PRESS = {"place": [0.0, 0.0, 0.004]}
IN_CONTACT = 100
"""Reports after which the guard has let the whole force through and the hand lies on the plane."""


def listed(user: int | None = None) -> list[dict[str, Any]]:
    """The arms that `devices` lists."""
    return [one for one in attached(user) if (one["vendor_id"], one["product_id"]) == ("16c0", "0486")]


def in_contact(saw: dict[str, Any], before: int = 0) -> bool:
    return bool(saw["reports"] > before + IN_CONTACT and any(saw["motors"]))


@pytest.fixture
def pressed() -> Iterator[Gadget]:
    """An arm whose hand presses into the plane."""
    with gadget("woodenhaptics", **PRESS) as arm:
        yield arm


@pytest.fixture
def rig(tmp_path: Path) -> str:
    """The shipped rig, with silences that an emulated processor keeps."""
    text = find("woodenhaptics-2019", Rig).read_text()
    path = tmp_path / "rig.toml"
    path.write_text(text.replace('driver = "hid"\n', 'driver = "hid"\nkick_s = 0.1\ntimeout_s = 0.2\n'))
    return str(path)


def test_it_is_found() -> None:
    """`devices` lists it by its node under its driver, usable with the rigs of its ids; unplugged, it is gone."""
    with gadget("woodenhaptics"):
        (found,) = listed()
    assert (found["driver"], found["state"], found["bus"]) == ("hid", "usable", "hid")
    assert (found["serial"], found["name"]) == ("SN42", "Emulators Emulated arm")
    assert "woodenhaptics-2019" in found["rigs"]
    assert re.fullmatch(r"/dev/hidraw\d+", found["node"])
    assert listed() == []


@pytest.mark.parametrize("bus", ["usb", "uhid"])
def test_closed_loop(bus: str, tmp_path: Path, rig: str) -> None:
    """A hand presses into the plane, drags and lets go; modes and forces are the engine's on the same poses."""
    kept = tmp_path / "records.npy"
    with gadget("woodenhaptics", bus=bus, **STROKE) as arm:
        keep(rig, "paper-plane", TICKS, kept)
        saw = arm.seen()
    records = np.load(kept)
    assert {0.0, 1.0, 2.0} == set(records[:, OFFSET["contact.mode"]])
    assert max(saw["most"][1:]) > 100  # mA: the forces reached the arm
    assert saw["last"] == [0, 0, 0]
    assert assert_engine_agrees(records, load_scene("paper-plane"), RATE_HZ) > 100, (
        "too few ticks in contact to compare"
    )


def test_stopped_it_leaves_no_force_and_opens_again(pressed: Gadget, rig: str) -> None:
    """Ctrl-C while it pushes: in order, currents at zero; the next daemon opens what the first has closed."""
    for _ in range(2):
        before = pressed.seen()["reports"]
        with pushing(rig, pressed, partial(in_contact, before=before)) as running:
            assert running.stop() == 0, running.err
        assert "force is zero" in running.err
        assert pressed.seen()["last"] == [0, 0, 0]


def test_unplugged_under_force(pressed: Gadget, rig: str) -> None:
    """Pulled out while it pushes: device lost; a daemon beside it tells what went and what came; it opens again."""
    with other_daemon() as other, pushing(rig, pressed, in_contact) as running:
        pressed.ask("make lost")
        assert running.end() == 4, running.err
        assert re.search(r"is gone .status -1 on (read|write).: plug it in again", running.err)
        other.says("detached: Emulators Emulated arm (16c0:0486) at /dev/hidraw")
        assert listed() == []
        pressed.ask("mend")
        other.says("attached: Emulators Emulated arm (16c0:0486) at /dev/hidraw")
        assert other.stop() == 0, other.err
    before = pressed.seen()["reports"]
    with pushing(rig, pressed, lambda saw: saw["reports"] > before + IN_CONTACT) as running:
        assert running.stop() == 0, running.err


def test_a_second_program_finds_it_held(pressed: Gadget, rig: str) -> None:
    """While a daemon has it, another is refused and told by whom, as `devices` tells; the first does not notice."""
    with pushing(rig, pressed, in_contact) as running:
        with daemon(rig) as second:
            assert second.end() == 4, second.err
        assert f"is held by process {running.pid} (" in second.err
        (found,) = listed()
        assert found["state"] == "busy"
        assert f"process {running.pid} " in found["reason"]
        assert running.stop() == 0, running.err


def test_another_user_is_told_the_rule(pressed: Gadget, rig: str) -> None:
    """Nobody may not open it: the permission error with the udev rule, the state `permission`."""
    with daemon(rig, user=NOBODY) as refused:
        assert refused.end() == 4, refused.err
    assert re.search(r"/dev/hidraw\d+ may not be opened by this user", refused.err)
    (found,) = listed(user=NOBODY)
    assert found["state"] == "permission"
    assert pressed.seen()["reports"] == 0


def test_an_arm_that_answers_no_more(pressed: Gadget, rig: str) -> None:
    """Reports that do not come end the daemon with a timeout, after a zero; then it opens again."""
    with pushing(rig, pressed, in_contact) as running:
        pressed.ask("make timeout")
        assert running.end() == 4, running.err
    assert "no answer to a read in time: check cable and power" in running.err
    assert pressed.seen()["last"] == [0, 0, 0]
    pressed.ask("mend")
    before = pressed.seen()["reports"]
    with pushing(rig, pressed, lambda saw: saw["reports"] > before + 20) as running:
        assert running.stop() == 0, running.err


def test_an_arm_that_takes_no_report(pressed: Gadget, rig: str) -> None:
    """A write that hangs in the kernel ends the daemon without the arm's help, and says that no zero could follow."""
    with pushing(rig, pressed, in_contact) as running:
        begun = time.monotonic()
        pressed.ask("make blocked")
        code = running.end()
        measured("hid, usb: the daemon's end after the arm takes no more reports", [1e3 * (time.monotonic() - begun)])
    assert code in (4, 6), running.err
    assert re.search(r"no answer to a (read|write) in time|no tick for 0\.\d+ s", running.err), running.err


def test_the_driver_contract() -> None:
    """Every test of the contract passes over the node; none is left out.

    On the bus, where a report that the arm has not taken holds up the next: uhid loses those for which its queue has no
    room, and says nothing.
    """
    with gadget("woodenhaptics", place=[0.0, 0.0, 0.02]) as arm:
        said, code = contract(Path(contract_hid.__file__), arm)
    assert code == 0, said
    assert re.search(r"^\d+ passed in", said, re.MULTILINE), said


@pytest.mark.parametrize("bus", ["usb", "uhid"])
def test_how_long_an_exchange_takes(bus: str, rig: str) -> None:
    """From a report to the arm's answer to it, on the bus and without one; and how long the write of a report takes."""
    with gadget("woodenhaptics", bus=bus, **PRESS):
        cycles, calls = exchanges(rig, 400)
    measured(f"hid, {bus}: report to answer", ms=cycles)
    measured(f"hid, {bus}: write and read of a tick", ms=calls)
