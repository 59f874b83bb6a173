"""The daemon: device, servo thread, publisher thread and supervisor, from start to the last zero force."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Final, Self

import numpy as np

from softfinger.config import schema
from softfinger.config.errors import DeviceLost, DeviceTimeout, HapticError, SafetyStop
from softfinger.config.load import build
from softfinger.drivers import base, registry
from softfinger.proxy.state import RECORD_SIZE
from softfinger.server import hotplug, realtime, servo
from softfinger.server.guard import GUARD_NAMES
from softfinger.server.telemetry import Publisher
from softfinger.server.tuning import make_tuning

log: Final = logging.getLogger(__name__)

STALL_POLLS: Final = 5
STALL_POLL_S: Final = 0.05
"""The servo has stalled when so many looks in a row, this far apart, find no new tick: a quarter of a second, which
is longer than any host stall seen and shorter than a hand needs to be hurt. Counting looks, not time: a process that
was suspended as a whole did not stall."""

STUCK_S: Final = 1.0
"""A servo that has stalled and not ended within this is stuck in its device: nobody waits for it any more."""
WAIT_POLL_S: Final = 0.25

BATCH: Final = 256


def open_device(config: schema.DeviceConfig, rate_hz: float, where: str = "[device]") -> base.Device:
    """Open the device a rig names; ConfigError for options its driver does not know."""
    driver = registry.load(config.driver)
    options = build(driver.Options, config.options, where)
    device: base.Device = driver.open_device(options, rate_hz)
    return device


class Daemon:
    """A running server. Construct (opens everything), `start`, `wait`, `close`; or use as a context.

    rig, scene   validated configuration
    ticks        how many ticks to run, None until stopped
    report       called from the servo thread with the outcome of each real-time setting

    Raises what opening a device or binding an endpoint raises; nothing stays open then.
    """

    def __init__(
        self,
        rig: schema.Rig,
        scene: schema.Scene,
        ticks: int | None = None,
        report: Callable[[list[realtime.Setting]], None] | None = None,
    ) -> None:
        self._report = report
        self._rig = rig
        self._failure: HapticError | None = None
        self._started = self._stuck = False
        self.publisher = Publisher(rig.telemetry.endpoint, rig.telemetry.every, guard_names=GUARD_NAMES)
        try:
            self.device = open_device(rig.device, rig.servo.rate_hz)
        except BaseException:
            self.publisher.close()
            raise
        try:
            tuning = make_tuning(scene, rig.guard, self.device.info)
            self.servo = servo.Servo(self.device, tuning, rig.servo.rate_hz, ticks, self._prepare)
        except BaseException:
            self.device.close()
            self.publisher.close()
            raise
        self._closing = threading.Event()
        self._threads = [
            threading.Thread(target=self._publish, name="publisher", daemon=True),
            threading.Thread(target=self._supervise, name="supervisor", daemon=True),
            threading.Thread(
                target=hotplug.watch, args=(self.publisher.event, self._closing), name="hotplug", daemon=True
            ),
        ]

    def start(self) -> None:
        """Compile what is not compiled yet, then start the threads; returns when the servo runs."""
        self.servo.compile()
        self.publisher.event("lifecycle", "started", device=self.device.info.name)
        for thread in self._threads:
            thread.start()
        self._started = True
        self.servo.start()

    def stop(self) -> None:
        """Ask the servo to end; from any thread or signal handler."""
        self.servo.stop()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait for the servo's end; True when it has ended.

        Raises what ended it, if that was not a stop, the last tick or the end of a recording:
        DeviceLost, DeviceTimeout, SafetyStop, RealtimeError or a programming error.
        """
        until = time.monotonic() + (math.inf if timeout_s is None else timeout_s)
        while (ended := self.servo.join(max(0.0, min(WAIT_POLL_S, until - time.monotonic())))) is None:
            if self._stuck and self._failure is not None:
                raise self._failure
            if time.monotonic() >= until:
                return False
        if self._failure is not None:
            raise self._failure
        if ended.error is not None:
            raise ended.error
        if ended.ending in (servo.READ_FAILED, servo.WRITE_FAILED):
            raise device_failure(self.device, ended)
        return True

    def close(self) -> None:
        """Stop the servo, release the device, send what is left. Any number of times."""
        self.servo.stop()
        if self._started:
            self._started = False
            # A servo that does not answer within this is stuck in its device; the device is stopped regardless.
            self.servo.join(timeout_s=2.0)
            self._closing.set()
            for thread in self._threads:
                thread.join(timeout=2.0)
            self.publisher.event("lifecycle", "stopped", ticks=self.servo.ticks)
        self.device.close()
        self.publisher.close()
        if not self.servo.running:
            self.servo.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _prepare(self) -> Callable[[], None]:
        wanted = self._rig.servo
        settings = realtime.apply(wanted.realtime, wanted.priority, wanted.cpu)
        if self._report is not None:
            self._report(settings.settings)
        return settings.undo

    def _publish(self) -> None:
        batch = np.empty((BATCH, RECORD_SIZE))
        try:
            running = True
            while running:
                self.servo.wait_record()
                running = self.servo.running  # asked before emptying the ring: what came before the end is sent
                while (count := self.servo.take(batch)) > 0:
                    self.publisher.publish(batch[:count], self.servo.drops)
        except Exception as error:
            log.exception("the publisher failed; stopping")
            self._fail(SafetyStop(f"telemetry cannot be published: {error}; nobody can see what is rendered"))

    def _supervise(self) -> None:
        """Zero the device when ticks stop coming though nobody asked them to."""
        seen, idle = -1, 0
        while self.servo.looping:
            time.sleep(STALL_POLL_S)
            ticks = self.servo.ticks
            idle = idle + 1 if ticks == seen else 0
            seen = ticks
            # The slowest loop ticks ten times between two looks. Before the first tick real-time settings are made.
            if idle >= STALL_POLLS and ticks > 0 and self.servo.looping:
                self.device.stop()
                stalled = SafetyStop(
                    f"no tick for {idle * STALL_POLL_S:.2f} s after tick {ticks}: zero force was commanded; "
                    "the device's exchange hangs, or this machine starves the servo thread"
                )
                self._fail(stalled)
                self.publisher.event("fault", "stalled", message=str(stalled))
                self._stuck = self.servo.join(STUCK_S) is None
                return

    def _fail(self, error: HapticError) -> None:
        self._failure = error
        self.servo.stop()


def device_failure(device: base.Device, ended: servo.Ended) -> HapticError:
    """The error of a device that failed on a read or a write, in its own words and with what to do."""
    doing = "read" if ended.ending == servo.READ_FAILED else "write"
    name, said = device.info.name, device.reason()
    because = f" ({said})" if said else ""
    if ended.status == base.FORCE_OFF:
        return SafetyStop(f"{name} turned its force off{because}: see to the cause, then start again")
    if ended.status == base.TIMEOUT:
        return DeviceTimeout(
            f"{name}: no answer to a {doing} in time{because}: check cable and power, then start again"
        )
    what = "answered what is not in its protocol" if ended.status == base.PROTOCOL else "is gone"
    return DeviceLost(f"{name} {what} (status {ended.status} on {doing}){because}: plug it in again, then start again")
