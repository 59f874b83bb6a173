"""Hands that a program can lead: to the start of a touch, and along the paths of [motion] and [turn]."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from softfinger.config.errors import CommandRefused, ConfigError
from softfinger.drivers import quaternions
from softfinger.server.experiment.schema import SINGLE_FINGER, ExperimentFile
from softfinger.server.remote import Client

Point = tuple[float, float, float]
Quaternion = Sequence[float]


class Hands:
    def __init__(self, client: Client, experiment: ExperimentFile) -> None:
        self._client, self._experiment = client, experiment
        self._is_led: Final = dict[str, bool]()
        self.update()
        self._check_paths()

    def update(self) -> None:
        """Ask the daemon which hands can be led, after a change of the scene."""
        self._is_led.clear()
        self._is_led.update({finger["name"]: finger["led"] for finger in self._client.describe()["fingers"]})

    def _check_paths(self) -> None:
        """Set all goals, the first of a path last. Raises ConfigError if a device cannot reach or sense one."""
        motion, start = self._experiment.motion, self._experiment.trial.start_m
        for name in (name for name, is_led in self._is_led.items() if is_led):
            finger = name or SINGLE_FINGER
            key = f"motion.{finger}" if motion.get(finger) else "trial.start_m"
            for elapsed_s, x, y, z in reversed(motion.get(finger) or ([(0.0, *start)] if start else [])):
                try:
                    self._lead(name, (x, y, z), elapsed_s)
                except CommandRefused as error:
                    raise ConfigError(f"{key}: {error}") from error

    def lead_to_start(self) -> dict[str, tuple[Point, Quaternion | None]]:
        """Lead hands to the start of their path, or of the trial; return these positions, m, and orientations."""
        starts = dict[str, tuple[Point, Quaternion | None]]()
        for name, is_led in self._is_led.items():
            path = self._experiment.motion.get(name or SINGLE_FINGER)
            start = path[0][1:] if path else self._experiment.trial.start_m
            if is_led and start is not None:
                starts[name] = start, self._lead(name, start, 0.0)
        return starts

    def lead(self, elapsed_s: float) -> None:
        """Move each hand that has a path to its point at `elapsed_s`, s since the start of the touch."""
        for name, is_led in self._is_led.items():
            if is_led and (path := self._experiment.motion.get(name or SINGLE_FINGER)):
                self._lead(name, interpolate_path(path, elapsed_s), elapsed_s)

    def _lead(self, name: str, position: Point, elapsed_s: float) -> Quaternion | None:
        """Set the goal of a hand; return its orientation, None without [turn]."""
        rotations = self._experiment.turn.get(name or SINGLE_FINGER)
        orientation = quaternions.exp(interpolate_path(rotations, elapsed_s)).tolist() if rotations else None
        self._client.hand(position, orientation, finger=name or None)
        return orientation


def interpolate_path(path: tuple[tuple[float, float, float, float], ...], t: float) -> Point:
    """Return the point x, y, z at time t, s, on a path of waypoints t, x, y, z; it rests before and after them."""
    times = [point[0] for point in path]
    x, y, z = (float(np.interp(t, times, [point[axis] for point in path])) for axis in (1, 2, 3))
    return x, y, z


def compute_angle(a: Quaternion, b: Quaternion) -> float:
    """Return the angle between two orientations (unit quaternions), rad."""
    return 2.0 * math.acos(min(1.0, abs(float(np.dot(a, b)))))
