"""Rendering service: the servo with its devices, from the first tick to the last zero."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from softfinger.config import schema
from softfinger.config.errors import ConfigError, HapticError, SafetyStop
from softfinger.config.load import apply_overrides
from softfinger.config.schema.pairing import pair_devices
from softfinger.drivers.base import Device
from softfinger.drivers.simulated.hand import RequestedPose, hold, lead_hand
from softfinger.proxy.kernels.model import Pose, Vec3
from softfinger.proxy.record import AT
from softfinger.proxy.scene import describe_model_change
from softfinger.server.loop import shutdown
from softfinger.server.loop.clock import NS_PER_S
from softfinger.server.loop.force_switch import MAX_OFF_S
from softfinger.server.loop.handover import Loop
from softfinger.server.loop.servo_thread import ServoThread
from softfinger.server.loop.tick import UNMOVED
from softfinger.server.loop.tuning import make_tuning, with_armed, with_offsets, with_scene
from softfinger.server.progress import report_compilation
from softfinger.server.services.base import JOIN_S
from softfinger.server.services.finger_devices import check_replacement, inject_faults, make_tools, open_finger_devices
from softfinger.server.services.force import Force
from softfinger.server.states import NOT_ARMED_REASON, StateMachine

PAUSE_TICKS: Final = 3
"""The first tick may have started earlier and still have a force; the second is zero; the third confirms the write."""
PAUSE_SETTLE_S: Final = 0.02
"""Time for which zeros continue before the process is stopped: a thread or a transfer may delay them to the device."""
PAUSE_WAIT_S: Final = 0.5
POLL_S: Final = 0.001
CHANGE_WAIT_S: Final = 0.5
"""Time for which a change of parameters waits for another change or a replacement; both take milliseconds."""


class SceneReplacement(HapticError):
    """Change that is refused while another change is in progress."""


@contextmanager
def _acquire(lock: threading.Lock) -> Iterator[None]:
    """Acquire a lock; raise SceneReplacement after a timeout."""
    if not lock.acquire(timeout=CHANGE_WAIT_S):
        raise SceneReplacement("the rendering is being replaced or paused: nothing was changed; try again")
    try:
        yield
    finally:
        lock.release()


class Rendering:
    """Service of a servo and its devices, which are opened on construction and closed by `stop` in any case.

    All changes to the running servo are made here; this class knows the scene and whether the force is on.

    rig, scene      validated configuration
    ticks, prepare  as for `ServoThread`
    faults          faults to inject between the devices and the loop
    states          updated with the reasons that keep the force off
    switch          as for `ServoThread`

    A failure of the servo is reported by `ServoThread.join`. The constructor raises the errors of opening a device, and
    ConfigError if the rig has no device for a finger; no device remains open then.
    """

    def __init__(
        self,
        rig: schema.Rig,
        scene: schema.Scene,
        ticks: int | None,
        prepare: Callable[[], Callable[[], None]],
        faults: schema.Faults | None,
        states: StateMachine,
        switch: NDArray[np.int64],
    ) -> None:
        self.rig, self.scene = rig, scene
        self.faults: Final = faults
        self._started = self._stopped = False
        self.since = 0
        """First tick of this loop, at which scripted motions started."""
        self._pauses = 0
        """Nested pauses: a signal handler that pauses may be interrupted by another one; the force returns with the
        last."""
        self._replace_lock = threading.Lock()
        self._parameters_lock = threading.Lock()
        """Held while parameters of the scene are changed, including the time to read their files."""
        self._tuning_lock = threading.Lock()
        """Held while the tuning or the loop is changed; acquired after `_parameters_lock` if both are needed."""
        self._offset_tick = 0
        """Number of ticks started when an offset was last set."""
        devices = self._open(scene, rig)
        with shutdown.close_on_error(devices), report_compilation("kernels that call the device"):
            self._tuning = make_tuning(scene, rig.guard, [device.info for device in devices], make_tools(scene, rig))
            self.servo: Final = ServoThread(
                devices, self._tuning, rig.servo.rate_hz, ticks, prepare, rig.commands.ramp_s, switch
            )
        unarmed = rig.guard.arm != "automatic"
        self.force: Final = Force(unarmed, states, self.servo.switch, lambda: self.servo.ticks)

    def start(self) -> None:
        self._started = True  # first: an interrupted start may have started the loop, which `stop` must await
        try:
            self.servo.start()
        except RuntimeError:  # the system has no thread left
            self._started = False
            raise

    def stop(self) -> None:
        self._stopped = True
        shutdown.complete_all_steps(self.servo.stop, self._join, self._close)

    def replace(self, scene: schema.Scene | None = None, rig: schema.Rig | None = None) -> int:
        """Replace scene or rig, starting from zero force; return the number of the first tick with it.

        All steps that can be refused or take long run first, while the old loop continues; if they fail, nothing has
        changed. Then the guard brings the force to zero within MAX_OFF_S, the loop ends with zero, and the next loop
        starts with the guard's ramp. Devices with the same tables and rate remain open and armed. Other devices are
        opened after the old ones are closed, because both may be the same hardware; if that fails, the run ends with
        the error. Callable from any thread except the servo's, one call at a time.

        Raises ConfigError if scene and rig cannot replace the running ones, SafetyStop if the servo is not running, and
        the errors of opening a device.
        """
        with self._replace_lock:
            servo = self.servo
            servo.check_running()
            rig, new_scene = rig or self.rig, scene or self.scene
            self.check(new_scene, rig)
            new_pairs, old_pairs = pair_devices(new_scene, rig), pair_devices(self.scene, self.rig)
            keeps_devices = [finger.device for finger in new_pairs] == [finger.device for finger in old_pairs]
            keeps_devices = keeps_devices and rig.servo.rate_hz == self.rig.servo.rate_hz
            # Compiled with the present devices: the compiled loop does not depend on them.
            compiled, compiled_scene = self._make_loop(new_scene, rig), new_scene
            servo.compile(compiled)

            def make() -> Loop:
                if not keeps_devices:
                    return self._make_loop_for_new_devices(new_scene, rig)
                # Parameters of a scene that continues, and the offset of a device, may have changed in the meantime.
                if new_scene is not compiled_scene:
                    return self._make_loop(new_scene, rig)
                return servo.with_tuning(compiled, with_offsets(compiled.tuning, self._tuning.offsets))

            with self._parameters_lock, self._tuning_lock:
                new_scene = scene or self.scene
                if not keeps_devices and rig.guard.arm != "automatic":  # it may be another hand
                    self.force.inhibit(NOT_ARMED_REASON)
                with self.force.suspend():
                    self._await_no_force()
                    first = servo.replace(make, keeps_devices)
                self.since = first
                self.rig, self.scene, self._tuning = rig, new_scene, servo.tuning
            if self._stopped:  # `stop` did not wait for the devices to open
                shutdown.close_all(servo.devices)
            return first

    def check(self, scene: schema.Scene, rig: schema.Rig) -> None:
        """Raise ConfigError if these cannot replace the running ones, as far as this is known without compiling."""
        check_replacement(scene, rig, self.scene, self.rig)

    def set_parameters(self, changes: Mapping[str, Any], where: str) -> tuple[schema.Scene, schema.Scene, int]:
        """Change parameters of the scene, all in the same tick.

        Parameters that act on the force reach their values at the end of the ramp of the rig's [commands].

        Parameters
        ----------
        changes
            Values by dotted key, as for `load_scene`.
        where
            Origin of the changes, for messages.

        Returns
        -------
        tuple[Scene, Scene, int]
            Scene before and after, and a lower bound of the number of ticks started without the change.

        Raises
        ------
        ConfigError
            If a value is out of its range, or would need another loop.
        SceneReplacement
            If another change is in progress.
        """
        with _acquire(self._parameters_lock):
            before, after = self.scene, apply_overrides(self.scene, changes, where)
            if pair_devices(after, self.rig) != pair_devices(before, self.rig):
                raise ConfigError(f"{where}: name and device of a finger cannot be set: use set_scene")
            tuning = with_scene(self._tuning, after)
            if not self.servo.is_compiled_for(tuning):
                raise ConfigError(f"{where}: {describe_model_change(before, changes)}: use set_scene")
            with _acquire(self._tuning_lock):
                # An offset may have been set in the meantime.
                self._tuning = self._tuning._replace(scene=tuning.scene, passivity=tuning.passivity)
                self.scene = after
                return before, after, self._tune()

    @property
    def offsets(self) -> tuple[Vec3, ...]:
        """Offset added to the position from the device of each finger, m."""
        return tuple((x + 0.0, y + 0.0, z + 0.0) for x, y, z in self._tuning.offsets)

    def set_offset(self, finger: int, position: Vec3 | None, record: NDArray[np.float64]) -> int:
        """Set the offset that moves a finger's probe to `position`; None removes the offset.

        The offset remains until the run ends or the finger gets another device. The contact of the finger restarts.

        finger    index of the finger
        position  (3,) m, world, or None
        record    latest record of the finger
        returns   a lower bound of the number of ticks started without the change

        Raises SceneReplacement if another change is in progress or the force is not off.
        """
        with _acquire(self._tuning_lock):
            if not self.force.is_off:
                raise SceneReplacement("the force is being disabled: nothing was changed; try again")
            if position is not None and record[AT.tick] < self._offset_tick + 2:
                raise SceneReplacement("the position of the probe is still unknown: nothing was changed; try again")
            offsets = list(self._tuning.offsets)
            offsets[finger] = UNMOVED
            if position is not None:
                at, before = record[AT.probe_position : AT.probe_position + 3].tolist(), self.offsets[finger]
                offsets[finger] = tuple(p - (x - b) for p, x, b in zip(position, at, before, strict=True))
            self._tuning = with_offsets(self._tuning, tuple(offsets))
            self._offset_tick = self._tune()
            return self._offset_tick

    def lead_hand(self, finger: int, target: RequestedPose | None) -> None:
        """Move the computed hand of a finger to a pose and hold it there; None: resume its default motion.

        Raises NoSimulatedHand if the device computes none, ConfigError if the device cannot reach or sense the pose, or
        SceneReplacement.
        """
        with _acquire(self._tuning_lock):
            lead_hand(self.servo.devices[finger], self._tuning.tools[finger], self.offsets[finger], target)

    def hold_hand(self, finger: int) -> Pose:
        """Hold the computed hand of a finger at its present goal and return that pose; errors as for `lead_hand`."""
        with _acquire(self._tuning_lock):
            return hold(self.servo.devices[finger], self._tuning.tools[finger], self.offsets[finger])

    def disarm(self, why: str) -> None:
        """Turn the force off within MAX_OFF_S and add the reason `why`; never waits."""
        self.force.inhibit(why)
        self.force.update_state()

    def arm(self, *why: str) -> None:
        """Remove reasons of `disarm`; with the last one the force fades in along the guard's ramp."""
        self.force.allow(*why)
        self.force.update_state()

    def _tune(self) -> int:
        """Pass the tuning to the servo; return a lower bound of the number of ticks started without it."""
        ticks = self.servo.ticks
        self.servo.tune(self._tuning)
        return ticks

    def _make_loop(self, scene: schema.Scene, rig: schema.Rig, new_devices: Sequence[Device] = ()) -> Loop:
        devices = new_devices or self.servo.devices
        infos = [device.info for device in devices]
        tuning = make_tuning(scene, rig.guard, infos, make_tools(scene, rig))
        if not new_devices:  # an offset belongs to its device
            tuning = with_offsets(tuning, self._tuning.offsets)
        return self.servo.make_loop(devices, tuning, rig.servo.rate_hz)

    def _make_loop_for_new_devices(self, scene: schema.Scene, rig: schema.Rig) -> Loop:
        """Return a loop for devices that are opened in place of the present ones."""
        shutdown.close_all(self.servo.devices)
        devices = self._open(scene, rig)
        with shutdown.close_on_error(devices):
            return self._make_loop(scene, rig, devices)

    def _open(self, scene: schema.Scene, rig: schema.Rig) -> tuple[Device, ...]:
        devices = open_finger_devices(scene, rig)
        with shutdown.close_on_error(devices):
            return inject_faults(devices, scene, self.faults, rig.servo.rate_hz)

    def _await_no_force(self) -> None:
        """Wait until the loop has turned the force off; raises SafetyStop if it does not tick."""
        to_zero_s = MAX_OFF_S + PAUSE_TICKS * self.servo.period_ns / NS_PER_S
        until = time.monotonic() + 2.0 * to_zero_s + PAUSE_WAIT_S
        while self.servo.is_ticking and not self.force.is_off:
            if time.monotonic() > until:
                raise SafetyStop("nothing was replaced: the servo did not tick before the force was off")
            time.sleep(POLL_S)

    def pause(self) -> Callable[[], None]:
        """Turn the force off before the process is stopped; return a function that lets it fade in again.

        Callable from the main thread and its signal handlers. Ends the servo if it does not tick, or while a loop is
        replaced.
        """
        if not self._pauses and not self._tuning_lock.acquire(timeout=PAUSE_WAIT_S):
            self._end()
            return lambda: None
        self._pauses += 1
        self.servo.tune(with_armed(self._tuning, 0.0))
        # If no tick has run yet, the first will find the guard disarmed.
        if not self._wait_ticks(PAUSE_TICKS, PAUSE_WAIT_S) and self.servo.ticks:
            self._end()
        time.sleep(PAUSE_SETTLE_S)
        return self._resume

    def _resume(self) -> None:
        self._pauses -= 1
        if not self._pauses:
            self._tune()
            self._tuning_lock.release()

    def _end(self) -> None:
        self.servo.stop()
        shutdown.stop_all(self.servo.devices)

    def _wait_ticks(self, count: int, timeout_s: float) -> bool:
        """Wait until `count` more ticks are done or the loop has ended; return False on a timeout."""
        ticks, until = self.servo.ticks, time.monotonic() + timeout_s
        while self.servo.is_ticking and self.servo.ticks < ticks + count:
            if time.monotonic() > until:
                return False
            time.sleep(POLL_S)
        return True

    def _join(self) -> None:
        # A servo that does not end in time hangs in a device; the devices are closed anyway.
        if self._started:
            self._started = False
            self.servo.join(JOIN_S)

    def _close(self) -> None:
        # Not while another device is being opened in its place, unless that takes too long.
        acquired = self._tuning_lock.acquire(timeout=JOIN_S)
        try:
            shutdown.close_all(self.servo.devices)
        finally:
            if acquired:
                self._tuning_lock.release()
