"""Derivation of events from consecutive records: contact transitions, guard interventions, missed deadlines."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.record import AT, CAUSE_NAMES, FREE, ROLLING, SLIDING
from softfinger.server.wire.protocol import SCHEMA, replace_undecoded

Map = dict[str, Any]

_START_S: Final = time.time() - time.monotonic()

MIN_INTERVAL_S: Final = 0.1
"""Shortest time between two guard events of one name, or two missed-deadline events.

A force close to its limit makes the guard intervene every few ticks; delayed interventions are counted in the next
event.
"""

REMEDIES: Final = {
    "not_finite": "the scene gave no finite force: softfinger check reports inconsistent values",
    "pose_refused": "the device sent no usable pose: check its sensors and its cable",
    "pose_jumped": "the pose jumped farther than a hand can move: check sensors and cable; if a hand moved it, raise "
    "guard.speed_max_m_per_s",
    "pose_frozen": "the pose repeats bit for bit under a force: move the handle; if it rests, disarm",
    "too_fast": "the handle was faster than guard.handle_speed_max_m_per_s: hold it, and arm if the rig requires it; "
    "if no hand moved it so fast, use a softer scene, or check the sign of the force",
    "motor_hot": "the force is reduced until the motors have cooled: release the handle for a while, or use a softer "
    "scene",
    "energy_spent": "the hand received more energy than guard.energy_max_j, so the force is reduced: use a softer "
    "scene or [passivity]; for an object that is meant to push, raise that limit",
    "workspace_edge": "the handle is at the edge of guard.workspace: move it back",
}
"""Remedy by name of a guard's event; other events need none."""

# Event name and previous mode, by cause; a release can follow rolling or sliding.
_TRANSITIONS: Final[dict[str, tuple[str, int | None]]] = {
    "touch": ("touch", FREE),
    "drag": ("slip", ROLLING),
    "theta_max": ("slip", ROLLING),
    "stop": ("stick", SLIDING),
    "reverse": ("stick", SLIDING),
    "release": ("release", None),
}

NONLINEAR: Final = "the deformation exceeds the range of the linear elastic model: press less, or raise youngs_pa"
"""Remedy of the event `nonlinear`."""

_WATCHED: Final = [AT.contact_mode, AT.contact_cause, AT.servo_guard, AT.servo_missed, AT.contact_nonlinear]


class RecordEvents:
    """Converter from records to event maps; pass it every record, in order.

    guard_names  names of the bits of `servo.guard`, bit 0 first
    finger       finger of the records, if there are several
    of_servo     whether to report missed deadlines, which are equal in the records of all fingers
    """

    def __init__(self, guard_names: Sequence[str] = (), finger: str = "", of_servo: bool = True) -> None:
        self._guard_names = tuple(guard_names)
        self._finger, self._of_servo = finger, of_servo
        self._watched: list[float] | None = None
        self._object = -1
        self._nonlinear = 0
        """Limits of linear elasticity that were reported: each is reported once."""
        self._delayed: dict[tuple[str, str], int] = {}
        self._sent_s: dict[tuple[str, str], float] = {}

    def observe(self, records: NDArray[np.float64]) -> list[Map]:
        """Return the events of a batch of records, shape (n, RECORD_SIZE), in tick order."""
        events: list[Map] = []
        for index, watched in enumerate(records[:, _WATCHED].tolist()):
            cause = watched[1]
            if watched == self._watched and not cause and not self._delayed:
                continue  # nearly every tick ends here
            self._append_changes(records[index], watched, events)
        if len(records):
            # The object of a release is the one touched before; touch events update it in between.
            touched = int(records[-1, AT.contact_object])
            self._object = touched if touched >= 0 else self._object
        return events

    def _append_changes(self, record: NDArray[np.float64], watched: list[float], events: list[Map]) -> None:
        mode, cause, guard, missed, nonlinear = (int(value) for value in watched)
        before = [int(value) for value in self._watched] if self._watched else [mode, 0, 0, missed, 0]
        self._watched = watched
        if cause:
            events.append(self._make_contact_event(record, CAUSE_NAMES[cause], before[0], mode))
        rising = guard & ~before[2]
        for bit in range(rising.bit_length()):
            if rising >> bit & 1:
                self._delay("guard", self._guard_names[bit] if bit < len(self._guard_names) else f"bit {bit}", 1)
        if nonlinear & ~self._nonlinear:
            self._nonlinear |= nonlinear
            events.append(
                {
                    **_make_head(record, "elastic", "nonlinear"),
                    "nonlinear": nonlinear,
                    "displacement": _to_list(record, AT.contact_displacement),
                    "finger": self._finger,
                    "message": NONLINEAR,
                }
            )
        # The counter restarts with the servo.
        if self._of_servo:
            self._delay("servo", "missed", missed - before[3] if missed >= before[3] else missed)
        events.extend(self._pop_due(record, missed))

    def _make_contact_event(self, record: NDArray[np.float64], cause: str, mode_before: int, mode: int) -> Map:
        name, usual = _TRANSITIONS[cause]
        touched = int(record[AT.contact_object])
        if touched >= 0:
            self._object = touched
        return {
            **_make_head(record, "contact", name),
            "cause": cause,
            # From the cause if possible: the previous record may have been dropped.
            "from": mode_before if usual is None else usual,
            "to": mode,
            "object": self._object,
            "force": _to_list(record, AT.force),
            "normal_force": float(record[AT.contact_normal_force]),
            "tangential_force": float(record[AT.contact_tangential_force]),
            "point": _to_list(record, AT.contact_point),
            "finger": self._finger,
        }

    def _delay(self, kind: str, name: str, count: int) -> None:
        if count > 0:
            self._delayed[kind, name] = self._delayed.get((kind, name), 0) + count

    def _pop_due(self, record: NDArray[np.float64], missed: int) -> list[Map]:
        """Return delayed events for which the interval has passed."""
        events: list[Map] = []
        now = float(record[AT.timestamp])
        for key in list(self._delayed):
            # abs: the epoch clock may be set back. A microsecond: the resolution of the timestamp this far from the
            # epoch.
            if abs(now - self._sent_s.get(key, -np.inf)) < MIN_INTERVAL_S - 1e-6:
                continue
            event = {**_make_head(record, *key), "count": self._delayed.pop(key)}
            if key[0] == "servo":
                event["total"] = missed
            else:
                event |= {"finger": self._finger, "message": REMEDIES.get(key[1], "")}
            self._sent_s[key] = now
            events.append(event)
        return events


def read_clock_s() -> float:
    """Return the time for messages, events and recordings: the time of day at the start, plus CLOCK_MONOTONIC since.

    Ticks use the same clock, so a clock that is set while the daemon runs changes no order. Suspensions of the machine
    are not included.
    """
    return _START_S + time.monotonic()


def make_event(moment: tuple[int, float], kind: str, name: str, fields: Mapping[str, Any]) -> Map:
    """Return the map of an event at a moment, (last tick done, s since the epoch), with further keys."""
    tick, timestamp = moment
    return {
        **replace_undecoded(dict(fields)),
        "schema": SCHEMA,
        "timestamp": timestamp,
        "tick": tick,
        "kind": kind,
        "name": name,
    }


def _make_head(record: NDArray[np.float64], kind: str, name: str) -> Map:
    return make_event((int(record[AT.tick]), float(record[AT.timestamp])), kind, name, {})


def _to_list(record: NDArray[np.float64], at: int) -> list[float]:
    values: list[float] = record[at : at + 3].tolist()
    return values
