"""The daemon on a Falcon of the guest's kernel: a device on dummy_hcd's bus, usbfs, the true libusb."""

from __future__ import annotations

import json
import random
import re
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from closed_loop import assert_engine_agrees
from driver_contract import Servo
from test_falcon_emulated import CONTRACT, FIRMWARE_BYTES, rig_with
from test_hid_emulated import STROKE

from softfinger.config.load import load_rig, load_scene
from softfinger.drivers.base import OK
from softfinger.proxy.state import OFFSET
from softfinger.server.app import open_device
from vm.guest import (
    NOBODY,
    RATE_HZ,
    Gadget,
    Run,
    attached,
    contract,
    daemon,
    gadget,
    keep,
    measured,
    other_daemon,
    pushing,
)
from vm.guest import loaded as loaded

PRESS = {"place": [0.0, 0.0, 0.004]}
IN_CONTACT = 100
"""Packets after which the guard has let the whole force through and the hand lies on the plane."""

TICKS = 1300
"""A stroke of the hand takes 1200 packets, at one in a tick."""


def listed(user: int | None = None, rig: str | None = None) -> list[dict[str, Any]]:
    """The Falcons that `devices` lists."""
    return [one for one in attached(user, rig) if (one["vendor_id"], one["product_id"]) == ("0403", "cb48")]


def in_contact(saw: dict[str, Any], before: int = 0) -> bool:
    return bool(saw["steps"] > before + IN_CONTACT and any(saw["motors"]))


@pytest.fixture
def pressed() -> Iterator[Gadget]:
    """A Falcon whose hand presses into the plane."""
    with gadget("falcon", **PRESS) as falcon:
        yield falcon


@pytest.fixture
def rig(tmp_path: Path) -> str:
    return rig_with(tmp_path)


def test_it_is_found(tmp_path: Path) -> None:
    """`devices` lists it under its driver: usable with a firmware file, and gone once it is unplugged."""
    path = tmp_path / "firmware.bin"
    path.write_bytes(bytes(FIRMWARE_BYTES))
    with gadget("falcon", serial="SN7"):
        (without,) = listed()
        (found,) = listed(rig=rig_with(tmp_path, firmware=str(path)))
    assert (found["driver"], found["state"], without["state"]) == ("falcon", "usable", "firmware")
    assert (found["serial"], found["name"], found["rigs"]) == ("SN7", "FALCON HAPTIC", ["falcon"])
    assert re.fullmatch(r"/dev/bus/usb/\d{3}/\d{3}", found["node"])
    assert listed() == []


def test_closed_loop(tmp_path: Path, rig: str) -> None:
    """A hand presses into the plane, drags and lets go; modes and forces are the engine's on the same poses."""
    kept = tmp_path / "records.npy"
    with gadget("falcon", **STROKE) as falcon:
        keep(rig, "paper-plane", TICKS, kept)
        saw = falcon.seen()
    records = np.load(kept)
    assert {0.0, 1.0, 2.0} == set(records[:, OFFSET["contact.mode"]])
    assert max(saw["most"]) > 100  # the forces reached the motors: 1 N is some 240 counts
    assert saw["motors"] == [0, 0, 0]
    assert saw["state"] == 8, "the last packet leaves the light red"
    assert assert_engine_agrees(records, load_scene("paper-plane"), RATE_HZ) > 100, (
        "too few ticks in contact to compare"
    )


def test_stopped_it_leaves_no_force_and_opens_again(pressed: Gadget, rig: str) -> None:
    """Ctrl-C while it pushes: in order, motors at zero; the next daemon opens the device that the first has closed."""
    for _ in range(2):
        before = pressed.seen()["steps"]
        with pushing(rig, pressed, partial(in_contact, before=before)) as running:
            assert running.stop() == 0, running.err
        assert "force is zero" in running.err
        assert pressed.seen()["motors"] == [0, 0, 0]


def test_unplugged_under_force(pressed: Gadget, rig: str) -> None:
    """Pulled out while it pushes: device lost; a daemon beside it tells what went and what came; it opens again."""
    with other_daemon() as other, pushing(rig, pressed, in_contact) as running:
        pressed.ask("make lost")
        assert running.end() == 4, running.err
        assert re.search(r"is gone .status -1 on (read|write).*plug it in again", running.err)
        other.says("detached: FALCON HAPTIC (0403:cb48) at /dev/bus/usb/")
        assert listed() == []
        pressed.ask("mend")
        other.says("attached: FALCON HAPTIC (0403:cb48) at /dev/bus/usb/")
        assert other.stop() == 0, other.err
    before = pressed.seen()["steps"]
    with pushing(rig, pressed, lambda saw: saw["steps"] > before + IN_CONTACT) as running:
        assert running.stop() == 0, running.err


def test_a_second_program_finds_it_held(pressed: Gadget, rig: str) -> None:
    """While a daemon has it, another is refused and `devices` says by whom; the first does not notice."""
    with pushing(rig, pressed, in_contact) as running:
        with daemon(rig) as second:
            assert second.end() == 4, second.err
        assert "is held by another program: close that one first" in second.err
        (found,) = listed()
        assert found["state"] == "busy"
        assert f"process {running.pid} " in found["reason"]
        assert running.stop() == 0, running.err


def test_another_user_is_told_the_rule(pressed: Gadget, rig: str) -> None:
    """Nobody may not open it: the permission error with the udev rule, the state `permission`."""
    with daemon(rig, user=NOBODY) as refused:
        assert refused.end() == 4, refused.err
    assert "may not be opened by this user: put the line SUBSYSTEM" in refused.err
    (found,) = listed(user=NOBODY)
    assert found["state"] == "permission"
    assert pressed.seen()["steps"] == 0


@pytest.mark.parametrize(
    ("case", "message"),
    [
        ("timeout", "no answer to a read in time: check cable and power"),
        ("blocked", "no answer to a (read|write) in time"),
        ("stalled", r"is gone .status -1 on read.*libusb's error 4"),
    ],
)
def test_faults_end_in_order(case: str, message: str, pressed: Gadget, rig: str) -> None:
    """An answer that does not come, an endpoint that takes nothing and one that is halted end the daemon with their own
    message; plugged in anew, the device works again."""
    with pushing(rig, pressed, in_contact) as running:
        pressed.ask(f"make {case}")
        assert running.end() == 4, running.err
    assert re.search(message, running.err), running.err
    if case == "timeout":
        assert pressed.seen()["motors"] == [0, 0, 0]  # it still listens
    pressed.ask("mend")
    pressed.ask("make lost")
    pressed.ask("mend")
    before = pressed.seen()["steps"]
    with pushing(rig, pressed, lambda saw: saw["steps"] > before + 20) as running:
        assert running.stop() == 0, running.err


def test_firmware_is_sent_on_request(tmp_path: Path) -> None:
    """A device without firmware is refused until the rig names a file; then it gets it, byte for byte, and runs."""
    path = tmp_path / "firmware.bin"
    path.write_bytes(random.Random(FIRMWARE_BYTES).randbytes(FIRMWARE_BYTES))
    with gadget("falcon", firmware=FIRMWARE_BYTES, spoil=1) as falcon:
        with daemon(rig_with(tmp_path), "--duration", "0.1") as refused:
            assert refused.end(120) == 4, refused.err
        assert "no firmware runs in the Falcon: give the path of its firmware file" in refused.err
        with daemon(rig_with(tmp_path, firmware=str(path)), "--duration", "0.1") as running:
            assert running.end(180) == 0, running.err
        saw = falcon.seen()
    assert saw["runs"] and saw["loads"] == 2
    assert re.search(r"try 1 of 10: byte 3\d\d\d of 7324 came back as", running.err)


def test_the_driver_contract() -> None:
    """Every test of the contract passes over the device on the bus; none is left out."""
    with gadget("falcon", place=[0.0, 0.0, 0.02]) as falcon:
        said, code = contract(CONTRACT, falcon)
    assert code == 0, said
    assert re.search(r"^\d+ passed in", said, re.MULTILINE), said


def test_how_long_an_exchange_takes(pressed: Gadget, rig: str) -> None:
    """From a packet to the reply to it: the two ticks of the emulated bus, and not a multiple."""
    cycles, ticks = exchanges(rig, 400)
    measured("falcon: packet to reply", ms=cycles)
    measured("falcon: read and write of a tick, of our own", ms=ticks)


def exchanges(rig: str, count: int) -> tuple[list[float], list[float]]:
    """Times (ms) from a write until a read brings its reply, and of the calls themselves, in a process of its own."""

    def work() -> int:
        cycles, ticks = [], []
        with open_device(load_rig(rig).device, RATE_HZ) as device:
            servo = Servo(device)
            servo.read()
            for _ in range(count):
                begun = time.perf_counter()
                servo.write(0.0, 0.0, 0.05, 0.0, 0.0, 0.0)
                spent = time.perf_counter() - begun
                while True:
                    asked = time.perf_counter()
                    status, _sample = servo.read()
                    now = time.perf_counter()
                    if status == OK:
                        break
                    time.sleep(0.0001)
                cycles.append(1e3 * (now - begun))
                ticks.append(1e3 * (spent + now - asked))
        print(json.dumps([cycles, ticks]))
        return 0

    run = Run(work)
    assert run.end(120) == 0, run.err
    cycles, ticks = json.loads(run.out)
    return cycles, ticks
