"""Devices that stop answering under a force: what each emulated device received, in the scene of injected faults."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from faults_seen import SEEN
from helpers.far_ends import FAR_ENDS, RATE_HZ
from helpers.injected_run import run
from test_injected_faults import TURN, find_ticks

from softfinger.config.errors import DeviceTimeout
from softfinger.drivers.haply.options import Options as HaplyOptions
from softfinger.tools.pages.hazards import ABANDON_S, SILENCE_S, find_default

pytestmark = pytest.mark.real_time

DRIVERS = {"serial": "serial", "hid": "hid", "falcon": "falcon", "haply": "haply", "haply-2diy": "serial",
           "hapkit": "serial"}  # fmt: skip
"""Driver of each device that can become silent."""
PRESSED_TICKS = 200
"""Ticks before the silence: enough for the ramp and a visible press."""
ANSWERS = 2
"""Ticks by which an answer in transit may delay the start of the silence."""


def quiet_options(driver: str) -> dict[str, float]:
    key = "kick_s" if driver in ("falcon", "hid") else "quiet_s"
    stale = {"stale_s": find_default(HaplyOptions, "stale_s")} if driver == "haply" else {}
    return {key: SILENCE_S[driver], "timeout_s": ABANDON_S[driver], **stale}


@pytest.mark.parametrize("name", DRIVERS)
def test_a_silent_device_gets_zero_and_then_counts_as_lost(
    name: str, tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    driver = DRIVERS[name]
    with FAR_ENDS[name](tmp_path, **quiet_options(driver)) as far:
        assert far.hush is not None
        hushed: list[float] = []

        def hush(ticks: int) -> None:
            if ticks >= PRESSED_TICKS and not hushed:
                far.hush()
                hushed.append(time.monotonic())

        result = run(far.device, [], 20_000, RATE_HZ, tmp_path, hush)
        wrenches = far.received()
    assert type(result.error) is DeviceTimeout, result.error
    (at,) = find_ticks(np.array(hushed), result)
    ticks, norms = find_ticks(wrenches[:, 0], result), np.linalg.norm(wrenches[:, 1:], axis=1)
    assert norms[ticks < at].max() > 0.0, "the hand did not press before the silence"
    assert norms[-1] == 0.0
    zero = np.flatnonzero(norms)[-1] + 1  # a board holds its last force until it receives another
    zero_after = int(ticks[zero] - at)
    assert zero_after <= round(SILENCE_S[driver] * RATE_HZ) + far.handover + TURN
    assert result.ticks <= at + round(ABANDON_S[driver] * RATE_HZ) + ANSWERS + TURN
    record_property(
        SEEN,
        {
            "hazard": "a device that is silent, or sends invalid data", "driver": name, "fault": "silence",
            "ticks": zero_after, "event": "state faulted", "state": "faulted", "recovery": "start again", "back": None,
            "handover": far.handover,
        },
    )  # fmt: skip
