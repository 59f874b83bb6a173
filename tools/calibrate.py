"""Calibration of a Falcon's motor counts per N m, with a weight of known mass.

A spring, a damper and an integral without steady-state error hold the knob. When the weight is hung on the knob, the
vertical holding force changes by the weight, expressed in the counts that were sent. With the true force m g and the
commanded force F, the true number of counts is F / (m g) times the number in use.

Friction of the legs carries a varying part of the weight: repeat the measurement and use the mean.
"""

from __future__ import annotations

import argparse
import ctypes
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

from softfinger.config.errors import ConfigError, DeviceError, DeviceLost
from softfinger.config.load import load_rig
from softfinger.config.schema.pairing import find_single_device
from softfinger.drivers.base import SAMPLE_SIZE, Device
from softfinger.drivers.falcon.device import Falcon
from softfinger.drivers.registry import open_device
from softfinger.server.offline.figures import make_figure, save
from softfinger.tools import measure
from softfinger.tools.measure import Array

GRAVITY: Final = 9.80665
"""Lighter weights are lost in friction; heavier ones exceed the force of some Falcons with an unknown gain."""
SPRING_N_PER_M: Final = 150.0
DAMPER_NS_PER_M: Final = 3.0
INTEGRAL_N_PER_MS: Final = 300.0
"""Soft enough for a gain that is five times too small or too large."""
FORCE_MAX_N: Final = 6.0
ESCAPE_M: Final = 0.03
"""A knob this far from its place runs away: the force has the wrong sign or is much too small."""
PAUSE_S: Final = 0.001
WINDOW_S: Final = 1.0
SETTLE_S: Final = 1.0
STEADY_CHANGE_N: Final = 0.05
"""Largest change of the holding force between two windows that counts as steady."""
HUNG_SHARE: Final = 0.1
"""Fraction of the weight, at the gain in use, by which the holding force changes when the weight is hung."""


class HoldController:
    """Position controller of the knob that records time (s) and vertical force (N) of every exchange."""

    def __init__(self, device: Device) -> None:
        io = device.io()
        function = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64, ctypes.c_void_p)
        self._read, self._write, self._handle = function(io.read), function(io.write), io.handle
        self._sample, self._wrench = np.zeros(SAMPLE_SIZE), np.zeros(6)
        self._integral, self._speed = np.zeros(3), np.zeros(3)
        self._exchange(self._read, self._sample, "read")
        self._place = self._last = self._sample[:3].copy()
        self._sampled_at = time.monotonic()
        self.record: list[tuple[float, float]] = []

    def tick(self) -> None:
        """Run one exchange. Raises DeviceLost, or DeviceError if the knob runs away."""
        time.sleep(PAUSE_S)
        self._exchange(self._read, self._sample, "read")
        now, place = time.monotonic(), self._sample[:3].copy()
        if not np.isfinite(place).all():
            place = self._last
        dt = now - self._sampled_at
        self._speed += 0.3 * ((place - self._last) / dt - self._speed)  # encoder counts give a noisy slope
        deviation = self._place - place
        if np.linalg.norm(deviation) > ESCAPE_M:
            raise DeviceError(
                f"the knob has moved by {100 * np.linalg.norm(deviation):.1f} cm: if it moved by itself, change "
                "motors_reversed in the rig; if the weight pulled it down, use a lighter one"
            )
        self._integral = np.clip(self._integral + INTEGRAL_N_PER_MS * deviation * dt, -FORCE_MAX_N, FORCE_MAX_N)
        force = SPRING_N_PER_M * deviation - DAMPER_NS_PER_M * self._speed + self._integral
        self._wrench[:3] = force * min(1.0, FORCE_MAX_N / max(float(np.linalg.norm(force)), 1e-9))
        self._exchange(self._write, self._wrench, "write")
        self._sampled_at, self._last = now, place
        self.record.append((now, float(self._wrench[2])))

    def run(self, seconds: float) -> None:
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            self.tick()

    def window(self, back: int = 0) -> float:
        """Return the mean force (N) of the last window, or of an earlier one that is `back` windows before it."""
        end = self.record[-1][0] - back * WINDOW_S
        return float(np.mean([force for at, force in self.record if end - WINDOW_S < at <= end]))

    def rest(self, seconds: float, far: Callable[[float], bool]) -> float | None:
        """Wait until the holding force is steady and satisfies `far`; returns the force, or None after `seconds`."""
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            self.run(WINDOW_S / 4)
            if self.record[-1][0] - self.record[0][0] > 2 * WINDOW_S:
                force = self.window()
                if abs(force - self.window(1)) < STEADY_CHANGE_N and far(force):
                    return force
        return None

    def _exchange(self, function: Any, values: Array, operation: str) -> None:
        status = function(self._handle, values.ctypes.data)
        if status < 0:
            raise DeviceLost(f"the Falcon was lost during calibration (status {status} on {operation}): start again")


def run(args: argparse.Namespace) -> int:
    rig = load_rig(args.rig)
    config = find_single_device(rig)
    with open_device(config, rig.servo.rate_hz) as device:
        if not isinstance(device, Falcon):
            raise ConfigError(f"--rig {args.rig}: its driver is '{config.driver}': name a rig with driver 'falcon'")
        device.arm()
        hold = HoldController(device)
        print("hold the knob still, then release it: it stays in place", file=sys.stderr)
        hold.run(SETTLE_S)
        bare = hold.rest(args.hang, lambda _: True)
        if bare is None:
            raise DeviceError(f"the knob does not stop within {args.hang:g} s: let it hang freely")
        print(f"hang {args.mass:g} kg on the knob, within {args.hang:g} s", file=sys.stderr)
        weight = args.mass * GRAVITY
        loaded = hold.rest(args.hang, lambda force: abs(force - bare) > HUNG_SHARE * weight)
        if loaded is None:
            raise DeviceError(f"no weight was detected in {args.hang:g} s: attach it when prompted")
        counts_in_use = device.counts_per_nm
    if loaded < bare:
        raise DeviceError("the weight reduced the force: the knob was touched: start again")
    result = {
        "mass_kg": args.mass, "force_bare_n": bare, "force_loaded_n": loaded, "counts_per_nm_used": counts_in_use,
        "counts_per_nm": counts_in_use * (loaded - bare) / weight,
    }  # fmt: skip
    lines = [
        f"holding took {bare:.3f} N, with the weight {loaded:.3f} N, at {counts_in_use:g} counts per N m",
        f"add to the rig's [device] table: counts_per_nm = {result['counts_per_nm']:.0f}",
        "repeat and average: friction of the legs bears part of the weight",
    ]
    return measure.show_and_draw(args, result, lines, lambda path: _draw(path, np.array(hold.record), result))


def _draw(path: Path, record: Array, result: dict[str, float]) -> None:
    drawing = make_figure()
    axes = drawing.subplots()
    axes.plot(record[:, 0] - record[0, 0], record[:, 1], linewidth=0.8)
    for name in ("force_bare_n", "force_loaded_n"):
        axes.axhline(result[name], linestyle="--", linewidth=0.8, color="black")
    axes.set(
        xlabel="time (s)", ylabel="vertical force meant (N)", title=f"{result['counts_per_nm']:.0f} counts per N m"
    )
    save(drawing, path)
