"""`softfinger run` in contact on the emulated device of every driver: forces received after signals and faults."""

from __future__ import annotations

import os
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
SIGNALS = {signal.SIGTERM: 0, signal.SIGINT: 0, signal.SIGHUP: 129, signal.SIGQUIT: 131}
"""Signals of a terminal, a shell and systemd, with the exit code of each."""


def when_pressed(far: Far, act: Callable[[], object]) -> AbstractContextManager[list[float]]:
    def begin(over: threading.Event) -> None:
        while not over.wait(0.005) and len(far.given(0)) <= 50:
            pass
        far.press()

    return when_forced(far, CONTACT_N, act, begin)


def words(far: Far, folder: Path) -> list[str]:
    return ["run", "--rig", far.rig, "--scene", "paper-plane", "--endpoint", f"ipc://{folder}/t",
            "--commands", f"ipc://{folder}/c", "--duration", "60"]  # fmt: skip


BRIEFLY = ("openhaptics", "haply", "haply-2diy", "hapkit", "serial")
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
    number: signal.Signals, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with FAR_RIGS[name](tmp_path, monkeypatch) as far:
        with when_pressed(far, lambda: os.kill(os.getpid(), number)) as sent:
            code = main(words(far, tmp_path))
        settled(far.newest, lambda size: size == 0.0)
        given = far.given(0)
    assert sent and code == SIGNALS[number]
    sizes = np.linalg.norm(given[:, 1:], axis=1)
    assert sizes.max() > CONTACT_N and sizes[-1] == 0.0
    last = given[np.flatnonzero(sizes)[-1] + 1, 0]  # the zero after the last force
    assert last - sent[0] < SIGNAL_S


class Fault(NamedTuple):
    act: Callable[[Far], object]
    code: int
    says: str
    zero: bool = True


def nothing_but_null(far: Far) -> None:
    """Send null, as the maker's JSON writes a NaN."""
    far.device.set(
        spoil=f'{{"inverse3":[{{"device_id":"{ID}","state":{{"cursor_position":{{"x":null,"y":0,"z":0}}}}}}]}}'
    )


def as_text(far: Far) -> None:
    far.device.spoil = lambda frame: frame[:1] + b"     nan".ljust(8) + frame[9:]


def turned_round(far: Far) -> None:
    slowly(lambda share: far.device.turn(0.05 + 1.95 * share))


NO_POSE = "no usable pose for 0.5 s"
SILENT = "no answer to a read in time"
FAULTS: dict[str, dict[str, Fault]] = {
    "openhaptics": {
        "unplugged": Fault(lambda far: far.unplug(), 4, "does not answer"),
        "silent": Fault(lambda far: far.device.update(hang_at=0), 4, SILENT),
        "no number": Fault(lambda far: far.device.update(mirror=1), 4, NO_POSE),
    },
    "haply": {
        "no number": Fault(nothing_but_null, 4, NO_POSE),
        "later than it may be": Fault(lambda far: far.device.set(late_s=1.5), 4, SILENT),
    },
    "haply-2diy": {"later than it may be": Fault(lambda far: late(far, 1.5), 4, SILENT)},
    "hapkit": {
        "unplugged": Fault(lambda far: far.unplug(), 4, "is gone", zero=False),
        "silent": Fault(lambda far: far.device.mute(), 4, SILENT),
        "out of range": Fault(turned_round, 4, "not in its protocol"),
    },
    "serial": {
        "later than it may be": Fault(lambda far: late(far, 1.5), 4, SILENT),
        "no number": Fault(as_text, 4, "not in its protocol"),
    },
}  # fmt: skip
"""Cases that the loop tests of the drivers do not contain. Unplugged or silent boards and a haply that is unplugged,
silent or not in the list are in `test_haply_loop`, `test_serial_loop`, `test_serial_boards_loop`."""


def late(far: Far, by_s: float) -> None:
    def wait(answer: bytes) -> bytes:
        time.sleep(by_s)
        return answer

    setattr(far.device, "spoil" if hasattr(far.device, "spoil") else "says", wait)


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("name", "fault"),
    [pytest.param(name, fault, id=f"{fault}-{name}") for name, faults in FAULTS.items() for fault in faults],
)
def test_a_fault_in_contact_ends_the_run_without_force(
    name: str, fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    case = FAULTS[name][fault]
    with FAR_RIGS[name](tmp_path, monkeypatch) as far:
        with when_pressed(far, lambda: case.act(far)) as done:
            code = main(words(far, tmp_path))
        if case.zero:
            settled(far.newest, lambda size: size == 0.0)
        newest = far.newest()
    said = capsys.readouterr().err
    assert done and code == case.code, said
    errors: list[Any] = [line for line in said.splitlines() if line.startswith("softfinger: ")]
    assert len(errors) == 1 and case.says in errors[0], said
    assert newest == 0.0 or not case.zero
