"""A device's closed loop through the whole daemon: every tick off the wire, beside the engine on the same poses.

python closed_loop.py RIG SCENE TICKS FILE.npy      what a test beside an emulated bus runs as a program of its own
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.config.load import load_rig, load_scene
from softfinger.config.schema import Rig, Scene
from softfinger.drivers.base import HELD, WITHHELD
from softfinger.proxy.engine import Engine
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.server.app import Daemon
from softfinger.server.wire.client import Subscription, record_of, subscribe

Array = NDArray[np.float64]
COMPILE_S = 300.0
"""Longest silence: a cold start compiles before the first tick."""


def records_of_daemon(rig: Rig, scene: Scene, ticks: int) -> Array:
    """Records (ticks, RECORD_SIZE) that a subscriber got of a daemon that ran to its last tick; none may be missing."""
    with Daemon(rig, scene, ticks) as daemon:
        endpoint = daemon.publisher.endpoint
        with subscribe(endpoint, ("contact", "event"), timeout_s=COMPILE_S) as subscription:
            while subscription.receive(0.02) is None:  # a subscription takes effect a while after it was made
                daemon.publisher.event("test", "joined")
            daemon.start()
            assert daemon.wait(COMPILE_S)
            daemon.close()
            records = np.array([record_of(sample) for sample in _contacts(subscription)])
    assert records.shape == (ticks, RECORD_SIZE)
    return records


def _contacts(subscription: Subscription) -> Iterator[Any]:
    for sample in subscription:
        if sample.topic == "contact":
            assert sample.lost == 0
            yield sample
        elif sample["name"] == "stopped":
            return


def assert_engine_agrees(records: Array, scene: Scene, rate_hz: float) -> int:
    """Modes in every tick, and forces wherever the guard left them alone, are the engine's on the same poses.

    returns  in how many of these ticks there was contact
    """
    engine = Engine(scene, rate_hz)
    position, orientation, force = AT.probe_position, AT.probe_orientation, AT.force
    compared = 0
    for row in records:
        step = engine.step(row[position : position + 3], row[orientation : orientation + 4], float(row[AT.dt]))
        assert step.mode == row[AT.contact_mode]
        # A write that was withheld or held says what the hand feels instead, and the guard goes on from there.
        if row[AT.servo_guard] == 0 and row[AT.servo_device] not in (WITHHELD, HELD):
            # the same arithmetic, compiled into the loop and into the engine; the record's orientation has been
            # normalised once more
            np.testing.assert_allclose(row[force : force + 3], step.force, rtol=0, atol=1e-9)
            compared += step.mode != 0
    return compared


if __name__ == "__main__":
    RIG, SCENE, TICKS, FILE = sys.argv[1:]
    changes = {"telemetry.endpoint": "tcp://127.0.0.1:*", "servo.realtime": "off"}
    np.save(FILE, records_of_daemon(load_rig(RIG, changes), load_scene(SCENE), int(TICKS)))
