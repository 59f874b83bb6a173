"""Forces received by the emulated device of every driver during `devices --probe --push`, for every way to end it."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.described_boards import settled
from helpers.far_ends import FAR_RIGS, when_forced
from test_device_report import checked, home

from softfinger.server.cli import main
from softfinger.tools.doctor import probe

__all__ = ["home"]  # a fixture

pytestmark = pytest.mark.real_time


BRIEFLY = ("openhaptics", "haply", "haply-2diy", "hapkit")
"""Drivers for which every way to end is tested each time; for the others only with the exhaustive tests."""
CASES = [
    pytest.param(course, name, marks=() if name in BRIEFLY or course == "Ctrl-C" else pytest.mark.exhaustive)
    for course in ("whole", "Ctrl-C", "unplugged")
    for name in FAR_RIGS
]


@pytest.mark.sampled(5)
@pytest.mark.parametrize(("course", "name"), CASES)
def test_the_far_end_has_no_more_than_a_push_and_zero_at_last(
    course: str, name: str, home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
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
