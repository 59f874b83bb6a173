"""Parts of a device report in sequence, with the requests to the user in each."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np

from softfinger.drivers.base import DeviceInfo
from softfinger.drivers.kinematics.subspace import MotionSubspace
from softfinger.tools.doctor import motions
from softfinger.tools.exchange import FORCE_CYCLES, NO_PUSH, ROW_SIZE, Exchange, Push
from softfinger.tools.exchange_figures import summarize_burst, summarize_part
from softfinger.tools.measure import Array

REST_S: Final = 1.0
"""Long enough for noise of the mains, short enough for a hand to remain still."""
FORCE_MIN_S: Final = 1.0
"""Shortest part with a push; a handle cannot follow three cycles in less time."""


MIN_PART: Final = 0.5
"""Smallest part of a motion or push along an axis that the handle must support for the motion to be requested."""


class RequestedMotion(NamedTuple):
    """Motion requested from the user, and its expected axis."""

    words: str
    kind: str
    expected: str


TRANSLATIONS: Final = (
    RequestedMotion("move the handle to the right", "translation", "+x"),
    RequestedMotion("move the handle away from you", "translation", "+y"),
    RequestedMotion("move the handle up", "translation", "+z"),
)
TURN: Final = RequestedMotion("turn the handle counter-clockwise as seen from above", "rotation", "+z")


class DeviceSession:
    """Recording of the parts. Results are stored in `report` after each part, so that an aborted report has them.

    exchange  runs
    seconds   length of each part but the first
    guided    whether a user at a terminal is to move the handle
    freedom   of a device that moves on an arc or in a plane; motions that it does not support are not requested
    """

    def __init__(
        self,
        exchange: Exchange,
        info: DeviceInfo,
        report: dict[str, Any],
        seconds: float,
        guided: bool,
        freedom: MotionSubspace | None,
    ) -> None:
        self._exchange, self._info, self._report = exchange, info, report
        self._seconds, self._guided, self._freedom = seconds, guided, freedom
        self._drift_m = np.zeros(3)
        self._rows: list[Array] = []
        self.timing = np.zeros((0, ROW_SIZE))
        """Rows of the part that times the exchange."""

    def run(self, force_n: float | None) -> None:
        """Run all parts; `force_n` is the amplitude of the pushes, N, None for no push.

        If the device fails or a recording ends, the later parts are empty; `failure` of the exchange returns the
        reason.
        """
        self._print_freedom()
        self._record_rest()
        self._record_timing()
        if self._guided:
            self._record_moves()
        if force_n is not None:
            warning = (
                f"hold the handle lightly: it pushes back and forth with up to {force_n:g} N along each axis in turn"
            )
            for _, result in self._push_each(warning, force_n, FORCE_CYCLES / self._seconds, self._seconds):
                self._report["pushes"].append(result)

    def _record_rest(self) -> None:
        self._ask("release the handle, or hold it still")
        rows = self._record("the handle at rest", REST_S)
        self._measure_rest(rows)

    def _measure_rest(self, rows: Array) -> None:
        self._report["rest"] = motions.measure_rest(rows, self._info.sensed_dof > 3)
        self._drift_m = motions.measure_drift(rows)

    def _record_timing(self) -> None:
        self.timing = self._record("the exchange", self._seconds)
        if len(self.timing):
            self._report["exchange"] = summarize_part(self.timing, self._exchange.rate_hz)
        burst = self._exchange.burst()
        if len(burst):
            self._report["without_pauses"] = summarize_burst(burst)

    def _record_moves(self) -> None:
        moves = [*self._measure_translations(), *([TURN] if self._info.sensed_dof > 3 else [])]
        for motion in moves:
            self._ask(f"{motion.words}, within {self._seconds:g} s, and keep it there")
            rows = self._record(motion.words, self._seconds)
            result = motions.measure_motion(motion.words, motion.kind, motion.expected, rows)
            if result is not None:
                self._report["moves"].append(result)
                print(f"  seen: {result['seen']}", file=sys.stderr)
        self._ask(f"press each button in turn, within {self._seconds:g} s")
        self._report["buttons"] = {"masks": motions.list_masks(self._record("the buttons", self._seconds))}

    def _push_each(
        self, warning: str, force_n: float, frequency_hz: float, seconds: float
    ) -> Iterator[tuple[int, dict[str, Any]]]:
        """Push along each axis after a warning; yield the axis and the result of each push with a pose and a force."""
        if not self._guided:
            print(warning, file=sys.stderr, flush=True)
        self._ask(warning)
        for axis in range(3):
            if float(np.linalg.norm(self._project_part(axis))) > MIN_PART:
                x, y, z = (force_n if k == axis else 0.0 for k in range(3))
                push = Push((x, y, z), frequency_hz, seconds)
                rows = self._record(f"a push along {motions.AXES[axis]}", seconds, push)
                result = motions.measure_response(axis, frequency_hz, self._exchange.rate_hz, rows, self._drift_m)
                if result is not None:
                    yield axis, result

    def _print_freedom(self) -> None:
        if self._freedom is not None:
            print(
                f"the device moves {self._freedom.describe()}. Right, away and up are the world's, into which "
                "[device.mounting] turns it",
                file=sys.stderr,
            )

    def _project_part(self, axis: int) -> Array:
        """Return the component (3,) of a motion or force that the handle supports along an axis."""
        whole = np.eye(3)[axis]
        return whole if self._freedom is None else self._freedom.project_force(self._freedom.centre, whole)

    def _measure_translations(self) -> list[RequestedMotion]:
        axes = [motions.name_axis(self._project_part(k), MIN_PART) for k in range(len(TRANSLATIONS))]
        return [motion for axis, motion in zip(axes, TRANSLATIONS, strict=True) if axis == motion.expected]

    def _record(self, operation: str, seconds: float, push: Push | None = None) -> Array:
        rows = self._exchange.record(seconds, push or NO_PUSH, operation)
        self._rows.append(rows)
        self._report["range"] = motions.measure_range(np.concatenate(self._rows))
        return rows

    def _ask(self, words: str) -> None:
        """Wait for Enter. The exchange with the device continues."""
        if not self._guided or self._exchange.ended is not None:
            return
        print(f"{words}; Enter to begin", file=sys.stderr, flush=True)
        if not sys.stdin.readline():  # the terminal was closed
            raise KeyboardInterrupt
