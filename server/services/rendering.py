"""Rendering as a service: the servo with its devices, from the first tick to the last zero."""

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
from softfinger.config.load import overridden
from softfinger.config.schema.pairing import pair
from softfinger.drivers.base import Device
from softfinger.drivers.simulated.lead import Wanted, hold, lead
from softfinger.proxy.kernels.model import Pose, Vec3
from softfinger.proxy.record import AT
from softfinger.proxy.scene import other_model
from softfinger.server.loop import shutdown
from softfinger.server.loop.clock import NS_PER_S
from softfinger.server.loop.force_switch import OFF_S
from softfinger.server.loop.handover import Loop
from softfinger.server.loop.servo_thread import Servo
from softfinger.server.loop.tick import UNMOVED
from softfinger.server.loop.tuning import make_tuning, with_armed, with_offsets, with_scene
from softfinger.server.progress import making
from softfinger.server.services.base import JOIN_S
from softfinger.server.services.devices import check_replacement, injected, open_devices, tools
from softfinger.server.services.force import Force
from softfinger.server.states import UNARMED, States

PAUSE_TICKS: Final = 3
"""The first begun before may still carry a force, the second is zero, and the third says that it was written."""
PAUSE_SETTLE_S: Final = 0.02
"""Zeros go on for so long before the process stops: a thread or a transfer between us and the device hands them on."""
PAUSE_WAIT_S: Final = 0.5
POLL_S: Final = 0.001
CHANGE_WAIT_S: Final = 0.5
"""A change of parameters waits for another one, or for a replacement, so long: both take milliseconds."""


class Replacing(HapticError):
    """What cannot be changed at the moment, since another change is on its way."""


@contextmanager
def _held(lock: threading.Lock) -> Iterator[None]:
    """Hold a lock; raises Replacing if another holds it for long."""
    if not lock.acquire(timeout=CHANGE_WAIT_S):
        raise Replacing("the rendering is being replaced or paused: nothing was changed; try again")
    try:
        yield
    finally:
        lock.release()


class Rendering:
    """A servo and its devices, opened when made: stopped, the servo has ended, and the devices are closed regardless.

    All that changes what the servo renders while it runs is here: it knows the scene and whether there is force.

    rig, scene      validated configuration
    ticks, prepare  as of `Servo`, and so is `switch`
    faults          to be injected between the devices and the loop
    states          go by what keeps the force off

    Its failures are how the servo ends: `Servo.join` has them. Raises what opening a device raises, and ConfigError for
    a rig that has no device for a finger; nothing stays open then.
    """

    def __init__(
        self,
        rig: schema.Rig,
        scene: schema.Scene,
        ticks: int | None,
        prepare: Callable[[], Callable[[], None]],
        faults: schema.Faults | None = None,
        states: States | None = None,
        switch: NDArray[np.int64] | None = None,
    ) -> None:
        self._rig, self._scene = rig, scene
        self.faults: Final = faults
        self._started = self._stopped = False
        self._since = 0
        self._pauses = 0
        """A handler that pauses may be interrupted by another; with the last of them force comes back."""
        self._replacing = threading.Lock()
        self._changing = threading.Lock()
        """Held while parameters of the scene are changed, which takes as long as their files take to read."""
        self._handing_over = threading.Lock()
        """Held by whoever changes the tuning of the loop, or the loop; within `_changing` if both are."""
        self._moved = 0
        """How many ticks had begun when an offset was set last."""
        devices = self._open(scene, rig)
        try:
            self._tuning = make_tuning(scene, rig.guard, [device.info for device in devices], tools(scene, rig))
            with making("kernels that call the device"):
                self.servo: Final = Servo(
                    devices, self._tuning, rig.servo.rate_hz, ticks, prepare, rig.commands.ramp_s, switch
                )
        except BaseException as error:
            shutdown.every(lambda: shutdown.close_all(devices), first=error)
            raise
        unarmed = rig.guard.arm != "automatic"
        self.force: Final = Force(unarmed, states or States(), self.servo.switch, lambda: self.servo.ticks)

    def start(self) -> None:
        self._started = True
        self.servo.start()

    def stop(self) -> None:
        self._stopped = True
        failed = shutdown.every(self.servo.stop, self._join, self._close)
        if failed is not None:
            raise failed

    def replace(self, scene: schema.Scene | None = None, rig: schema.Rig | None = None) -> int:
        """Go on with another scene or rig, from zero force; returns the number of the first tick with it.

        All that can be refused or takes long comes first, while the old one runs on: where it fails, nothing has
        changed. Then the guard takes the force off within OFF_S, the loop ends with zero, and the next begins
        with the guard's ramp. Devices whose tables and rate are the same stay open and armed. Others are opened once
        those of before are closed, since both may be one piece of hardware: where that fails, the run ends with the
        error. From any thread but the servo's; one at a time.

        Raises ConfigError, SafetyStop where nothing runs, or what opening a device raises.
        """
        with self._replacing:
            servo = self.servo
            servo.check_running()
            rig, asked = rig or self._rig, scene or self._scene
            self.check(asked, rig)
            moved, before = pair(asked, rig), pair(self._scene, self._rig)
            keeps = [each.device for each in moved] == [each.device for each in before]
            keeps = keeps and rig.servo.rate_hz == self._rig.servo.rate_hz
            # With the devices of now: what is compiled does not depend on which they are.
            compiled = self._loop(asked, rig)
            servo.compile(compiled)

            def make() -> Loop:
                if not keeps:
                    return self._opened(asked, rig)
                # Parameters of the scene that runs on may have changed meanwhile, and the offset of a device.
                return self._loop(asked, rig) if scene is None else self._with_offsets(compiled)

            with self._changing, self._handing_over:
                asked = scene or self._scene
                if not keeps and rig.guard.arm != "automatic":  # it may be another hand
                    self.force.keep_off(UNARMED)
                with self.force.suspended():
                    self._await_no_force()
                    first = servo.replace(make, keeps)
                self._since = first
                self._rig, self._scene, self._tuning = rig, asked, servo.tuning
            if self._stopped:  # and did not wait until the devices were open
                shutdown.close_all(servo.devices)
            return first

    def check(self, scene: schema.Scene, rig: schema.Rig) -> None:
        """Raise ConfigError where these cannot take the place of what runs, as far as it shows before a compile."""
        check_replacement(scene, rig, self._scene, self._rig)

    @property
    def scene(self) -> schema.Scene:
        """What is rendered."""
        return self._scene

    @property
    def since(self) -> int:
        """The first tick of this loop, at which what moves by itself began."""
        return self._since

    @property
    def rig(self) -> schema.Rig:
        """What it is rendered with."""
        return self._rig

    def set_parameters(self, changes: Mapping[str, Any], where: str) -> tuple[schema.Scene, schema.Scene, int]:
        """Put values in place of the scene's, keys as of `load_scene`: from one tick on all of them, or none. What acts
        on the force is there once the ramp of the rig's [commands] is over.

        Returns the scene before and after, and how many ticks had begun without them at the least. `where` is named
        in messages. Raises ConfigError where a value is out of its range, or would need another loop; Replacing.
        """
        with _held(self._changing):
            before, after = self._scene, overridden(self._scene, changes, where)
            if pair(after, self._rig) != pair(before, self._rig):
                raise ConfigError(f"{where}: a finger's name and device are no parameters: set the whole scene")
            tuning = with_scene(self._tuning, after)
            if not self.servo.fits(tuning):
                raise ConfigError(f"{where}: {other_model(before, changes)}: set the whole scene")
            with _held(self._handing_over):
                # An offset may have been set meanwhile.
                self._tuning = self._tuning._replace(scene=tuning.scene, passivity=tuning.passivity)
                self._scene = after
                return before, after, self._tune()

    @property
    def offsets(self) -> tuple[Vec3, ...]:
        """What is added to the position that the device of each finger says, m."""
        return tuple((x + 0.0, y + 0.0, z + 0.0) for x, y, z in self._tuning.offsets)

    def move(self, finger: int, position: Vec3 | None, seen: NDArray[np.float64]) -> int:
        """Have a finger's probe be at `position` (m, world) where its newest record, `seen`, has it; None: where its
        device says. Until the run ends, or its device is another one. Its contact begins anew.

        Returns how many ticks had begun without it at the least. Raises Replacing, also where there is force.
        """
        with _held(self._handing_over):
            if not self.force.is_off:
                raise Replacing("the force is on its way off: nothing was changed; try again")
            if position is not None and seen[AT.tick] < self._moved + 2:
                raise Replacing("where the probe is now is not known yet: nothing was changed; try again")
            offsets = list(self._tuning.offsets)
            offsets[finger] = UNMOVED
            if position is not None:
                at, before = seen[AT.probe_position : AT.probe_position + 3].tolist(), self.offsets[finger]
                offsets[finger] = tuple(p - (x - b) for p, x, b in zip(position, at, before, strict=True))
            self._tuning = with_offsets(self._tuning, tuple(offsets))
            self._moved = self._tune()
            return self._moved

    def lead(self, finger: int, wanted: Wanted | None) -> None:
        """Have a finger's hand, which is computed, want to be there, and stay; None: do what it does by itself.

        Raises NoHand where none is computed, ConfigError for what its device does not reach or sense, Replacing.
        """
        with _held(self._handing_over):
            lead(self.servo.devices[finger], self._tuning.tools[finger], self.offsets[finger], wanted)

    def hold(self, finger: int) -> Pose:
        """Have a finger's hand, which is computed, stay where it wants to be, and say where; raises as `lead`."""
        with _held(self._handing_over):
            return hold(self.servo.devices[finger], self._tuning.tools[finger], self.offsets[finger])

    def disarm(self, why: str) -> None:
        """Take the force off within OFF_S, and keep it off; never waits."""
        self.force.keep_off(why)
        self.force.tell()

    def arm(self, *why: str) -> None:
        """Take back reasons of `disarm`: with the last of them the force fades in, along the guard's ramp."""
        self.force.allow(*why)
        self.force.tell()

    def _tune(self) -> int:
        """Hand the tuning over as it is to be now; returns how many ticks had begun without it at the least."""
        ticks = self.servo.ticks
        self.servo.tune(self._tuning)
        return ticks

    def _loop(self, scene: schema.Scene, rig: schema.Rig, given: Sequence[Device] = ()) -> Loop:
        """A loop on the devices given, or on the present ones."""
        devices = given or self.servo.devices
        infos = [device.info for device in devices]
        tuning = make_tuning(scene, rig.guard, infos, tools(scene, rig))
        if not given:  # an offset is of a device, and stays with it
            tuning = with_offsets(tuning, self._tuning.offsets)
        return self.servo.loop(devices, tuning, rig.servo.rate_hz)

    def _with_offsets(self, loop: Loop) -> Loop:
        """The loop with the offsets of now."""
        return self.servo.retuned(loop, with_offsets(loop.tuning, self._tuning.offsets))

    def _opened(self, scene: schema.Scene, rig: schema.Rig) -> Loop:
        """A loop on devices that are opened in place of the present ones."""
        shutdown.close_all(self.servo.devices)
        devices = self._open(scene, rig)
        try:
            return self._loop(scene, rig, devices)
        except BaseException as error:
            shutdown.every(lambda: shutdown.close_all(devices), first=error)
            raise

    def _open(self, scene: schema.Scene, rig: schema.Rig) -> tuple[Device, ...]:
        devices = open_devices(scene, rig)
        try:
            return injected(devices, scene, self.faults, rig.servo.rate_hz)
        except BaseException as error:
            shutdown.every(lambda: shutdown.close_all(devices), first=error)
            raise

    def _await_no_force(self) -> None:
        """Wait until the loop has taken the force off. Raises SafetyStop if it does not tick."""
        to_zero_s = OFF_S + PAUSE_TICKS * self.servo.period_ns / NS_PER_S
        until = time.monotonic() + 2.0 * to_zero_s + PAUSE_WAIT_S
        while self.servo.looping and not self.force.is_off:
            if time.monotonic() > until:
                raise SafetyStop("nothing was replaced: the servo did not tick until the force was off")
            time.sleep(POLL_S)

    def pause(self) -> Callable[[], None]:
        """Take the force off, before the process is stopped; call the result to have it fade in anew.

        From the main thread or its signal handlers. Without ticks to take it off in, or while a loop is replaced, the
        servo is asked to end.
        """
        if not self._pauses and not self._handing_over.acquire(timeout=PAUSE_WAIT_S):
            self._end()
            return lambda: None
        self._pauses += 1
        self.servo.tune(with_armed(self._tuning, 0.0))
        # Where no tick has come yet, the first will find the guard without force.
        if not self._ticked(PAUSE_TICKS, PAUSE_WAIT_S) and self.servo.ticks:
            self._end()
        time.sleep(PAUSE_SETTLE_S)
        return self._go_on

    def _go_on(self) -> None:
        self._pauses -= 1
        if not self._pauses:
            self._tune()
            self._handing_over.release()

    def _end(self) -> None:
        self.servo.stop()
        shutdown.stop_all(self.servo.devices)

    def _ticked(self, count: int, timeout_s: float) -> bool:
        """Wait for so many more ticks; False where they do not come in time. With the loop's end there is no force."""
        ticks, until = self.servo.ticks, time.monotonic() + timeout_s
        while self.servo.looping and self.servo.ticks < ticks + count:
            if time.monotonic() > until:
                return False
            time.sleep(POLL_S)
        return True

    def _join(self) -> None:
        # A servo that does not answer within this is stuck in a device; the devices are closed regardless.
        if self._started:
            self._started = False
            self.servo.join(JOIN_S)

    def _close(self) -> None:
        # Not while another device is being opened in its place, unless that takes too long.
        changed = self._handing_over.acquire(timeout=JOIN_S)
        try:
            shutdown.close_all(self.servo.devices)
        finally:
            if changed:
                self._handing_over.release()
