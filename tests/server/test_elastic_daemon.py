"""A running daemon that changes between an elastic and a rigid scene while the finger presses, and its recording.

Exhaustive: the loop of the elastic scene compiles for a minute.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq
from helpers.faulty_device import registered
from helpers.pressed import pressed_scene
from helpers.waits import until
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from softfinger.config.load import describe, load_rig, load_scene
from softfinger.server.app import Daemon
from softfinger.server.loop.force_switch import MAX_OFF_S
from softfinger.server.recording.run import load_run
from softfinger.server.remote import Client
from softfinger.server.wire.protocol import DEFORMATION, decode

pytestmark = [pytest.mark.real_time, pytest.mark.exhaustive]

WAIT_S = 300.0
SLEW_N_PER_S = 500.0
"""Also of the fall to zero before a new scene, which takes MAX_OFF_S from the largest force."""
PERIOD_S = 0.001
FADED_TICKS = 600
"""The ramp of the rig `replay` takes 0.5 s."""


def receive_until(socket: zmq.Socket[bytes], is_last: Any) -> list[Any]:
    """Return the messages of the topic `deformation` up to the first for which `is_last` is true."""
    messages: list[Any] = []
    while not messages or not is_last(messages[-1]):
        assert socket.poll(1000.0 * WAIT_S)
        messages.append(decode(*socket.recv_multipart()))
    return messages


def wait_until_faded_in(daemon: Daemon) -> None:
    """Wait until the guard's ramp of the running scene has ended."""
    until(lambda: daemon.rendering.servo.ticks > daemon.rendering.since + FADED_TICKS, WAIT_S)


def test_scenes_change_while_the_finger_presses(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    registered(monkeypatch)
    endpoint, path = f"ipc://{tmp_path}/telemetry", tmp_path / "a.mcap"
    rig = load_rig("replay", {
        "device.driver": "faulty", "telemetry.endpoint": endpoint, "servo.realtime": "off",
        "guard.force_slew_n_per_s": SLEW_N_PER_S, "guard.force_max_n": SLEW_N_PER_S * MAX_OFF_S,
        "recording.directory": str(tmp_path),
    })  # fmt: skip
    elastic, rigid = describe(load_scene("press-a-pad")), describe(pressed_scene())
    with (
        Daemon(rig, load_scene("press-a-pad")) as daemon,
        zmq.Context.instance().socket(zmq.SUB) as socket,
    ):
        socket.subscribe(DEFORMATION)
        socket.connect(daemon.publisher.endpoint)
        daemon.recordings.record(path, "press-a-pad")
        daemon.start()
        sent, firsts = receive_until(socket, lambda message: message.loads), []
        wait_until_faded_in(daemon)
        with Client(daemon.publisher.endpoint, str(daemon.commands_endpoint), timeout_s=WAIT_S) as client:
            client.set_scene(rigid)
            firsts.append(daemon.rendering.since)
            sent += receive_until(socket, lambda message: message.tick >= firsts[0])
            wait_until_faded_in(daemon)
            assert not sent[-1].loads and not socket.poll(0)
            client.set_scene(elastic)
            firsts.append(daemon.rendering.since)
            sent += receive_until(socket, lambda message: message.loads)
            wait_until_faded_in(daemon)
        daemon.stop()
        assert daemon.wait(WAIT_S)
    rigid_first, elastic_first = firsts
    for message in sent:
        assert not (message.loads and rigid_first <= message.tick < elastic_first)
    ticks = load_run(path, ("tick", "force")).first
    steps = np.abs(np.diff(ticks["force"], axis=0)).max(axis=1)[np.diff(ticks["tick"]) == 1]
    assert steps.max() <= SLEW_N_PER_S * PERIOD_S * (1.0 + 1e-9)
    pressed = ticks["force"][:, 2] > 0.3  # force, zero, 2 N of the rigid scene, zero, force
    assert np.count_nonzero(np.diff(pressed.astype(int)) == 1) == 3

    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        recorded = [message for _, _, _, message in reader.iter_decoded_messages(topics=[DEFORMATION])]
    assert [(entry.tick, [tuple(load.force) for load in entry.loads]) for entry in recorded][: len(sent)] == [
        (entry.tick, [load.force for load in entry.loads]) for entry in sent
    ]
    replay = [sys.executable, "-m", "softfinger.server.cli", "replay", str(path), "--tolerance", "1e-12"]
    plain = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    completed = subprocess.run(replay, capture_output=True, text=True, check=False, env=plain, timeout=WAIT_S)
    assert completed.returncode == 0 and " 0 differ" in completed.stdout, completed.stdout + completed.stderr
