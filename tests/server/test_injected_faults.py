"""Faults injected between every driver and the loop, and silent devices: wrenches at the far end, events, recovery.

Forces are those that the device's far end has received (`helpers/far_ends.py`). All tests use one scene, so one loop is
compiled (20 s).
"""

import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from faults_seen import SEEN
from helpers.far_ends import FAR_ENDS, RATE_HZ, TIMELESS, FarEnd
from helpers.injected_run import FROZEN_S, RAMP_S, Seen, run

from softfinger.config.errors import DeviceError, DeviceLost, DeviceTimeout, SafetyStop
from softfinger.config.load import build, load_rig
from softfinger.config.schema import Faults
from softfinger.config.schema.pairing import find_single_device
from softfinger.drivers.base import IGNORED_WRENCH_MAX_S, LOST
from softfinger.drivers.fault_injector import FaultInjector
from softfinger.drivers.haply.options import Options as HaplyOptions
from softfinger.drivers.registry import open_device
from softfinger.proxy.record import AT
from softfinger.server.driver_contract import DeviceCaller
from softfinger.server.loop.fault_detection import NO_FORCE_MAX_S, STALL_MAX_S
from softfinger.tools.pages.hazards import ABANDON_S, SILENCE_S, find_default

pytestmark = pytest.mark.real_time

FORCE_MAX_N = 12.0
"""Limit of the rig."""
STEP_N = 2.0
"""Change per tick by the slew limit, at 1 kHz."""
TOUCH_N = 0.1
"""Less than the force of any of these hands after the ramp."""
RAMP_TICKS = round(RAMP_S * RATE_HZ)
AFTER = 150
"""Ticks after the fault: the ramp, and enough to show that the force is back."""
FULL_N = 1.2
"""At least the force of the replay: 1 N, and 0.6 times that of friction."""
MOMENTS = {"first": 0, "ramp": RAMP_TICKS // 2, "contact": 100}


class Case(NamedTuple):
    """Fault and its expected effects.

    fault   without its tick
    lasts   duration in ticks
    event   name of the published event; empty: none
    zero    ticks until the device has zero; None: it keeps a force, within the guard's limits
    ends    error that ends the run; None: the run continues and the force returns
    within  ticks until that end
    """

    fault: dict[str, Any]
    lasts: int = 1
    event: str = ""
    zero: int | None = None
    ends: type[Exception] | None = None
    within: int = 1


STALLED = round(RATE_HZ * STALL_MAX_S)
SILENT = round(RATE_HZ * NO_FORCE_MAX_S) + 2
HELD = round(RATE_HZ * IGNORED_WRENCH_MAX_S) + 2
FROZEN = round(RATE_HZ * FROZEN_S)

CASES = {
    "stale": Case({"kind": "stale"}, 20),
    "stale for long": Case({"kind": "stale"}, 2 * FROZEN, "pose_frozen", zero=FROZEN + FROZEN // 5),
    "frozen": Case({"kind": "frozen"}, 20),
    "frozen for long": Case({"kind": "frozen"}, 2 * FROZEN, "pose_frozen", zero=FROZEN + FROZEN // 5),
    "nan": Case({"kind": "nan", "number": "y"}, 20, "pose_refused", zero=0),
    "nan rotation": Case({"kind": "nan", "number": "qw"}, 1, "pose_refused", zero=0),
    "nan for long": Case({"kind": "nan"}, 900, "pose_refused", 0, DeviceError, SILENT),
    "infinite": Case({"kind": "infinite", "number": "z"}, 20, "pose_refused", zero=0),
    "short": Case({"kind": "short", "numbers": 3}, 5, "pose_refused", zero=0),
    "teleport": Case({"kind": "teleport", "offset_m": [0.0, 0.0, -0.9]}, 1, "pose_jumped", zero=0),
    "jumping": Case({"kind": "teleport", "offset_m": [0.9, 0.0, 0.0], "every_ticks": 2}, 40, "pose_jumped", 0,
                    DeviceError, 20),
    "corrupt": Case({"kind": "corrupt", "every_ticks": 50}, 100),
    "bounce": Case({"kind": "bounce"}, 20),
    "slow read": Case({"kind": "slow", "block_s": 0.01}, 3, "missed"),
    "slow write": Case({"kind": "slow", "block_s": 0.01, "on": "write"}, 3, "missed"),
    "hang": Case({"kind": "slow", "block_s": 0.6}, 1, "stalled", STALLED, SafetyStop, 3),
    "disconnect": Case({"kind": "disconnect"}, 100, "", 0, DeviceLost),
    "timeout": Case({"kind": "timeout"}, 1, "", 0, DeviceTimeout),
    "timeout write": Case({"kind": "timeout", "on": "write"}, 1, "", 1, DeviceTimeout),
    "protocol": Case({"kind": "protocol"}, 1, "", 0, DeviceLost),
    "protocol write": Case({"kind": "protocol", "on": "write"}, 1, "", 1, DeviceLost),
    "force off": Case({"kind": "force_off"}, 1, "", 0, SafetyStop),
    "withheld": Case({"kind": "withheld"}, 20, "ramping", zero=0),
    "held": Case({"kind": "held"}, 20),
    "held for long": Case({"kind": "held"}, 400, "", HELD, DeviceTimeout, HELD),
    "swallowed": Case({"kind": "swallowed"}, 20),
}  # fmt: skip


def run_with_fault(driver: str, name: str, at: int, tmp_path: Path) -> tuple[Seen, FarEnd, np.ndarray]:
    """Run with a fault at a tick; return the far end, too, and its forces, each with its tick."""
    case = CASES[name]
    fault = case.fault | {"at_tick": at, "ticks": case.lasts}
    with FAR_ENDS[driver](tmp_path) as far:
        result = run(far.device, [fault], at + case.lasts + AFTER, RATE_HZ, tmp_path)
        wrenches = far.received()
    return result, far, np.column_stack([find_ticks(wrenches[:, 0], result), wrenches[:, 1:]])


def find_ticks(times: np.ndarray, result: Seen) -> np.ndarray:
    """Return the tick of each time (n,), -1 before the first; ticks are counted on after the last one."""
    rows = np.arange(len(times), dtype=float)
    if not result.ticks:
        return rows - 1.0  # no tick was finished: all wrenches are from the shutdown
    late = np.maximum(times - result.times[-1], 0.0) * RATE_HZ
    ticks = np.searchsorted(result.times, times, side="right") - 1.0
    return np.where(np.isnan(times), rows, ticks + np.floor(late))


def check_end(name: str, at: int, result: Seen, withholds: bool = False) -> None:
    """Check ending, events and recorded ticks; `withholds`: the driver gives zero before the guard does."""
    case = CASES[name]
    if case.ends is None:
        assert result.error is None, result.error
        assert result.ticks == at + case.lasts + AFTER
    else:
        assert type(result.error) is case.ends, result.error
        assert case.fault["kind"] in str(result.error) or case.event == "stalled"
        assert at <= result.ticks <= at + case.within
    if case.event:
        assert case.event in result.events or (withholds and name == "stale for long" and "ramping" in result.events)
    assert result.recorded[:, AT.tick].tolist() == list(range(result.ticks))


def check_limits(forces: np.ndarray) -> np.ndarray:
    """Check the guard's limit, the slew of each tick, and the last zero; return the norms of the forces."""
    norms: np.ndarray = np.linalg.norm(forces, axis=1)
    assert norms.max() <= FORCE_MAX_N and norms[-1] == 0.0
    steps = np.linalg.norm(np.diff(forces, axis=0, prepend=np.zeros((1, 3))), axis=1)
    assert np.all((steps <= STEP_N * (1.0 + 1e-9)) | (norms == 0.0))  # rounding; zero is always allowed
    return norms


@pytest.mark.parametrize(
    "moment", [pytest.param(when, marks=[pytest.mark.exhaustive] * (when == "first")) for when in MOMENTS]
)
@pytest.mark.parametrize("name", CASES)
def test_an_injected_fault_leaves_no_unpermitted_force(name: str, moment: str, tmp_path: Path) -> None:
    case, at = CASES[name], MOMENTS[moment]
    result, _, wrenches = run_with_fault("replay", name, at, tmp_path)
    check_end(name, at, result)
    norms = check_limits(wrenches[:, 1:])
    if case.zero is not None:
        # A first pose is never a jump, the next one is.
        late = int(at == 0 and case.event == "pose_jumped")
        assert norms[at : at + case.zero + late + 1].min() == 0.0
    if case.event == "pose_refused" or case.fault["kind"] == "withheld":
        assert not norms[at : min(at + case.lasts, result.ticks)].any()
    if case.ends is None:
        if case.zero is not None:
            assert norms[at + case.lasts] <= FULL_N * 2.0 / RAMP_TICKS
        assert norms[-AFTER // 2 : -2].min() > TOUCH_N  # the hand still presses
    else:
        assert len(norms) <= result.ticks + 2  # the failed tick may have been written, and the zero of the stop


def test_wrenches_that_are_not_taken_count_from_the_last_one_that_was(tmp_path: Path) -> None:
    duration = HELD * 3 // 4
    faults = [{"kind": "held", "at_tick": at, "ticks": duration} for at in (50, 50 + duration + 1)]
    with FAR_ENDS["replay"](tmp_path) as far:
        result = run(far.device, faults, 100 + 2 * duration, RATE_HZ, tmp_path)
    assert result.error is None and result.ticks == 100 + 2 * duration


EVERYWHERE = {
    "nan": "a pose that is not finite, out of range or short",
    "infinite": "a pose that is not finite, out of range or short",
    "teleport": "a pose that jumps",
    "stale for long": "a pose that does not change under a force",
    "slow read": "ticks that are missed",
    "hang": "a loop that stalls",
    "held for long": "a device that accepts no force",
    "disconnect": "a device that is lost or breaks its protocol",
    "force off": "a device that removes its force",
}
"""Faults injected into every driver, and their rows of the fault model."""
ALWAYS = {(driver, name) for driver in FAR_ENDS for name in ("nan", "disconnect")}
"""Pairs for `make test`."""
TURN = 5
"""Ticks that a thread of the far end may wait for the scheduler."""
GROWS = 1.5
"""Bound of the force's growth within a few ticks by the motion of these hands, relative to the force before."""


@pytest.mark.parametrize(
    ("driver", "name"),
    [
        pytest.param(driver, name, marks=[pytest.mark.exhaustive] * ((driver, name) not in ALWAYS))
        for driver in FAR_ENDS
        for name in EVERYWHERE
        if driver not in TIMELESS or name not in ("hang", "held for long")
    ],
)
def test_on_every_driver(driver, name, tmp_path, record_property):
    case, at = CASES[name], 200
    result, far, wrenches = run_with_fault(driver, name, at, tmp_path)
    check_end(name, at, result, far.withholds)
    ticks, norms = wrenches[:, 0], np.linalg.norm(wrenches[:, 1:], axis=1)
    assert norms[-1] == 0.0
    before = norms[(ticks >= at - 50) & (ticks < at)].max()
    assert before > 0.0, "the hand did not press before the fault"
    assert norms.max() <= FORCE_MAX_N
    zero_after = None
    if case.zero is not None:
        late = far.handover + TURN
        zero_after = measure_ticks_to_zero(ticks, norms, at, case.zero == 0)
        assert zero_after <= case.zero + late
        assert norms[(ticks >= at) & (ticks <= at + case.zero + late)].max(initial=0.0) <= GROWS * before
        if case.event == "pose_refused":
            assert not norms[(ticks >= at + late) & (ticks < at + case.lasts)].any()
    back_at = None
    if case.ends is None:
        back = np.flatnonzero((ticks >= at + case.lasts) & (norms > 0.5 * before))
        assert len(back), "the force did not come back"
        back_at = int(ticks[back[0]]) - at - case.lasts
    outcome = (
        "state faulted" if case.ends else f"guard {case.event}" if case.zero is not None else f"servo {case.event}"
    )
    record_property(
        SEEN,
        {
            "hazard": EVERYWHERE[name], "driver": driver, "fault": name, "ticks": zero_after, "event": outcome,
            "state": "faulted" if case.ends else "armed",
            "recovery": "start again" if back_at is None else "the ramp", "back": back_at, "handover": far.handover,
        },
    )  # fmt: skip


def measure_ticks_to_zero(ticks: np.ndarray, norms: np.ndarray, at: int, at_once: bool) -> int:
    """Return the ticks from `at` to the first zero at the far end; if due at once, at most the forces between."""
    behind = np.flatnonzero(ticks >= at)
    assert not norms[behind].all(), "the far end was given no zero"
    first = behind[np.flatnonzero(norms[behind] == 0.0)[0]]
    ticks_to_zero = int(ticks[first]) - at
    return min(ticks_to_zero, int(np.count_nonzero(behind < first))) if at_once else ticks_to_zero


DRIVERS = {"serial": "serial", "hid": "hid", "falcon": "falcon", "haply": "haply", "haply-2diy": "serial",
           "hapkit": "serial"}  # fmt: skip
"""Driver of each device that can become silent."""
LONGER = 5.0
"""Factor of the driver's default time after which it abandons the device: on a busy machine, the thread of a far end
may wait longer than that before the silence."""
PRESSED_TICKS = 200
"""Least number of ticks before the silence: enough for the ramp and a visible press."""
ANSWERS = 2
"""Ticks by which an answer in transit may delay the start of the silence."""


@pytest.mark.parametrize("name", DRIVERS)
def test_a_silent_device_gets_zero_and_then_counts_as_lost(name, tmp_path, record_property):
    driver, hushed = DRIVERS[name], list[float]()
    timeout_s = LONGER * ABANDON_S[driver]
    key = "kick_s" if driver in ("falcon", "hid") else "quiet_s"
    stale = {"stale_s": find_default(HaplyOptions, "stale_s")} if driver == "haply" else {}
    quiet = {key: SILENCE_S[driver], "timeout_s": timeout_s, **stale}
    with FAR_ENDS[name](tmp_path, **quiet) as far:

        def hush(ticks: int) -> None:
            if ticks >= PRESSED_TICKS and not hushed and far.newest() > 0.0:
                far.hush()
                hushed.append(time.monotonic())

        result = run(far.device, [], 20_000, RATE_HZ, tmp_path, hush)
        wrenches = far.received()
        arrived = np.array(far.idle_before()) if far.idle_before else wrenches[:, 0]
    assert type(result.error) is DeviceTimeout, result.error
    (at,) = find_ticks(np.array(hushed), result)
    ticks, norms = find_ticks(wrenches[:, 0], result), np.linalg.norm(wrenches[:, 1:], axis=1)
    assert norms[ticks < at].max() > 0.0, "the hand did not press before the silence"
    assert norms[-1] == 0.0
    zero = np.flatnonzero(norms)[-1] + 1  # a board holds its last force until it receives another
    zero_after = int(ticks[zero] - at)
    (arrived_at,) = find_ticks(arrived[zero : zero + 1], result)
    assert arrived_at - at <= round(SILENCE_S[driver] * RATE_HZ) + far.handover + TURN
    assert result.ticks <= at + round(timeout_s * RATE_HZ) + ANSWERS + TURN
    record_property(
        SEEN,
        {
            "hazard": "a device that is silent, or sends invalid data", "driver": name, "fault": "silence",
            "ticks": zero_after, "event": "state faulted", "state": "faulted", "recovery": "start again", "back": None,
            "handover": far.handover,
        },
    )  # fmt: skip


def test_a_failure_outweighs_other_faults_of_its_tick() -> None:
    """The order of the faults in the file does not matter."""
    kinds = ("disconnect", "stale", "withheld", "held")
    for order in (kinds, kinds[::-1]):
        faults = build(Faults, {"fault": [{"kind": kind, "at_tick": 0} for kind in order]}, "faults")
        with FaultInjector(open_device(find_single_device(load_rig("replay")), RATE_HZ), faults, RATE_HZ) as device:
            servo = DeviceCaller(device)
            assert servo.read()[0] == LOST
            assert servo.write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0) == LOST
