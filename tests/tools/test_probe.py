"""`devices --probe`: the report of a device without force, and small pushes on demand, for every driver and ending."""

import os
import pty
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.c_stub import COMPILER, NO_COMPILER
from helpers.described_boards import settled
from helpers.far_ends import FAR_RIGS, when_forced
from helpers.hd_stub import HdStub, hd, hd_library
from test_doctor import checked, home

from softfinger.config.errors import DeviceNotFound
from softfinger.drivers.system import discovery
from softfinger.drivers.system.discovery import SystemDevice
from softfinger.server.cli import main
from softfinger.tools.doctor import probe

__all__ = ["hd", "hd_library", "home"]  # fixtures

pytestmark = pytest.mark.real_time

Probing = Callable[..., str]


@pytest.fixture
def probing(home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Probing:
    monkeypatch.setattr(probe, "PART_S", 0.2)

    def run(*words: str, typed: str | None = None) -> str:
        if typed is None:
            stdin = os.fdopen(os.open(os.devnull, os.O_RDONLY))
        else:
            main_end, side = pty.openpty()
            os.write(main_end, typed.encode())
            stdin = os.fdopen(side)
        with stdin:
            monkeypatch.setattr(sys, "stdin", stdin)
            assert main(["devices", "--probe", *words]) == 0
        return capsys.readouterr().out

    return run


def rig(home: Path, driver: str, *lines: str) -> str:
    file = home / "mine.toml"
    file.write_text("\n".join(["[device]", f'driver = "{driver}"', *lines, '[servo]\nrealtime = "off"\n']))
    return str(file)


def test_a_recording_is_probed(probing: Probing, home: Path) -> None:
    output = probing("--rig", rig(home, "replay", 'recording = "tap"', "loop = true", 'forces = "forces.npz"'))
    report = checked(home / "softfinger-replay-report.json", home)
    assert report["complete"] and not report["guided"]
    assert report["exchange"]["ticks"] == 1000 and report["rest"]["ticks"] == 200
    # five parts that follow each other, as one: no gap is in their time
    assert report["exchange"]["seconds"] == pytest.approx(1.0, rel=0.2)
    assert report["buttons"] == {"masks": [0]} and report["moves"] == report["pushes"] == []
    assert not np.load(home / "forces.npz")["force"].any()
    low, high = report["range"]["position_min_m"][2] * 1e3, report["range"]["position_max_m"][2] * 1e3
    assert f"z  up: {low:.1f} to {high:.1f} mm" in output and "x  right: " in output
    assert "new samples a second, the rig requires 1000" in output and "attach it to an issue" in output


def test_answers_about_pushes_are_in_the_report(probing: Probing, home: Path) -> None:
    still = rig(home, "simulated", "position_m = [0.0, 0.0, 0.03]")
    output = probing("mine.json", "--rig", still, "--push", typed="\n\nright\naway from me\n up \n")
    report = checked(home / "mine.json", home)
    assert report["guided"] and [move["seen"] for move in report["moves"]] == ["no motion"] * 3
    assert [push["felt"] for push in report["pushes"]] == ["right", "away from me", "up"]
    assert [push["seen"] for push in report["pushes"]] == ["+x", "+y", "+z"]
    assert all(push["largest_n"] == pytest.approx(probe.PUSH_N, rel=1e-3) for push in report["pushes"])
    assert "push along +y: +y; felt: away from me" in output
    assert "right --> no motion   WRONG: required is +x" in output


@pytest.mark.skipif(COMPILER is None, reason=NO_COMPILER)
def test_a_touch_is_probed(probing: Probing, home: Path, hd: HdStub) -> None:
    named = rig(home, "openhaptics", f'library_file = "{hd.path}"', "force_age_max_s = 0.1")
    hd["buttons"] = 2
    probing("--rig", named)
    report = checked(home / "softfinger-openhaptics-report.json", home)
    assert report["device"]["name"] == "Touch, serial ...01"
    assert hd.path.name in report["maker_library"]  # of this process, which other tests share
    assert report["buttons"] == {"masks": [2]} and hd["peak"] == 0.0
    probing("--rig", named, "--push")
    report = checked(home / "softfinger-openhaptics-report.json", home)
    assert [push["seen"] for push in report["pushes"]] == ["+x", "+y", "+z"]
    assert [push["felt"] for push in report["pushes"]] == ["", "", ""]
    force = hd.journal()["force"]
    # the library's axes: x right, y up, z towards the user
    assert force.max(axis=0) == pytest.approx([0.2] * 3, rel=0.02)
    assert force.min(axis=0) == pytest.approx([-0.2] * 3, rel=0.02) and not force[-1].any()


def test_a_rig_with_a_limit_below_the_push_is_refused(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = home / "weak.toml"
    file.write_text('[device]\ndriver = "simulated"\n[guard]\nforce_max_n = 0.1\n')
    assert main(["devices", "--probe", "--push", "--rig", str(file)]) == 2
    assert "guard.force_max_n = 0.1 is below the push of 0.2 N" in capsys.readouterr().err


def test_without_a_rig_the_first_attached_device_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    ports: list[SystemDevice] = [SystemDevice("usb", 0x1234, 0x0001, "a lamp", "", "")]
    monkeypatch.setattr(discovery, "list_attached", lambda: ports)
    with pytest.raises(DeviceNotFound, match="select your rig with --rig"):
        probe.find_attached_rig()
    ports.append(SystemDevice("serial", 0x2988, 0x0302, "Geomagic Touch", "", "/dev/ttyACM0"))
    assert probe.find_attached_rig() == "touch"


BRIEFLY = ("openhaptics", "haply", "haply-2diy", "hapkit")
"""Drivers for which every way to end is tested each time; for the others only with the exhaustive tests."""
CASES = [
    pytest.param(course, name, marks=() if name in BRIEFLY or course == "Ctrl-C" else pytest.mark.exhaustive)
    for course in ("whole", "Ctrl-C", "unplugged")
    for name in FAR_RIGS
]


@pytest.mark.sampled(5)
@pytest.mark.parametrize(("course", "name"), CASES)
def test_the_far_end_has_no_more_than_a_push_and_zero_at_last(course, name, home, monkeypatch, capsys):
    monkeypatch.setattr(probe, "PART_S", 0.1)
    monkeypatch.setattr(probe, "PUSH_S", 0.4)
    with open(os.devnull) as nobody, FAR_RIGS[name](home, monkeypatch) as far:
        monkeypatch.setattr(sys, "stdin", nobody)
        acts = {"whole": lambda: None, "Ctrl-C": lambda: os.kill(os.getpid(), signal.SIGINT), "unplugged": far.unplug}
        with when_forced(far, 0.5 * probe.PUSH_N, acts[course]):
            code = main(["devices", "--probe", "mine.json", "--push", "--rig", far.rig])
        ends = course != "unplugged" or far.powerless
        settled(far.newest, lambda size: size == 0.0 or not ends)
        sizes = np.linalg.norm(far.forces_since(0)[:, 1:], axis=1)
    output = capsys.readouterr()
    assert code == {"whole": 0, "Ctrl-C": 130, "unplugged": 4}[course], output.err
    assert sizes[-1] == 0.0 or not ends
    assert 0.5 * probe.PUSH_N < sizes.max() <= probe.PUSH_N + far.resolution
    report = checked(home / "mine.json", home)
    assert report["ended"] == {"whole": "in full", "Ctrl-C": "stopped by the user", "unplugged": "by a fault"}[course]
    assert "hold the handle lightly: it pushes with 0.2 N" in output.err
    if course == "whole":
        assert [push["axis"] for push in report["pushes"]] == [f"+{axis}" for axis in far.sees]
        assert sizes.max() > 0.9 * probe.PUSH_N
        assert bool(report["freedom"]) == (far.sees != "xyz") and ("it moves " in output.out) == (far.sees != "xyz")
