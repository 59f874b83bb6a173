"""Computation of the `health` message from the records of each second."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from softfinger.drivers import quaternions
from softfinger.proxy.record import AT, MODE_NAMES, RECORD_SIZE
from softfinger.server.wire.protocol import SCHEMA, nest

Records = NDArray[np.float64]

HEALTH_PERIOD_S: Final = 1.0
_HEALTH_ROWS: Final = 16384  # twice the rows of a second at the highest rate
_QUANTILES: Final = {"p50": 50.0, "p99": 99.0, "p999": 99.9, "max": 100.0}


class HealthSummary:
    """Accumulator of records that summarizes each second of one finger."""

    def __init__(self) -> None:
        self._rows = np.empty((_HEALTH_ROWS, RECORD_SIZE))
        self._count = 0  # row 0 is the last one of the previous second, for the work done between the two
        self._energy_total = 0.0

    def add(self, records: Records, drops: int) -> list[dict[str, Any]]:
        """Add a batch, shape (n, RECORD_SIZE); return the maps of the seconds that it completes."""
        messages: list[dict[str, Any]] = []
        while len(records):
            if self._count == 0:
                self._rows[0] = records[0]
                self._count = 1
                records = records[1:]
                continue
            elapsed = records[:, AT.timestamp] - self._rows[0, AT.timestamp]
            # A microsecond early: the epoch time of a tick is rounded. A clock set back also ends the second.
            complete = (elapsed >= HEALTH_PERIOD_S - 1e-6) | (elapsed < 0.0)
            room = len(self._rows) - self._count
            ends = int(complete.argmax()) + 1 if complete.any() else len(records)
            count = min(ends, room)
            self._rows[self._count : self._count + count] = records[:count]
            self._count += count
            if complete[count - 1] or count == room:
                messages.append(self._make_message(drops))
                self._rows[0] = self._rows[self._count - 1]
                self._count = 1
            records = records[count:]
        return messages

    def _make_message(self, drops: int) -> dict[str, Any]:
        rows = self._rows[: self._count]
        counted, last = rows[1:], rows[-1]
        elapsed = float(last[AT.timestamp] - rows[0, AT.timestamp])
        energy = compute_work_of_hand(rows)
        self._energy_total += energy
        modes = np.bincount(counted[:, AT.contact_mode].astype(np.int64), minlength=len(MODE_NAMES)).tolist()
        flat = {
            "schema": SCHEMA,
            "timestamp": float(last[AT.timestamp]),
            "tick": int(last[AT.tick]),
            "rate": len(counted) / elapsed if elapsed > 0.0 else 0.0,
            "missed": int(last[AT.servo_missed]),
            "drops": int(drops),
            "guarded": int(np.count_nonzero(counted[:, AT.servo_guard])),
            "energy": energy,
            "energy_total": self._energy_total,
            "passivity.owed": max(0.0, -float(counted[:, AT.passivity_energy].min(initial=0.0))),
            "passivity.damped": int(np.count_nonzero(counted[:, AT.passivity_damping])),
            "limits.speed": float(counted[:, AT.limits_speed].max(initial=0.0)),
            "limits.heat": float(counted[:, AT.limits_heat].max(initial=0.0)),
            "limits.energy": float(counted[:, AT.limits_energy].max(initial=0.0)),
        }
        for name, at in (("late", AT.servo_late), ("exec", AT.servo_exec)):
            quantiles = np.percentile(counted[:, at], list(_QUANTILES.values())).tolist()
            flat |= {f"{name}.{key}": value for key, value in zip(_QUANTILES, quantiles, strict=True)}
        flat |= {f"modes.{name}": count for name, count in zip(MODE_NAMES, modes, strict=True)}
        return nest(flat)


def combine(messages: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Combine the messages of several fingers for one second: sums of ticks and work, maxima of other figures."""
    first, *remaining = messages
    for message in remaining:
        for key in ("guarded", "energy", "energy_total"):
            first[key] += message[key]
        first["passivity"]["owed"] = max(first["passivity"]["owed"], message["passivity"]["owed"])
        first["passivity"]["damped"] += message["passivity"]["damped"]
        for limit in first["limits"]:
            first["limits"][limit] = max(first["limits"][limit], message["limits"][limit])
        for mode in first["modes"]:
            first["modes"][mode] += message["modes"][mode]
    return first


def compute_work_of_hand(records: Records) -> float:
    """Return the work (J) of the hand against the commanded wrench over consecutive records, shape (n, RECORD_SIZE).

    Each wrench acts until the next tick, so it is multiplied by the motion that follows it. Negative work means that
    the rendering moved the hand. Records that are not finite contribute nothing.
    """
    force = records[:-1, AT.force : AT.force + 3]
    torque = records[:-1, AT.torque : AT.torque + 3]
    position = records[:, AT.probe_position : AT.probe_position + 3]
    quaternion = records[:, AT.probe_orientation : AT.probe_orientation + 4]
    turn = quaternions.log(quaternions.multiply(quaternion[1:], quaternions.conjugate(quaternion[:-1])))
    work = -(force * np.diff(position, axis=0)).sum(axis=1) - (torque * turn).sum(axis=1)
    return float(work[np.isfinite(work)].sum())
