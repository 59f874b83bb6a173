"""Servo: the thread that runs the loop with open devices, and its interface to Python.

It arms the devices before the first tick and stops them after the last, replaces one loop by another, accepts new
parameters and provides the records.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, Final

import numba
import numpy as np
from numpy.typing import NDArray

from softfinger.config.errors import RealtimeError, SafetyStop
from softfinger.drivers.base import IGNORED_WRENCH_MAX_S, Device, DeviceIO
from softfinger.proxy.bodies import begin_bodies, count_motion_values
from softfinger.proxy.kernels.jit.decorators import PLAIN
from softfinger.proxy.kernels.jit.seqlock import make_slot, publish
from softfinger.proxy.record import RECORD_SIZE
from softfinger.server.loop import shutdown
from softfinger.server.loop.all_devices import make_device_buffers
from softfinger.server.loop.clock import NS_PER_S, compute_period_ns
from softfinger.server.loop.force_switch import make_switch
from softfinger.server.loop.handover import Handover, Loop
from softfinger.server.loop.parameter_ramp import flatten_tuning, make_ramp
from softfinger.server.loop.rings import Rings, make_ring, take
from softfinger.server.loop.servo import Schedule, Scratch, SharedMemory, run_servo_loop
from softfinger.server.loop.shutdown import CRASHED, FINISHED, STOPPED, LoopEnd
from softfinger.server.loop.tick import Tuning, continue_memory, make_start_memory
from softfinger.server.loop.tuning import has_same_structure

log: Final = logging.getLogger(__name__)

RING_SECONDS: Final = 8
"""Time for which the reader of records may be delayed before records are lost."""

HANDOVER_S: Final = 5.0
"""A loop that takes longer to end, or to start after another one, hangs in its device."""
HANDOVER_POLL_S: Final = 0.05


def require_machine_code(work: str) -> None:
    """Raise RealtimeError if kernels run as plain Python; `work`, for the message, cannot."""
    if PLAIN:
        raise RealtimeError(f"NUMBA_DISABLE_JIT is set, but {work} needs machine code: unset it")


class ServoThread:
    """Thread that runs a loop with open devices, and possibly further loops after it.

    devices  an open device for each of the scene's fingers; the servo commands zero to all of them whenever and however
             it ends, but does not close them
    tuning   scene and guard
    rate_hz  tick rate
    ticks    number of ticks to run, None until stopped
    ramp_s   duration of the ramp of parameters changed by `tune` that act on the force; 0: at once
    switch   switch of the force (`force_switch.py`); by default a new one, which is on
    prepare  called in the servo thread before the first tick (real-time settings); it returns a function that is called
             in the same thread after the last tick

    The devices are armed in that thread after all other preparations, immediately before the first tick.

    Call `compile`, `start`, then repeatedly `records.wait` and `records.take`, and finally `stop` and `join`.
    """

    def __init__(
        self,
        devices: Sequence[Device],
        tuning: Tuning,
        rate_hz: float,
        ticks: int | None = None,
        prepare: Callable[[], Callable[[], None]] | None = None,
        ramp_s: float = 0.0,
        switch: NDArray[np.int64] | None = None,
    ) -> None:
        self._ticks, self._prepare, self._ramp_s = -1 if ticks is None else ticks, prepare, ramp_s
        self._recent_tunings: list[Tuning] = []
        self._tuned_tick = 0
        self._ended: LoopEnd | None = None
        self._stopping = False
        self.is_armed = False
        """True if the devices have been armed; from then on a tick is due."""
        self._handover: Handover | None = None
        self._finished = threading.Event()
        # CLOCK_MONOTONIC is slewed with the wall clock but never stepped, so one offset is valid for the run.
        self._epoch_ns = _read_epoch_offset_ns()
        self.switch: Final = make_switch() if switch is None else switch
        self._words = np.zeros(8, np.int64), np.zeros(8, np.int64), self.switch
        self.missed_before = 0
        """Deadlines missed by the loops before this one."""
        self.records: Final = Rings()
        self._loop = self.make_loop(devices, tuning, rate_hz)
        self.records.add(self._loop.shared.ring)
        self._thread = threading.Thread(target=self._run, name="servo", daemon=True)

    def make_loop(self, devices: Sequence[Device], tuning: Tuning, rate_hz: float) -> Loop:
        """Return a loop for this servo: the first one, or one for `replace` with the same number of fingers."""
        values, period = flatten_tuning(tuning), compute_period_ns(rate_hz)
        begin_bodies(tuning.scene, period / NS_PER_S)
        row = np.zeros(len(devices) * RECORD_SIZE)
        max_ignored_ticks = int(IGNORED_WRENCH_MAX_S * rate_hz)
        buffers = tuple(make_device_buffers(record, max_ignored_ticks) for record in np.split(row, len(devices)))
        capacity = 1 << int(np.ceil(np.log2(max(RING_SECONDS * rate_hz, 1024))))
        ring = self.records.newest
        if ring is None or len(ring.slots) != capacity:
            ring = make_ring(capacity, len(row))
        motion = np.zeros(count_motion_values(tuning.scene))
        shared = SharedMemory(*self._words, make_slot(values), ring, self.records.wake_fd, make_slot(motion))
        arguments = (
            tuning,
            make_start_memory(tuning.scene),
            tuple(DeviceIO(*device.io()) for device in devices),
            Schedule(period, self._epoch_ns, self._ticks, int(all(device.info.own_clock for device in devices))),
            shared,
            Scratch(
                np.zeros(2, np.int64),
                values.copy(),
                row,
                buffers,
                make_ramp(tuning, round(self._ramp_s * rate_hz)),
                motion,
            ),
        )
        return Loop(tuple(devices), tuning, shared, arguments)

    def compile(self, loop: Loop | None = None) -> bool:
        """Compile all functions that the loop (by default the first) and its readers call; True if all were cached."""
        require_machine_code("the servo loop")
        _, _, shared, arguments = self._loop if loop is None else loop
        kernels: list[tuple[Any, tuple[Any, ...]]] = [
            (run_servo_loop, arguments),
            (take, (shared.ring, np.empty((1, shared.ring.slots.shape[1])))),
            (publish, (shared.tuning, shared.tuning.values)),
        ]
        for kernel, signature in kernels:
            kernel.compile(tuple(numba.typeof(argument) for argument in signature))
        return all(not kernel.stats.cache_misses for kernel, _ in kernels)

    @staticmethod
    def with_tuning(loop: Loop, tuning: Tuning) -> Loop:
        publish(loop.shared.tuning, flatten_tuning(tuning))
        return loop._replace(tuning=tuning)

    @staticmethod
    def has_compiled(tuning: Tuning) -> bool:
        """Return whether this process has compiled the loop for this structure of tuning."""
        return any(signature[0] == numba.typeof(tuning) for signature in run_servo_loop.signatures)  # type: ignore[attr-defined]

    def start(self) -> None:
        """Start the thread and return at once."""
        self._thread.start()

    def _run(self) -> None:
        undo: Callable[[], None] | None = None
        try:
            if self._prepare is not None:
                undo = self._prepare()
            self._arm()
            end = self._run_loops()
        except BaseException as error:  # in any case the device must be zeroed and join() must return the error
            end = LoopEnd(CRASHED, 0, error)
        self._ended = end
        failed = shutdown.run_all_steps(
            lambda: shutdown.stop_all(self.devices),
            lambda: shutdown.confirm_zero(self.devices),
            *([undo] if undo else []),
            first=end.error,
        )
        if failed is not end.error:
            if end.ending in (STOPPED, FINISHED):
                self._ended = LoopEnd(CRASHED, end.status, failed)
            else:  # the reason for the end is the first error
                log.error("%s", failed)
        self._finished.set()
        self.records.end()

    def _arm(self) -> None:
        if not self._stopping:
            for device in self.devices:
                device.arm()
            self.is_armed = True

    def _run_loops(self) -> LoopEnd:
        while True:
            ending, status, finger = run_servo_loop(*self._loop.arguments)
            handover = self._handover
            if handover is None or ending != STOPPED or self._stopping:
                return LoopEnd(ending, status, finger=finger)
            self._switch_loop(handover)

    def _switch_loop(self, handover: Handover) -> None:
        if not handover.keeps_devices:
            self.is_armed = False  # no tick is due until the next devices are armed
            shutdown.stop_all(self.devices)
            shutdown.confirm_zero(self.devices)
        handover.loop_ended.set()
        handover.loop_ready.wait()
        if handover.loop is None:
            raise handover.error or SafetyStop("there was no loop to continue")
        loop = handover.loop
        memory = continue_memory(loop.arguments[1], loop.tuning.guards, self._loop.arguments[5].row)
        self._loop, self._handover = loop._replace(arguments=(loop.arguments[0], memory, *loop.arguments[2:])), None
        self.records.add(self._loop.shared.ring)
        self.shared.stop[0] = 0
        if self._stopping:  # requested in the meantime
            self.shared.stop[0] = 1
        if not handover.keeps_devices:
            self._arm()
        handover.first, self.missed_before = self.ticks, self.missed
        handover.loop_started.set()

    def replace(self, make: Callable[[], Loop], keeps_devices: bool) -> int:
        """End the loop with zero force and start another one in the same thread; return the number of its first tick.

        make           returns the next loop, compiled; called in this thread once the previous loop has returned.
                       An exception ends the servo, and is also raised here
        keeps_devices  whether the devices are the same; then they remain armed. Otherwise they are stopped
                       before `make`, and the caller owns them

        Numbers of ticks, missed deadlines and times continue; contact, guard and energy restart. The time between the
        loops counts no missed deadline. Raises SafetyStop if the servo is not running. Only one thread may call this.
        """
        self.check_running()
        handover = Handover(keeps_devices)
        self._handover = handover
        self.shared.stop[0] = 1
        try:
            self._await(handover.loop_ended)
            handover.loop = make()
        except BaseException as error:
            handover.error = error
            raise
        finally:
            handover.loop_ready.set()
        self._await(handover.loop_started)
        return handover.first

    def _await(self, step: threading.Event) -> None:
        until = time.monotonic() + HANDOVER_S
        while not step.wait(HANDOVER_POLL_S):
            if self._ended is not None and self._ended.error is not None:
                raise self._ended.error
            if self._finished.is_set() or time.monotonic() > until:
                raise SafetyStop("the servo stopped, or its device does not return, before it was replaced")

    def check_running(self) -> None:
        """Raise SafetyStop unless the loop is ticking."""
        if not self.is_armed or self._ended is not None:
            raise SafetyStop("the servo is not running: nothing can be replaced")

    @property
    def devices(self) -> tuple[Device, ...]:
        """Devices of the loop that runs or ran last, one for each finger."""
        return self._loop.devices

    @property
    def width(self) -> int:
        """Numbers in a row of the ring: RECORD_SIZE for each finger."""
        return len(self.devices) * RECORD_SIZE

    @property
    def tuning(self) -> Tuning:
        """Initial tuning of the loop that runs or ran last."""
        return self._loop.tuning

    @property
    def shared(self) -> SharedMemory:
        return self._loop.shared

    @property
    def period_ns(self) -> int:
        """Length of a tick of the loop that runs or ran last."""
        return int(self._loop.arguments[3].period_ns)

    def stop(self) -> None:
        """Stop the loop after its current tick; callable from any thread and from a signal handler."""
        self._stopping = True  # first: a loop that is being replaced reads both, in this order
        self.shared.stop[0] = 1

    def join(self, timeout_s: float | None = None) -> LoopEnd | None:
        """Wait for the end and return it; None after a timeout."""
        # Not Thread.join: in Python 3.11 an interrupt inside it marks a live thread as finished.
        if not self._finished.wait(timeout_s):
            return None
        return self._ended

    @property
    def is_running(self) -> bool:
        return not self._finished.is_set()

    @property
    def is_ticking(self) -> bool:
        """True if ticks will follow. After the last tick the devices are stopped, then `is_running` becomes false."""
        return self._ended is None

    @property
    def epoch_s(self) -> float:
        """Offset of a record's timestamp from CLOCK_MONOTONIC, s."""
        return self._epoch_ns / NS_PER_S

    @property
    def ticks(self) -> int:
        return int(self.shared.progress[0])

    def last_tick_and_time(self) -> tuple[int, float]:
        """Return the last tick done, -1 before the first, and the present time (s since the epoch)."""
        while True:
            ticks, now = self.ticks, time.monotonic_ns()
            if self.ticks == ticks:
                return ticks - 1, (now + self._epoch_ns) / NS_PER_S

    @property
    def missed(self) -> int:
        return int(self.shared.progress[1])

    @property
    def woken_late(self) -> bool:
        """True if a loop that lost its time lost most of it before the thread was woken."""
        return bool(self.shared.progress[2])

    def is_compiled_for(self, tuning: Tuning) -> bool:
        return has_same_structure(tuning, self._loop.tuning)

    def tune(self, tuning: Tuning) -> None:
        """Change parameters along the ramp while running; they must have the same structure (`is_compiled_for`).

        Only one thread may call this at a time.
        """
        if not self.is_compiled_for(tuning):
            raise ValueError("the new scene has other parts than the compiled one: replace the loop")
        # The replaced scene may contain arrays, and the loop reads them until it has accepted the new one. It has done
        # so once two ticks are done since the last write: the second one started after it and read no other scene.
        if self.ticks >= self._tuned_tick + 2:
            del self._recent_tunings[:-1]
        self._recent_tunings.append(tuning)
        publish(self.shared.tuning, flatten_tuning(tuning))
        self._tuned_tick = self.ticks

    def close(self) -> None:
        """Release the eventfd of the records, after loop and reader have stopped."""
        if self._thread.ident is not None:
            self._thread.join()
        self.records.close()


def _read_epoch_offset_ns() -> int:
    return time.time_ns() - time.monotonic_ns()
