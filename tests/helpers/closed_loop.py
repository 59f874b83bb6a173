"""Run a device's closed loop through the daemon, and compare each tick with the engine on the same poses.

python closed_loop.py RIG SCENE TICKS FILE.npy      for tests with an emulated bus, which need a separate process

TICKS is a number, or `stroke`: until the finger was in contact in both modes and is free again.
"""

import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.config.load import load_rig, load_scene
from softfinger.config.schema import Rig, Scene
from softfinger.drivers.base import HELD, WITHHELD
from softfinger.proxy.engine import Engine
from softfinger.proxy.record import AT, FREE, RECORD_SIZE, ROLLING, SLIDING
from softfinger.server.app import Daemon
from softfinger.server.wire.client import Subscription, record_of, subscribe

Array = NDArray[np.float64]
COMPILE_S = 300.0
"""Longest silence: a cold start compiles before the first tick."""


def records_of_daemon(rig: Rig, scene: Scene, ticks: int | None) -> Array:
    """Run a daemon to its last tick; return the received records (ticks, RECORD_SIZE), of which none may be missing.

    ticks  their number; None: one stroke, which takes more of them on a busy machine
    """
    with Daemon(rig, scene, ticks) as daemon:
        endpoint = daemon.publisher.endpoint
        with subscribe(endpoint, ("contact", "event"), timeout_s=COMPILE_S) as subscription:
            while subscription.receive(0.02) is None:  # a subscription takes effect some time after it was made
                daemon.publisher.event("test", "joined")
            daemon.start()
            contacts = map(record_of, _contacts(subscription))
            records = [] if ticks else list(_stroke(contacts))
            if not ticks:
                daemon.stop()
            assert daemon.wait(COMPILE_S)
            daemon.close()
            records += contacts
    assert np.shape(records) == (ticks or len(records), RECORD_SIZE)
    return np.array(records)


def _stroke(contacts: Iterator[Any]) -> Iterator[Any]:
    counts = [0, 0, 0]
    for record in contacts:
        yield record
        counts[int(record[AT.contact_mode])] += 1
        if record[AT.contact_mode] == FREE and min(counts) > 20 and counts[ROLLING] + counts[SLIDING] > 300:
            return


def _contacts(subscription: Subscription) -> Iterator[Any]:
    for sample in subscription:
        if sample.topic == "contact":
            assert sample.lost == 0
            yield sample
        elif sample["name"] == "stopped":
            return


def assert_engine_agrees(records: Array, scene: Scene, rate_hz: float) -> int:
    """Check the mode and the force before the guard of every tick against the engine, and the force after it.

    returns  number of ticks with contact
    """
    engine = Engine(scene, rate_hz)
    position, orientation, force, before_guard = AT.probe_position, AT.probe_orientation, AT.force, AT.contacts0_force
    in_contact = 0
    for row in records:
        step = engine.step(row[position : position + 3], row[orientation : orientation + 4], float(row[AT.dt]))
        assert step.mode == row[AT.contact_mode]
        # The loop and the engine compile the same arithmetic, but the record's orientation has been normalised once
        # more.
        np.testing.assert_allclose(row[before_guard : before_guard + 3], step.force, rtol=0, atol=1e-9)
        # If a write was withheld or repeated, the record has the force at the device, from which the guard continues.
        if row[AT.servo_guard] == 0 and row[AT.servo_device] not in (WITHHELD, HELD):
            np.testing.assert_allclose(row[force : force + 3], step.force, rtol=0, atol=1e-9)
        in_contact += step.mode != 0
    return in_contact


if __name__ == "__main__":
    RIG, SCENE, TICKS, FILE = sys.argv[1:]
    changes = {"telemetry.endpoint": "tcp://127.0.0.1:*", "servo.realtime": "off"}
    np.save(
        FILE, records_of_daemon(load_rig(RIG, changes), load_scene(SCENE), None if TICKS == "stroke" else int(TICKS))
    )
