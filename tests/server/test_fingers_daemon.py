"""Two fingers end to end: opening and closing of devices, signals, losses, and the messages of each finger."""

import itertools
import re
import signal
import subprocess
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from emulators.serialboard import Board, Cable
from helpers.daemons import RecordSink, subscribed
from helpers.faulty_device import Driver, acts, registered
from helpers.processes import COMMAND
from helpers.programs import Program
from helpers.serial_devices import PLACE, RIG
from helpers.telemetry_records import join, put, synthetic
from helpers.two_fingers import NAMES, SCENE, two_devices, two_fingers
from helpers.waits import WAIT_S, repeated, until
from test_monitor import render_text

from softfinger.config.errors import ConfigError, DeviceNotFound, SafetyStop
from softfinger.config.schema import Rig
from softfinger.config.sources import find
from softfinger.drivers.poses import load_poses
from softfinger.proxy.record import AT, CAUSE_NAMES, RECORD_SIZE
from softfinger.server.app import Daemon
from softfinger.server.services.records import Sink
from softfinger.server.verbs import monitor
from softfinger.server.verbs.record import record
from softfinger.server.wire.client import Window, subscribe
from softfinger.server.wire.publisher import Publisher

pytestmark = pytest.mark.real_time

FAULTY = {"driver": "faulty"}
END_S = 20.0
FORCE_N = 0.5
ZERO = (0.0, 0.0, 0.0)


@pytest.fixture
def driver(monkeypatch: pytest.MonkeyPatch) -> Driver:
    return registered(monkeypatch)


def test_a_second_device_that_cannot_be_opened_closes_the_first(driver: Driver) -> None:
    driver.refuses = 1
    with pytest.raises(DeviceNotFound, match="plug it in"):
        Daemon(two_devices(FAULTY, FAULTY), two_fingers())
    assert acts(driver.devices[0]) == ["close", "stop"]


def test_a_hanging_read_zeroes_both_devices(driver: Driver) -> None:
    with Daemon(two_devices(FAULTY, FAULTY | {"fault": "hang", "at": 300}), two_fingers()) as running:
        try:
            running.start()
            with pytest.raises(SafetyStop, match="no tick for"):
                running.wait(WAIT_S)
            for device in driver.devices:
                until(lambda device=device: not device.wrenches[-1].any())
                assert device.wrenches.any() and "stop" in acts(device)
        finally:
            driver.device.release()


def test_two_pauses_are_one_pause_that_zeroes_both_devices(driver: Driver) -> None:
    with Daemon(two_devices(FAULTY, FAULTY), two_fingers()) as running:
        running.start()
        until(lambda: len(driver.devices) == 2 and driver.pressed)
        go_on = running.pause()
        running.pause()()
        before = running.servo.ticks
        until(lambda: running.servo.ticks > before + 10)
        assert not any(device.wrenches[-8:].any() for device in driver.devices)
        go_on()
        until(lambda: driver.pressed)
        running.stop()
        assert running.wait(WAIT_S)
    assert not any(device.wrenches[-1].any() for device in driver.devices)


def test_fingers_are_replaced_together(driver: Driver) -> None:
    rig, ticks = two_devices(FAULTY, FAULTY), list[int]()
    sink = Sink("kept", lambda records, drops: ticks.extend(records[:, AT.tick].astype(int)))
    with Daemon(rig, two_fingers(), sinks=[sink]) as running:
        running.start()
        until(lambda: len(driver.devices) == 2 and driver.pressed)
        running.replace(two_fingers())
        assert [acts(device) for device in driver.devices] == [["arm"]] * 2
        until(lambda: driver.pressed)
        other_rig = two_devices(FAULTY, FAULTY | {"at": 7}, telemetry={"endpoint": rig.telemetry.endpoint})
        running.replace(rig=other_rig)
        assert [acts(device)[:3] for device in driver.devices[:2]] == [["arm", "stop", "close"]] * 2
        assert not any(device.wrenches[-1].any() for device in driver.devices[:2])
        until(lambda: len(driver.devices) == 4 and driver.pressed)
        with pytest.raises(ConfigError, match=r"\(index, thumb\) differ from the running ones \(thumb, index\)"):
            running.replace(two_fingers(finger=[{"name": name, "radius_m": 0.01} for name in reversed(NAMES)]))
        running.stop()
        assert running.wait(WAIT_S)
    assert ticks == list(range(len(ticks))) and not any(device.wrenches[-1].any() for device in driver.devices)


def test_each_finger_has_its_topic_with_the_keys_of_contact(tmp_path: Path) -> None:
    replay = {"driver": "replay", "loop": False}
    rig = two_devices(replay | {"recording": "tap"}, replay | {"recording": "press-roll-spin-drag"})
    stored, recorded = RecordSink(), list[Any]()
    files = {name: tmp_path / f"{name}.csv" for name in NAMES}

    def take(endpoint: str) -> None:
        with subscribe(endpoint, ("contact", "finger/", "event")) as wire:
            recorded.append(record(wire, files, timeout_s=WAIT_S))

    with (
        Daemon(rig, two_fingers(), sinks=[stored.sink]) as running,
        subscribed(running.publisher.endpoint, "") as socket,
    ):
        recorder = threading.Thread(target=take, args=(running.publisher.endpoint,))
        recorder.start()
        until(lambda: running.publisher.figures.subscribers == 2)
        running.start()
        assert running.wait(WAIT_S)
        played = [device.samples for device in running.devices]
        running.close()
        messages = []
        while not messages or messages[-1][1].get("name") != "stopped":
            topic, body = socket.recv_multipart()
            messages.append((topic.decode(), msgpack.unpackb(body)))
        recorder.join(WAIT_S)
    records = stored.all.reshape(-1, 2, RECORD_SIZE)
    ticks = [(topic, message) for topic, message in messages if topic.startswith("finger/")]
    assert [topic for topic, _ in ticks] == ["finger/thumb", "finger/index"] * len(records)
    assert {topic for topic, _ in messages} == {"finger/thumb", "finger/index", "state", "event", "health", "schema"}
    for (_, message), row in zip(ticks, records.reshape(-1, RECORD_SIZE), strict=True):
        assert message["tick"] == row[AT.tick] and message["force"] == row[AT.force : AT.force + 3].tolist()
    assert ticks[0][1]["timestamp"] == ticks[1][1]["timestamp"]
    touched = [(m["finger"], m["tick"]) for topic, m in messages if topic == "event" and m["name"] == "touch"]
    causes = records[:, :, AT.contact_cause] == CAUSE_NAMES.index("touch")
    assert touched == [(NAMES[place], tick) for tick, place in np.argwhere(causes).tolist()] and len(touched) >= 4
    modes = next(message["modes"] for topic, message in messages if topic == "health")
    assert sum(modes.values()) % 2 == 0  # a tick of each finger
    for name, samples in zip(NAMES, played, strict=True):
        poses = load_poses(files[name])
        assert recorded[0][name].lost == 0
        first = recorded[0][name].first_tick
        np.testing.assert_array_equal(poses.position, samples[first : len(records), :3])
    assert recorded[0]["thumb"].first_tick == recorded[0]["index"].first_tick


def make_records(count: int, first: int = 0) -> np.ndarray:
    """Return rows (count, 2 x RECORD_SIZE) of a sliding thumb and a free index finger."""
    thumb, index = synthetic(count, first), synthetic(count, first, seed=2)
    put(thumb, "contact.mode", 2)
    put(thumb, "servo.guard", 1)
    for rows in (thumb, index):
        put(rows, "servo.missed", 5)
    return np.concatenate([thumb, index], axis=1)


def test_clients_separate_the_fingers() -> None:
    with Publisher("tcp://127.0.0.1:*", fingers=NAMES, guard_names=("clamped",)) as publisher:
        board = monitor.Dashboard(publisher.endpoint)
        with (
            subscribe(publisher.endpoint, ("finger/", "event", "health"), timeout_s=WAIT_S) as samples,
            Window(publisher.endpoint, 100, "index") as window,
            subscribed(publisher.endpoint, "event") as plain,
        ):
            until(lambda: publisher.figures.subscribers == 3)
            join(publisher, plain)
            publisher.publish(make_records(1001))
            publisher.publish(make_records(10, 1011))
            lost, guards, count = dict.fromkeys(NAMES, 0), [], 0
            while count < 2 * 1011 or not guards or board.health is None:  # these arrive after their ticks
                sample = next(samples)
                board.update(sample)
                if sample.topic.startswith("finger/"):
                    count += 1
                    lost[sample.topic.removeprefix("finger/")] += sample.lost
                elif sample.topic == "event" and sample.kind == "guard":
                    guards.append((sample.finger, sample.name))
            assert lost == {"thumb": 10, "index": 10}
            assert guards == [("thumb", "clamped")]
            until(lambda: window.update(0.1) == 0 and len(window) == 100)
            assert window["contact.mode"].max() == 0 and window.lost == 10
            health = board.health
            assert health is not None and health.guarded == 1000
            assert health.as_map()["modes"] == {"free": 1000, "rolling": 0, "sliding": 1000}
            assert health.missed == 5
    line = monitor.format_line(board)
    assert line.index("index: tick 1020 free") < line.index("thumb: tick 1020 sliding")
    drawn = "\n".join(render_text(board, 100, 60))
    assert re.search(r"finger +index(.|\n)*mode +free(.|\n)*finger +thumb(.|\n)*mode +sliding", drawn)
    content = board.summary()
    assert content["contact"] is None
    assert [finger["mode"] for finger in content["fingers"].values()] == ["sliding", "free"]


def test_recording_requires_a_file_for_each_finger(tmp_path: Path) -> None:
    firsts = itertools.count(0, 10)
    with (
        Publisher("tcp://127.0.0.1:*", fingers=NAMES) as publisher,
        subscribe(publisher.endpoint, ("contact", "finger/", "event")) as wire,
        repeated(lambda: publisher.publish(make_records(10, next(firsts))), 0.01),
        pytest.raises(ConfigError, match=r"several fingers, such as \w+: --poses \w+=FILE"),
    ):
        record(wire, {"": tmp_path / "one.csv"})


@contextmanager
def pressing(tmp_path: Path) -> Iterator[tuple[list[Board], list[Cable], subprocess.Popen[str]]]:
    boards = [Board(lambda _: (*PLACE[:2], 0.006)) for _ in NAMES]
    with ExitStack() as lines:
        cables = [lines.enter_context(Cable(board)) for board in boards]
        text = find(RIG, Rig).read_text()
        head, device, rest = re.split(r"(?=^\[device\]\n|^\[servo\]\n)", text, flags=re.MULTILINE)
        for name, cable in zip(NAMES, cables, strict=True):
            named = f'driver = "serial"\npath = "{cable.path}"\nquiet_s = 0.1\ntimeout_s = 2.0\n'
            head += device.replace("[device]", f"[devices.{name}]").replace('driver = "serial"\n', named)
        (tmp_path / "rig.toml").write_text(head + rest)
        (tmp_path / "scene.toml").write_text(SCENE)
        command = [*COMMAND, "run", "--realtime", "off"]
        command += ["--rig", str(tmp_path / "rig.toml"), "--scene", str(tmp_path / "scene.toml")]
        command += ["--endpoint", f"ipc://{tmp_path}/t"]
        with Program(command, stderr=subprocess.PIPE, text=True, kill_at_end=True) as process:
            until(lambda: all(board.force[2] > FORCE_N for board in boards) or process.poll() is not None)
            assert process.poll() is None, process.communicate()[1]
            yield boards, cables, process


def test_a_signal_zeroes_both_boards(tmp_path: Path) -> None:
    with pressing(tmp_path) as (boards, _, process):
        process.send_signal(signal.SIGTERM)
        stderr = process.communicate(timeout=END_S)[1]
        assert process.returncode == 0 and "force is zero" in stderr, stderr
        for board in boards:
            until(lambda board=board: board.force == ZERO)
            assert board.faults == []


@pytest.mark.parametrize("place", [0, pytest.param(1, marks=pytest.mark.exhaustive)])
def test_a_silent_board_zeroes_the_other(place: int, tmp_path: Path) -> None:
    with pressing(tmp_path) as (boards, cables, process):
        cables[place].hush()
        stderr = process.communicate(timeout=END_S)[1]
        assert process.returncode == 4, stderr
        assert f"finger '{NAMES[place]}'" in stderr and "Traceback" not in stderr
        until(lambda: boards[1 - place].force == ZERO)


def test_watchers_zero_both_boards_of_a_killed_daemon(tmp_path: Path) -> None:
    with pressing(tmp_path) as (boards, _, process):
        process.kill()
        stderr = process.communicate(timeout=END_S)[1]
        assert stderr.count("the daemon has died: zero force was written to /dev/pts/") == 2
        for board in boards:
            until(lambda board=board: board.force == ZERO)
