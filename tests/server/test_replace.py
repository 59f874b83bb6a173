"""Replacing scene or rig in a running daemon: the force starts at zero, and the process continues."""

import gc
import os
import threading
import time
import weakref
from contextlib import contextmanager

import numpy as np
import pytest
from helpers.daemons import RecordSink
from helpers.faulty_device import FaultyDevice, acts, registered
from helpers.waits import WAIT_S, eventually

from softfinger.config.errors import ConfigError, DeviceError, DeviceNotFound
from softfinger.config.load import load_rig, load_scene
from softfinger.proxy.record import AT
from softfinger.server.app import Daemon
from softfinger.server.loop import realtime
from softfinger.server.loop.fault_detection import STALL_MAX_S
from softfinger.server.loop.force_switch import MAX_OFF_S
from softfinger.server.services import rendering
from softfinger.server.services.records import Sink
from softfinger.server.states import COMMANDED_REASON, NOT_ARMED_REASON

pytestmark = pytest.mark.real_time

QUIET = {"telemetry.endpoint": "tcp://127.0.0.1:*", "servo.realtime": "off", "guard.ramp_s": 0.05}
FORCE = slice(AT.force, AT.force + 3)
TIMES = 20
SLEW = 200.0


def wait_for_force(recorder: RecordSink, newtons: float = 0.2) -> None:
    assert eventually(lambda: np.linalg.norm(recorder.force) > newtons)


def load_scenes():
    return load_scene("paper-plane"), load_scene("frictionless-plane")


@contextmanager
def started(rig, scene, *sinks):
    """Run a daemon; after 100 ticks yield it, then stop it if it still runs."""
    with Daemon(rig, scene, sinks=sinks) as running:
        running.start()
        assert eventually(lambda: running.servo.ticks > 100)
        yield running
        running.stop()
        assert running.wait(WAIT_S)


def count_resources() -> tuple[int, int]:
    return threading.active_count(), len(os.listdir("/proc/self/fd"))


PAD = ("replay", "press-a-pad", {"device.recording": "press-a-pad"})


@pytest.mark.parametrize(
    ("rig_name", "other", "recording"),
    [("replay", "paper-plane", {}), ("simulated", "paper-plane", {}), pytest.param(*PAD, marks=pytest.mark.exhaustive)],
)
def test_a_scene_exchanged_in_contact_is_never_a_step_of_force(rig_name, other, recording):
    # At a low slew limit a force close to its largest takes MAX_OFF_S to fade, six ticks.
    low = {"guard.force_max_n": 0.4, "guard.force_slew_n_per_s": 20.0}
    rig, recorder = load_rig(rig_name, QUIET | low | recording), RecordSink()
    first, second = load_scene(other), load_scene("frictionless-plane")
    first_ticks, missed, loops, open_before = [], [], [], None
    with Daemon(rig, first, sinks=[recorder.sink]) as running:
        running.start()
        for time_number in range(TIMES):
            wait_for_force(recorder)
            loops.append(weakref.ref(running.servo.shared.tuning.values))
            first_ticks.append(running.rendering.replace(first if time_number % 2 else second))
            missed.append(running.servo.missed_before)
            if time_number == 1:  # both are compiled
                open_before = count_resources()
            assert eventually(lambda: running.servo.ticks > first_ticks[-1] + 5)
        # Fewer are fine too: a file of cached kernels may have been open during the first count.
        assert all(now <= before for now, before in zip(count_resources(), open_before, strict=True))
        assert not running.wait(0.0)  # it continues
        assert len(running.servo.records._rings) == 1
        gc.collect()
        assert sum(loop() is not None for loop in loops) == 0
        (device,) = running.devices
        running.stop()
        assert running.wait(60.0)
        ticks = running.servo.ticks
        written = device.read_log().wrench
    rows = recorder.all
    assert rows[:, AT.tick].tolist() == list(range(ticks))
    assert rows[first_ticks, AT.servo_missed].tolist() == missed
    assert (np.diff(rows[:, AT.timestamp]) > 0.0).all() and (np.diff(rows[:, AT.servo_missed]) >= 0.0).all()
    assert not rows[[number - 1 for number in first_ticks]][:, FORCE].any()
    largest = rig.guard.force_max_n / (MAX_OFF_S * rig.servo.rate_hz)
    for forces in (rows[:, FORCE], written[:-2, :3]):  # except the last zeros, of a stop in contact
        steps = np.linalg.norm(np.diff(forces, axis=0), axis=1)
        assert steps.max() <= largest * (1.0 + 1e-9)  # rounding of the sum that makes a step
        assert np.linalg.norm(forces, axis=1).max() > 0.2


def test_a_new_rig_cannot_exceed_the_force_of_the_device():
    most, device = 0.3, {"device.force_max_n": 0.3}
    recorder, rig = RecordSink(), load_rig("simulated", {**QUIET, **device, "guard.force_max_n": 0.2})
    with Daemon(rig, load_scene("paper-plane"), sinks=[recorder.sink]) as running:
        running.start()
        wait_for_force(recorder, 0.19)
        first_tick = running.replace(rig=load_rig("simulated", {**QUIET, **device, "guard.force_max_n": 40.0}))
        assert eventually(lambda: running.servo.ticks > first_tick + 200)
        running.stop()
        assert running.wait(WAIT_S)
        (plant,) = running.devices
        written = np.linalg.norm(plant.read_log().wrench[:, :3], axis=1)
    norms = np.linalg.norm(recorder.all[:, FORCE], axis=1)
    assert norms[:first_tick].max() == pytest.approx(0.2, rel=1e-12)  # rounding of the scaled vector
    assert norms.max() == pytest.approx(most, rel=1e-12) and written.max() <= most * (1.0 + 1e-12)


def test_a_new_rig_builds_the_scene_before_the_loop_ends(monkeypatch):
    """While no loop runs, the supervisor counts a pause of 0.25 s as a stall, and a large mesh takes longer to read."""
    make_tuning, built = rendering.make_tuning, []

    def count_and_make(*arguments):
        built.append(running.servo.shared.stop[0])
        return make_tuning(*arguments)

    with started(load_rig("replay", QUIET), load_scene("paper-plane")) as running:
        monkeypatch.setattr(rendering, "make_tuning", count_and_make)
        running.replace(rig=load_rig("replay", {**QUIET, "guard.force_max_n": 1.0}))
        assert built == [0] and running.servo.tuning.guards[0].force_max == 1.0


def test_a_stiff_scene_replaced_in_contact_ramps_like_any_other():
    rig, recorder = load_rig("replay", {**QUIET, "guard.ramp_s": 0.5}), RecordSink()
    stiff = load_scene("frictionless-plane", {"object.0.material.stiffness_n_per_m": 1e6})
    with started(rig, load_scene("frictionless-plane"), recorder.sink) as running:
        wait_for_force(recorder)
        first_tick = running.rendering.replace(stiff)
        assert eventually(lambda: running.servo.ticks > first_tick + 500)
    forces = np.linalg.norm(recorder.all[first_tick : first_tick + 500, FORCE], axis=1)
    limits = rig.guard.force_max_n * np.arange(1, 501) / (rig.guard.ramp_s * rig.servo.rate_hz)
    assert (forces <= limits * (1.0 + 1e-9)).all()  # rounding of the sum of shares
    assert (forces[:20] > 0.9 * limits[:20]).all()  # the hand has not moved away yet


def test_a_scene_that_cannot_be_built_changes_nothing(monkeypatch):
    rig, recorder, (first, second) = load_rig("replay", QUIET), RecordSink(), load_scenes()
    refused = [
        (ConfigError, "forcse", {"device.forcse": "x.csv"}),
        (ConfigError, "another", {"telemetry.every": 10}),
        (ConfigError, "another", {"servo.priority": 70}),
        (DeviceNotFound, "no driver", {"device.driver": "nosuch"}),
    ]
    with started(rig, first, recorder.sink) as running:
        shared, devices = running.servo.shared, running.devices
        for error, words, changes in refused:
            with pytest.raises(error, match=words):
                running.replace(second, rig=load_rig("replay", QUIET | changes))
        monkeypatch.setattr(rendering, "make_tuning", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            running.replace(second)
        assert running.servo.shared is shared and running.devices is devices
        wait_for_force(recorder)


@pytest.fixture
def driver(monkeypatch):
    return registered(monkeypatch)


def make_faulty_rig(**changes):
    # Slew limit below the force of this device: a step to or from zero in one tick would exceed it.
    return load_rig("replay", QUIET | {"device.driver": "faulty", "guard.force_slew_n_per_s": SLEW} | changes)


def test_another_device_is_opened_after_the_old_one_is_zeroed_and_closed(driver):
    recorder, (first, second) = RecordSink(), load_scenes()
    with started(make_faulty_rig(), first, recorder.sink) as running:
        wait_for_force(recorder)
        running.replace(second, make_faulty_rig(**{"servo.rate_hz": 4000.0}))
        assert eventually(lambda: len(driver.devices) == 2 and np.abs(driver.device.wrenches).max(initial=0.0) > 0.2)
    old, new = driver.devices
    assert acts(old) == ["arm", "stop", "close", "stop"] and acts(new)[:2] == ["arm", "stop"]
    assert new.acts[0][2] == 0
    for device, rate in ((old, 1000.0), (new, 4000.0)):
        rises = np.diff(np.linalg.norm(device.wrenches[:, :3], axis=1))  # falls may be faster: MAX_OFF_S
        assert rises.max() <= SLEW / rate * (1.0 + 1e-9)
        assert not device.wrenches[-1].any()
    assert recorder.all[:, AT.tick].tolist() == list(range(running.servo.ticks))


def test_threads_of_a_new_device_get_their_priority(driver, monkeypatch):
    raised: list[tuple[str, int | None, int]] = []

    def raise_priority(name: str, thread: int | None, priority: int) -> realtime.Setting:
        raised.append((name, thread, priority))
        return realtime.Setting(name, True, f"priority {priority}", "")

    monkeypatch.setattr(realtime, "raise_priority", raise_priority)
    monkeypatch.setattr(FaultyDevice, "thread_ids", lambda device: [1000 + driver.devices.index(device)])
    with started(make_faulty_rig(**{"servo.realtime": "auto"}), load_scene("paper-plane")) as running:
        running.replace(rig=make_faulty_rig(**{"servo.realtime": "auto", "device.at": 7}))
    assert [thread for name, thread, _ in raised if name == "exchange"] == [1000, 1001]
    assert len({priority for name, _, priority in raised if name in ("exchange", "relay")}) == 1


def test_a_device_that_stays_keeps_arming_and_offset_but_a_new_one_does_not(driver):
    newest, (first, second) = [], load_scenes()
    rig = make_faulty_rig(**{"guard.arm": "command"})
    with started(rig, first, Sink("newest", lambda records, drops: newest.append(records[-1].copy()))) as running:
        rendering, devices = running.rendering, driver.devices

        def pressed() -> bool:
            return float(np.abs(devices[-1].wrenches[-5:]).max(initial=0.0)) > 0.1

        def idle() -> bool:
            ticks = running.servo.ticks
            return eventually(lambda: running.servo.ticks > ticks + 100)

        assert not devices[0].wrenches.any()
        rendering.disarm(COMMANDED_REASON)
        assert eventually(lambda: rendering.force.is_off and newest)
        z = newest[-1][AT.probe_position + 2]
        rendering.set_offset(0, (0.0, 0.0, z - 0.0005), newest[-1])
        moved = rendering.offsets
        assert moved[0][2] == pytest.approx(-0.0005, rel=1e-6)
        rendering.arm(NOT_ARMED_REASON, COMMANDED_REASON)
        assert eventually(pressed)
        running.replace(second)
        assert len(devices) == 1 and rendering.force.is_requested and rendering.offsets == moved
        assert eventually(pressed)
        for changes in ({"device.at": 7}, {"device.at": 7, "servo.rate_hz": 500.0}):
            count = len(devices)
            running.replace(second, make_faulty_rig(**{"guard.arm": "command"} | changes))
            assert len(devices) == count + 1 and not rendering.force.is_requested
            assert rendering.offsets == ((0.0, 0.0, 0.0),)
            assert idle() and not devices[-1].wrenches.any()
            rendering.arm(NOT_ARMED_REASON)
            assert eventually(pressed)


@pytest.mark.parametrize(
    ("refuses", "error", "message", "opened"),
    [
        ("opening", DeviceNotFound, "plug it in", 1),
        ("arming", DeviceError, "force button", 2),
        ("zero", DeviceError, r"zero force is not confirmed \(it is stuck\)", 1),
    ],
)
def test_a_device_that_cannot_be_used_ends_the_run_at_zero(refuses, error, message, opened, driver, monkeypatch):
    first, second = load_scenes()
    if refuses == "zero":
        monkeypatch.setattr(FaultyDevice, "zero_failure", lambda device: "it is stuck")
    with Daemon(make_faulty_rig(), first) as running:
        running.start()
        assert eventually(lambda: running.servo.ticks > 100)
        driver.refuses = 1 if refuses == "opening" else driver.refuses
        with pytest.raises(error, match=message):
            running.replace(second, make_faulty_rig(**{"device.refuses_to_arm": True}))
        with pytest.raises(error, match=message):
            running.wait(60.0)
    assert len(driver.devices) == opened and all("close" in acts(device) for device in driver.devices)
    assert not driver.devices[0].wrenches[-1].any()


def test_a_stop_during_a_replacement_arms_nothing(driver):
    first, second = load_scenes()
    with started(make_faulty_rig(), first) as running:
        opening = driver.open_device

        def stopped_meanwhile(options, rate_hz):
            running.stop()
            return opening(options, rate_hz)

        driver.open_device = stopped_meanwhile
        running.replace(second, make_faulty_rig(**{"device.at": 7}))
        assert running.wait(60.0)
    assert "arm" not in acts(driver.devices[1]) and "close" in acts(driver.devices[1])
    assert "close" in acts(driver.devices[0])


def test_a_device_that_opens_slowly_is_no_stall(driver):
    with started(make_faulty_rig(), load_scene("paper-plane")) as running:
        opening = driver.open_device

        def open_slowly(options, rate_hz):
            time.sleep(2.0 * STALL_MAX_S)
            return opening(options, rate_hz)

        driver.open_device = open_slowly
        first = running.replace(rig=make_faulty_rig(**{"device.at": 7}))
        assert eventually(lambda: running.servo.ticks > first + 100)


def test_a_pause_during_a_replacement_ends_the_run(driver):
    """While a loop is replaced, Ctrl-Z cannot ramp the force down, so the servo stops at zero."""
    first, _ = load_scenes()
    with started(make_faulty_rig(), first) as running:
        with running.rendering._tuning_lock:
            running.pause()()
        assert running.wait(60.0)
    assert not driver.devices[0].wrenches[-1].any()


def test_the_number_of_ticks_is_counted_over_all_loops(driver):
    recorder, (first, second) = RecordSink(), load_scenes()
    rig = make_faulty_rig(**{"servo.rate_hz": 200.0})  # slow, so that a busy machine can follow
    with Daemon(rig, first, 1_000, sinks=[recorder.sink]) as running:
        running.start()
        assert eventually(lambda: running.servo.ticks > 20)
        running.replace(second)
        assert running.wait(120.0) and running.servo.ticks == 1_000
    assert recorder.all[-1, AT.tick] == 999
