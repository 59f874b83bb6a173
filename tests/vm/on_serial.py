"""The daemon on WoodenHaptics' third generation on a serial port of the guest's kernel: f_acm, dummy_hcd, cdc-acm."""

from __future__ import annotations

import re
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
from vm.guest import NOBODY, RATE_HZ, Gadget, attached, daemon, gadget, keep, measured, other_daemon, pushing
from vm.guest import loaded as loaded
from vm.on_falcon import TICKS, exchanges

PRESS = {"place": [0.0, 0.0, 0.004]}
IN_CONTACT = 100
"""Frames after which the guard has let the whole force through and the hand lies on the plane."""


def listed(user: int | None = None) -> list[dict[str, Any]]:
    """The boards that `devices` lists."""
    return [one for one in attached(user) if (one["vendor_id"], one["product_id"]) == ("16c0", "0483")]


def in_contact(saw: dict[str, Any], before: int = 0) -> bool:
    return bool(saw["frames"] > before + IN_CONTACT and any(saw["force"]))


@pytest.fixture
def pressed() -> Iterator[Gadget]:
    """A board whose hand presses into the plane."""
    with gadget("serialboard", **PRESS) as board:
        yield board


@pytest.fixture
def rig(tmp_path: Path) -> str:
    """The shipped rig, with silences that an emulated processor keeps."""
    text = find("woodenhaptics-v3", Rig).read_text()
    path = tmp_path / "rig.toml"
    path.write_text(text.replace('driver = "serial"\n', 'driver = "serial"\nquiet_s = 0.15\n'))
    return str(path)


def test_it_is_found() -> None:
    """`devices` lists it by its port under its driver, usable; unplugged, it is gone."""
    with gadget("serialboard"):
        (found,) = listed()
    assert (found["driver"], found["state"], found["bus"]) == ("serial", "usable", "serial")
    assert found["serial"] == "SN42"
    assert found["rigs"] == ["woodenhaptics-v3"]
    assert re.fullmatch(r"/dev/ttyACM\d+", found["node"])
    assert listed() == []


def test_closed_loop(tmp_path: Path, rig: str) -> None:
    """A hand presses into the plane, drags and lets go; modes and forces are the engine's on the same poses."""
    kept = tmp_path / "records.npy"
    with gadget("serialboard", **STROKE) as board:
        keep(rig, "paper-plane", TICKS, kept)
        saw = board.seen()
    records = np.load(kept)
    assert {0.0, 1.0, 2.0} == set(records[:, OFFSET["contact.mode"]])
    assert max(saw["most"]) > 500  # mN: the forces reached the board
    assert not any(saw["force"])
    assert saw["faults"] == []
    assert assert_engine_agrees(records, load_scene("paper-plane"), RATE_HZ) > 100, "too little contact"


def test_stopped_it_leaves_no_force_and_opens_again(pressed: Gadget, rig: str) -> None:
    """Ctrl-C while it pushes: in order, force at zero; the next daemon opens what the first has closed."""
    for _ in range(2):
        before = pressed.seen()["frames"]
        with pushing(rig, pressed, partial(in_contact, before=before)) as running:
            assert running.stop() == 0, running.err
        assert "force is zero" in running.err
        assert not any(pressed.seen()["force"])


def test_unplugged_under_force(pressed: Gadget, rig: str) -> None:
    """Pulled out while it pushes: device lost; a daemon beside it tells what went and what came; it opens again."""
    with other_daemon() as other, pushing(rig, pressed, in_contact) as running:
        pressed.ask("make lost")
        assert running.end() == 4, running.err
        assert re.search(r"is gone .status -1 on (read|write)", running.err), running.err
        other.says("(16c0:0483) at /dev/ttyACM")
        assert "detached" in other.err
        assert listed() == []
        pressed.ask("mend")
        other.says("attached: ")
        assert other.stop() == 0, other.err
    before = pressed.seen()["frames"]
    with pushing(rig, pressed, lambda saw: saw["frames"] > before + IN_CONTACT) as running:
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


def test_another_user_is_told_what_to_do(pressed: Gadget, rig: str) -> None:
    """Nobody may not open it: the permission error with the group that may, or the udev rule; state `permission`."""
    with daemon(rig, user=NOBODY) as refused:
        assert refused.end() == 4, refused.err
    assert re.search(r"/dev/ttyACM\d+ may not be opened by this user", refused.err), refused.err
    (found,) = listed(user=NOBODY)
    assert found["state"] == "permission"
    assert pressed.seen()["frames"] == 0


@pytest.mark.parametrize("case", ["timeout", "blocked"])
def test_silence_ends_in_order(case: str, pressed: Gadget, rig: str) -> None:
    """A board that answers no more, and one that reads no more, end the daemon with a timeout; then it opens again."""
    with pushing(rig, pressed, in_contact) as running:
        pressed.ask(f"make {case}")
        assert running.end() == 4, running.err
    assert re.search("no answer to a (read|write) in time", running.err), running.err
    if case == "timeout":  # it still listens; what a board has not read is thrown away with the port's closing
        assert not any(pressed.seen()["force"])
    pressed.ask("mend")
    before = pressed.seen()["frames"]
    with pushing(rig, pressed, lambda saw: saw["frames"] > before + 20) as running:
        assert running.stop() == 0, running.err


def test_how_long_an_exchange_takes(pressed: Gadget, rig: str) -> None:
    """From a frame to the board's answer to it, and the calls themselves."""
    cycles, calls = exchanges(rig, 400)
    measured("serial: frame to answer", cycles)
    measured("serial: write and read of a tick", calls)
