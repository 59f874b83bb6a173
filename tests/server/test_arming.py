"""Arming by the program, by command and by button, on a daemon with a device that counts as held by a hand.

A replay pushes a fingertip into a plane and drags it. Injected faults make the device count as held by a hand and press
its button. The device logs each wrench. All tests use one scene, so one loop is compiled (20 s).
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softfinger.config.load import build, load_rig, load_scene
from softfinger.config.schema import Faults
from softfinger.proxy.record import AT
from softfinger.server.app import Daemon
from softfinger.server.loop.limits import SLOW_TIME_S
from softfinger.server.recording.reader import Event, read_contents
from softfinger.server.services.records import Sink
from softfinger.server.states import NOT_ARMED_REASON, TOO_FAST_REASON
from softfinger.server.wire.control import Control

pytestmark = pytest.mark.real_time

TOUCH_N = 0.1
RAMP_S = 0.02
NOTHING = {"kind": "stale", "at_tick": 10}
"""Fault without effect."""


def write_press(path: Path, fast_at_s: float | None = None) -> str:
    times = np.arange(0.0, 3.005, 0.01)
    x = np.zeros_like(times) if fast_at_s is None else np.clip(4.0 * (times - fast_at_s), 0.0, 0.2)
    rest = np.tile([0.0, 0.009, 1.0, 0.0, 0.0, 0.0], (len(times), 1))
    np.savetxt(path, np.column_stack([times, x, rest]), delimiter=",", header="t,x,y,z,qw,qx,qy,qz", comments="")
    return str(path)


class ArmingRun:
    def __init__(self, tmp_path: Path, recording: str, arm: str, fault: Any = NOTHING, during: Any = None) -> None:
        changes = {
            "device.recording": recording, "device.loop": False, "guard.ramp_s": RAMP_S, "guard.arm": arm,
            "servo.realtime": "off", "telemetry.endpoint": f"ipc://{tmp_path}/telemetry",
        }  # fmt: skip
        ticks: list[int] = [-1]
        sink = Sink("ticks", lambda records, drops: ticks.append(int(records[-1, AT.tick])))
        faults = build(Faults, {"fault": [fault]}, "faults")
        path = tmp_path / "run.mcap"
        daemon = Daemon(load_rig("replay", changes), load_scene("paper-plane"), 2500, sinks=[sink], faults=faults)
        with daemon:
            daemon.recordings.record(str(path), "paper-plane")
            daemon.start()
            with Control(daemon.commands_endpoint) as control:
                while not daemon.wait(0.02):
                    if during is not None:
                        during(control, ticks[-1])
                self.state = control.ask("describe")["state"]
            self.forces = np.linalg.norm(daemon.devices[0]._device.read_log().wrench[:, :3], axis=1)
        events = [part.event for part in read_contents(path) if isinstance(part, Event)]
        self.states = [(event["name"], event["cause"]) for event in events if event["kind"] == "state"]
        self.guard = [event["name"] for event in events if event["kind"] == "guard"]


def test_a_button_pressed_before_the_start_does_not_arm(tmp_path: Path) -> None:
    press = {"kind": "bounce", "buttons": 1, "at_tick": 0, "ticks": 1000, "every_ticks": 1}
    run = ArmingRun(tmp_path, write_press(tmp_path / "p.csv"), "button", press)
    assert not run.forces.any() and run.state == "ready"


def test_a_button_arms(tmp_path: Path) -> None:
    press = {"kind": "bounce", "buttons": 1, "at_tick": 800, "ticks": 50}
    run = ArmingRun(tmp_path, write_press(tmp_path / "p.csv"), "button", press)
    assert not run.forces[:800].any() and run.forces[2000] > TOUCH_N
    assert [name for name, _ in run.states[:2]] == ["ready", "armed"]


def test_the_force_of_a_handle_that_was_too_fast_returns_automatically(tmp_path: Path) -> None:
    run = ArmingRun(tmp_path, write_press(tmp_path / "p.csv", 0.5), "automatic")
    assert run.forces[1] > 0.0 and run.forces[100] > TOUCH_N and run.forces[495] > TOUCH_N
    off = np.flatnonzero(run.forces[500:] == 0.0) + 500
    assert off[0] < 550
    # SLOW_S is counted in ticks and may start while the handle still slows down.
    back = off[0] + np.flatnonzero(run.forces[off[0] :] > 0.0)[0]
    assert back - off[0] >= round(1000.0 * SLOW_TIME_S)
    assert run.forces[2000] > TOUCH_N
    assert [name for name, _ in run.states[:5]] == ["ready", "armed", "faulted", "ready", "armed"]
    assert run.states[2][1] == TOO_FAST_REASON and "too_fast" in run.guard and run.state == "armed"


def test_a_handle_that_was_too_fast_waits_for_arming(tmp_path: Path) -> None:
    armed_at: list[int] = []

    def during(control: Control, tick: int) -> None:
        if tick > 50 and not armed_at:
            control.arm()
            armed_at.append(tick)
        if tick > 1600 and len(armed_at) == 1:
            assert control.ask("describe")["state"] == "faulted"
            control.arm()
            armed_at.append(tick)

    run = ArmingRun(tmp_path, write_press(tmp_path / "p.csv", 0.5), "command", during=during)
    off = np.flatnonzero(run.forces[500:] == 0.0)[0] + 500
    assert armed_at[0] > 50 and off < 550 and len(armed_at) == 2
    assert not run.forces[: armed_at[0]].any() and run.forces[:off].max() > TOUCH_N
    assert not run.forces[off : armed_at[1]].any() and run.forces[-10] > TOUCH_N
    assert (("faulted", TOO_FAST_REASON) in run.states) and ("ready", NOT_ARMED_REASON) not in run.states
