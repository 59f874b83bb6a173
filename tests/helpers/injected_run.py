"""Servo on a device with injected faults, supervised and recorded as in a daemon, without sockets."""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from softfinger.config.errors import HapticError
from softfinger.config.load import build, load_rig, load_scene
from softfinger.config.schema import Faults
from softfinger.drivers.base import Device
from softfinger.drivers.fault_injector import FaultInjector
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.server.loop import servo_thread as s
from softfinger.server.loop import shutdown
from softfinger.server.loop.guard import GUARD_NAMES
from softfinger.server.loop.tuning import make_tuning
from softfinger.server.recording.reader import End, Event, TickBlock, read_contents
from softfinger.server.recording.recorder import Recorder
from softfinger.server.services.supervisor import Supervisor

RAMP_S = 0.02
FROZEN_S = 0.1
WAIT_S = 30.0


class Seen(NamedTuple):
    """Result of a run: its error, None if it reached its last tick; names of the events in the recording, and of those
    reported by the supervisor; ticks done, and the recorded ones (n, RECORD_SIZE); start time of each of these, s of
    the monotonic clock (n,)."""

    error: HapticError | None
    events: list[str]
    ticks: int
    recorded: np.ndarray
    times: np.ndarray


def run(
    device: Device,
    faults: list[dict[str, Any]],
    ticks: int,
    rate_hz: float,
    folder: Path,
    after_tick: Callable[[int], object] = lambda _: None,
) -> Seen:
    """Run this number of ticks on the paper's plane with all supervision, then close the device.

    folder  folder of the recording
    each    called with the number of ticks done, whenever it has increased
    """
    never = [{"kind": "stale", "at_tick": ticks + 1}]
    injected = FaultInjector(device, build(Faults, {"fault": faults or never}, "faults"), rate_hz)
    guard = load_rig("replay", {"guard.ramp_s": RAMP_S, "guard.frozen_s": FROZEN_S}).guard
    servo = s.ServoThread([injected], make_tuning(load_scene("paper-plane"), guard, [injected.info]), rate_hz, ticks)
    servo.compile()
    names: list[str] = []
    failures: list[HapticError] = []

    def fail(error: HapticError) -> None:
        failures.append(error)
        servo.stop()

    path = folder / "run.mcap"
    recorder = Recorder(path.open("wb", buffering=0), [""], {}, lambda *_: None, GUARD_NAMES)
    supervisor = Supervisor(servo, fail, lambda kind, name, **_: names.append(name))
    reader = threading.Thread(target=_hand_on, args=(servo, recorder.ticks, after_tick))
    try:
        servo.start()
        supervisor.start()
        reader.start()
        ended = servo.join(WAIT_S)
        assert ended is not None, "the servo has not ended"
    finally:
        servo.stop()
        reader.join(WAIT_S)
        supervisor.stop()
        injected.close()
        recorder.stop(WAIT_S)
    error = failures[0] if failures else ended.error
    error = error or shutdown.describe_failure(injected, ended)
    error = error or shutdown.describe_loop_failure(ended, servo.ticks, servo.missed, servo.woken_late)
    count, epoch_s = servo.ticks, servo.epoch_s
    servo.close()
    events, recorded = read(path)
    return Seen(error, events + names, count, recorded, recorded[:, AT.timestamp] - epoch_s)


def _hand_on(servo: s.ServoThread, take: Callable[[np.ndarray], None], after_tick: Callable[[int], object]) -> None:
    out = np.empty((1024, RECORD_SIZE))
    running = True
    while running:
        servo.records.wait()
        running = servo.is_running
        after_tick(servo.ticks)
        while (count := servo.records.take(out)) > 0:
            take(out[:count])


def read(path: Path) -> tuple[list[str], np.ndarray]:
    """Return the names of a recording's events, and its ticks."""
    parts = list(read_contents(path))
    (end,) = [part for part in parts if isinstance(part, End)]
    assert end.cut == ""
    ticks = [part.records() for part in parts if isinstance(part, TickBlock)]
    rows = np.concatenate(ticks) if ticks else np.empty((0, RECORD_SIZE))
    return [part.event["name"] for part in parts if isinstance(part, Event)], rows
