"""`softfinger run` in contact on the emulated device of every driver: forces received after signals and faults."""

from __future__ import annotations

import logging
import os
import re
import signal
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from helpers.described_boards import settled
from helpers.far_rigs import FAR_RIGS, Far, slowly, when_forced
from helpers.haply_devices import ID

from softfinger.server.cli import main

pytestmark = pytest.mark.real_time

CONTACT_N = 0.3
"""Less than the force of any of these hands."""
SIGNAL_S = 1.0
"""Maximum time from a signal to the last force (`server/signals.py`)."""
SIGNALS = {signal.SIGTERM: 0, signal.SIGINT: 0, signal.SIGHUP: 129, signal.SIGQUIT: 131,
           signal.SIGUSR1: 138, signal.SIGXCPU: 152}  # fmt: skip
"""Signals of a terminal, a shell, systemd, other programs and the kernel, with the exit code of each."""


def when_pressed(far: Far, act: Callable[[], object]) -> AbstractContextManager[list[float]]:
    def begin(over: threading.Event) -> None:
        while not over.wait(0.005) and len(far.forces_since(0)) <= 50:
            pass
        far.press()

    return when_forced(far, CONTACT_N, act, begin)


def words(far: Far, folder: Path) -> list[str]:
    return ["run", "--rig", far.rig, "--scene", "paper-plane", "--endpoint", f"ipc://{folder}/t",
            "--commands", f"ipc://{folder}/c", "--duration", "60"]  # fmt: skip


BRIEFLY = ("openhaptics", "haply", "haply-2diy", "hapkit", "serial", "forcedimension", "falcon")
CASES = [
    pytest.param(
        number, name, id=f"{number.name}-{name}",
        marks=() if number is signal.SIGTERM and name in BRIEFLY else pytest.mark.exhaustive,
    )
    for number in SIGNALS
    for name in FAR_RIGS
]  # fmt: skip


@pytest.mark.parametrize(("number", "name"), CASES)
def test_a_signal_in_contact_ends_the_force_within_a_second(
    number: signal.Signals, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    with FAR_RIGS[name](tmp_path, monkeypatch) as far:
        with when_pressed(far, lambda: os.kill(os.getpid(), number)) as sent:
            code = main(words(far, tmp_path))
        settled(far.newest, lambda size: size == 0.0)
        forces = far.forces_since(0)
    assert sent and code == SIGNALS[number] and "force is zero" in caplog.text
    sizes = np.linalg.norm(forces[:, 1:], axis=1)
    assert sizes.max() > CONTACT_N and sizes[-1] == 0.0
    last = forces[np.flatnonzero(sizes)[-1] + 1, 0]  # the zero after the last force
    assert last - sent[0] < SIGNAL_S


class Fault(NamedTuple):
    """Action on a device in contact and error text; `zero` unless the device is then unreachable."""

    act: Callable[[Far], object]
    message: str
    zero: bool = True
    brief: bool = False


def answers(spoil: Callable[[bytes], bytes]) -> Callable[[Far], object]:
    return lambda far: setattr(far.device, "spoil", spoil)


def late(answer: bytes) -> bytes:
    time.sleep(1.5)
    return answer


def nothing_but_null(far: Far) -> None:
    """Send null, as the maker's JSON writes a NaN."""
    far.device.set(
        spoil=f'{{"inverse3":[{{"device_id":"{ID}","state":{{"cursor_position":{{"x":null,"y":0,"z":0}}}}}}]}}'
    )


def turned_round(far: Far) -> None:
    slowly(lambda share: far.device.turn(0.05 + 1.95 * share))


NO_POSE = "no usable pose for 0.5 s"
SILENT = "no answer to a read in time"
NO_FRAME = "violates its protocol .*its last bytes are "
FAULTS: dict[str, dict[str, Fault]] = {
    "openhaptics": {
        "unplugged": Fault(lambda far: far.unplug(), "does not answer"),
        "silent": Fault(lambda far: far.device.update(hang_at=0), SILENT),
        "no number": Fault(lambda far: far.device.update(mirror=1), NO_POSE),
    },
    "haply": {
        "unplugged": Fault(lambda far: far.unplug(), "inverse3 049D is no longer in the service's list", brief=True),
        "killed": Fault(
            lambda far: far.device.kill(),
            "closed the connection|connection to the Inverse Service was lost",
            zero=False,
            brief=True,
        ),
        "silent": Fault(lambda far: far.device.set(mute=True), SILENT, brief=True),
        "garbage": Fault(
            lambda far: far.device.set(spoil="<html>"), "violates its protocol .*answered '<html>'", brief=True
        ),
        "no number": Fault(nothing_but_null, NO_POSE),
        "later than it may be": Fault(lambda far: far.device.set(late_s=1.5), SILENT),
    },
    "haply-2diy": {
        "unplugged": Fault(lambda far: far.unplug(), r"serial at /dev/pts/\d+ is gone", zero=False, brief=True),
        "silent": Fault(lambda far: far.device.mute.set(), SILENT, brief=True),
        "no number": Fault(answers(lambda answer: answer[:1] + b"\xff\xff\xff\x7f" + answer[5:]), NO_FRAME, brief=True),
        "torn": Fault(answers(lambda answer: answer[:5]), f"{SILENT}|violates its protocol", brief=True),
        "later than it may be": Fault(answers(late), SILENT),
    },
    "hapkit": {
        "unplugged": Fault(lambda far: far.unplug(), "is gone", zero=False),
        "silent": Fault(lambda far: far.device.hush(), SILENT),
        "out of range": Fault(turned_round, "violates its protocol"),
    },
    "serial": {
        "unplugged": Fault(
            lambda far: far.unplug(), r"serial 16c0:0483 at /dev/pts/\d+ is gone", zero=False, brief=True
        ),
        "silent": Fault(lambda far: far.device.hush(), SILENT, brief=True),
        "garbage": Fault(answers(lambda frame: frame.replace(b".", b",")), f"{NO_FRAME}b'.*,", brief=True),
        "no number": Fault(answers(lambda frame: frame[:1] + b"     nan".ljust(8) + frame[9:]), NO_FRAME),
        "later than it may be": Fault(answers(late), SILENT),
    },
}


@pytest.mark.parametrize(
    ("name", "case"),
    [
        pytest.param(name, case, id=f"{fault}-{name}", marks=() if case.brief else pytest.mark.exhaustive)
        for name, faults in FAULTS.items()
        for fault, case in faults.items()
    ],
)
def test_a_fault_in_contact_ends_the_run_without_force(
    name: str, case: Fault, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with FAR_RIGS[name](tmp_path, monkeypatch) as far:
        with when_pressed(far, lambda: case.act(far)) as acted:
            code = main(words(far, tmp_path))
        assert not case.zero or settled(far.newest, lambda size: size == 0.0) == 0.0
    stderr = capsys.readouterr().err
    assert acted and code == 4, stderr
    errors: list[Any] = [line for line in stderr.splitlines() if line.startswith("softfinger: ")]
    assert len(errors) == 1 and re.search(case.message, errors[0]), stderr
