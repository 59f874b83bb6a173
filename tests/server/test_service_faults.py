"""Failing services, monitors, a clock that is set, the queue of requests: the run continues, or ends with an error."""

import errno
import os
import socket
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgpack
import numpy as np
import pytest
from helpers.waits import ends_within, until
from test_devices_verb import plug_hid, plug_usb, root  # noqa: F401  (a fixture)

from softfinger.config.errors import RecordingError, SafetyStop
from softfinger.proxy.record import AT, CAUSE_TOUCH, RECORD_SIZE, ROLLING
from softfinger.server.metrics import service as metrics_service
from softfinger.server.metrics.counts import MetricsCollector
from softfinger.server.metrics.service import MetricsService
from softfinger.server.recording.recorder import RecorderState
from softfinger.server.services import recordings
from softfinger.server.services.command_service import CommandService
from softfinger.server.services.monitoring import (
    DEVICE_WARNING,
    SWAPPED,
    DeviceWarningMonitor,
    HotplugMonitor,
    SwapMonitor,
)
from softfinger.server.services.scene_topics import WorldPublisher
from softfinger.server.socket_process.channel_messages import Figures
from softfinger.server.socket_process.command_clients import (
    BUSY_MESSAGE,
    CLIENTS_MAX,
    QUEUED_BYTES_MAX,
    QUEUED_MAX,
    RequestQueue,
    encode_busy,
)
from softfinger.server.states import UNREACHABLE_REASON, DaemonState
from softfinger.server.wire.events import RecordEvents
from softfinger.server.wire.health import HealthSummary

pytestmark = pytest.mark.plain

WAIT_S = 20.0


class BrokenSource:
    def __getattr__(self, name: str) -> Any:
        raise OSError(f"{name} is gone")


@pytest.mark.parametrize("name", ["hotplug", "metrics", "world"])
def test_a_failed_service_is_reported_and_ends_nothing(name: str) -> None:
    events, came = [], threading.Event()

    def event(kind: str, fault_name: str, message: str) -> None:
        events.append((kind, fault_name, message))
        came.set()

    broken = BrokenSource()
    if name == "metrics":
        counts = MetricsCollector([""], lambda: (Figures(), 0), RecorderState, lambda: DaemonState.READY)
        files = SimpleNamespace(close=lambda: None)
        bound = SimpleNamespace(endpoint="tcp://127.0.0.1:1", listener=broken, files=files)
        service = MetricsService(bound, counts, event)
    elif name == "hotplug":
        service = HotplugMonitor(event)
        service._known = broken
    else:
        service = WorldPublisher(broken, print, event)
    service.start()
    assert came.wait(WAIT_S)
    service.stop()
    ((kind, fault_name, message),) = events
    assert (kind, fault_name) == ("fault", name) and "is gone" in message


@pytest.mark.parametrize(("heartbeat_s", "is_missed"), [(-1.0, True), (60.0, False)])
def test_commands_that_fail_end_a_run_that_needs_heartbeats(heartbeat_s: float, is_missed: bool) -> None:
    events, ended, served, deadlines_ns, reasons = [], [], [], [], []

    class Failing:
        is_reachable = True

        def set_deadline(self, time_ns: int) -> None:
            deadlines_ns.append(time_ns)

        def is_inhibited_by(self, why: str) -> bool:
            raise OSError("no memory")

        def note_guard(self, why: str, is_inhibiting: bool) -> None:
            reasons.append((why, is_inhibiting))

    rig = SimpleNamespace(commands=SimpleNamespace(heartbeat_s=heartbeat_s))
    rendering = SimpleNamespace(rig=rig, force=Failing())
    actions = SimpleNamespace(
        replace=print,
        publisher=SimpleNamespace(set_preparing=print, commands=SimpleNamespace(serve=served.append)),
        fail=ended.append,
        event=lambda *words, **more: events.append((words, more)),
    )
    commands = CommandService("ipc:///nowhere", rendering, actions, "a scene")
    started_ns = time.monotonic_ns()
    commands.start()
    served[0].each_period()
    commands.stop()
    # The loop turns the force off at this time, also if Python does not run; a microsecond for rounding of seconds.
    assert started_ns - 1000 <= deadlines_ns[0] - 1e9 * heartbeat_s <= time.monotonic_ns() + 1000
    if not is_missed:
        assert events == ended == [] and reasons == [(UNREACHABLE_REASON, False)]
        return
    assert events == [(("fault", "commands"), {"message": "no memory"})]
    assert served[1] is None
    assert all(isinstance(error, SafetyStop) and "no memory" in str(error) for error in ended) and len(ended) == 1


@pytest.mark.parametrize("jump_s", [-3600.0, 3600.0])
def test_a_clock_that_is_set_back_loses_no_event_and_no_second(jump_s: float) -> None:
    records = np.zeros((5000, RECORD_SIZE))
    records[:, AT.tick] = np.arange(5000)
    records[:, AT.timestamp] = 1.7e9 + np.arange(5000) * 1e-3
    records[2500:, AT.timestamp] += jump_s
    touches = [100, 2400, 2501, 4000]
    records[touches, AT.contact_cause] = CAUSE_TOUCH
    records[touches, AT.contact_mode] = ROLLING
    events, health = RecordEvents(), HealthSummary()
    touch_events = [event for event in events.observe(records) if event["name"] == "touch"]
    assert [event["tick"] for event in touch_events] == touches
    seconds = health.add(records, 0)
    counted = sum(sum(second["modes"].values()) for second in seconds)
    assert counted == seconds[-1]["tick"] and counted >= 4000  # the last second may not be over


@pytest.mark.parametrize("gone", [True, False])
def test_a_disk_that_does_not_answer_is_an_error_and_blocks_no_request(gone, monkeypatch, tmp_path):
    """As on a network file system without a server; a file that is opened later is removed."""
    answered, open_file = threading.Event(), recordings.open_recording

    def hang(*names: Any) -> Any:
        answered.wait()
        if gone:
            raise OSError("gone")
        return open_file(*names)

    monkeypatch.setattr(recordings, "open_recording", hang)
    monkeypatch.setattr(recordings, "OPEN_S", 0.05)
    directory = SimpleNamespace(rig=SimpleNamespace(recording=SimpleNamespace(directory=tmp_path)))
    service = recordings.Recordings(directory, [""], print)
    with ends_within(60):
        with monkeypatch.context() as no_threads:
            no_threads.setattr(threading, "Thread", None)
            with pytest.raises(TypeError):
                service.begin("a.mcap", "a scene")
        for refusal in ("a.mcap: cannot be opened, because its disk", "a.mcap: cannot be opened, because the disk"):
            with pytest.raises(RecordingError, match=f"^{refusal}"):
                service.begin("a.mcap", "a scene")
        with pytest.raises(RecordingError, match="nothing is being recorded"):
            service.end()
        assert service.collect_totals() == RecorderState()
        service.stop()
    answered.set()
    until(lambda: not any(thread.name == "opening" for thread in threading.enumerate()))
    assert not list(tmp_path.iterdir())


def test_memory_in_swap_is_reported_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    events, status = [], tmp_path / "status"
    watch = SwapMonitor(lambda kind, name, message: events.append((kind, name, message)), status)
    for kilobytes in (0, 40, 80, 0, 12):
        status.write_text(f"Name:\tpython3\nVmStk:\t   132 kB\nVmSwap:\t   {kilobytes} kB\nThreads:\t3\n")
        watch.check()
    assert [(kind, name, message.split(":")[0]) for kind, name, message in events] == [
        ("fault", SWAPPED, f"{kilobytes} kB of the daemon are in swap") for kilobytes in (40, 12)
    ]
    assert caplog.text.count("softfinger doctor") == 2


def test_checks_continue_after_a_lack_of_files(monkeypatch: pytest.MonkeyPatch, root: Path) -> None:  # noqa: F811
    events: list[tuple[str, str, str]] = []

    def event(kind: str, name: str, message: str = "", device: str = "", **_: Any) -> None:
        events.append((kind, name, message or device))

    no_files, listdir = OSError(errno.EMFILE, "Too many open files"), os.listdir

    def refuse(*_: object) -> list[str]:
        raise no_files

    plug_usb(root, "1-1", "1451", "0402")
    status = root / "nothing"
    swap, usb = SwapMonitor(event, status), HotplugMonitor(event, root)
    swap._period_s = usb._period_s = 0.01
    monkeypatch.setattr(os, "listdir", refuse)
    for watch in (swap, usb):
        watch.start()
    until(lambda: len(events) == 3)
    monkeypatch.setattr(os, "listdir", listdir)
    plug_hid(root, 3, "0003:0000046D:0000C626")
    (root / "status").write_text("VmSwap:\t   12 kB\n")
    (root / "status").rename(status)
    until(lambda: len(events) == 5)
    for watch in (swap, usb):
        watch.stop()
    assert {(kind, name) for kind, name, _ in events[:3]} == {
        ("fault", SWAPPED), ("fault", "hotplug"), ("device", "present"),
    }  # fmt: skip
    assert sum("Too many open files; checked again" in message for *_, message in events[:3]) == 1
    assert {(kind, name) for kind, name, _ in events[3:]} == {("fault", SWAPPED), ("device", "attached")}


def test_the_metrics_wait_for_a_free_file(monkeypatch: pytest.MonkeyPatch) -> None:
    """A connection that cannot be accepted stays in the queue, so the server would retry without a pause."""
    acts: list[str] = []

    def refuse() -> None:
        acts.append("accept")
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(metrics_service.time, "sleep", lambda _: acts.append("pause"))
    with socket.create_server(("127.0.0.1", 0)) as listener:
        server: Any = metrics_service._Server(SimpleNamespace(listener=listener), None)
        server.socket = SimpleNamespace(accept=refuse, fileno=listener.fileno, gettimeout=listener.gettimeout)
        with socket.create_connection(listener.getsockname()):
            server.handle_request()
            server.handle_request()
    assert acts == ["accept", "pause"] * 2


def test_each_warning_is_reported_once(caplog: pytest.LogCaptureFixture) -> None:
    warning, events = [""], []
    device: Any = SimpleNamespace(info=SimpleNamespace(name="arm"), warning=lambda: warning[0])
    watch = DeviceWarningMonitor(lambda: [device], lambda kind, name, message: events.append((kind, name, message)))
    for words in ("", "hot", "hot", "hotter", "", "", "hot"):
        warning[0] = words
        watch.check()
    assert events == [("fault", DEVICE_WARNING, f"arm: {words}") for words in ("hot", "hotter", "hot")]
    assert caplog.text.count("arm: hot") == 3


def test_a_failing_check_is_published() -> None:
    messages = []
    DeviceWarningMonitor(list, lambda *_, message: messages.append(message)).handle_failure(ValueError("broken"))
    assert messages == ["warnings of devices are no longer reported: broken"]


DISARM = msgpack.packb({"command_id": "a", "method": "disarm"})


def test_clients_take_turns() -> None:
    queue = RequestQueue()
    for client, body in ((b"a", b"1"), (b"a", b""), (b"a", b"3"), (b"b", b"4")):
        assert queue.add(client, body, False)
    assert [queue.pop() for _ in range(len(queue))] == [(b"a", b"1"), (b"b", b"4"), (b"a", b""), (b"a", b"3")]
    assert not queue


@pytest.mark.parametrize(("count", "body"), [(QUEUED_MAX, b""), (1, bytes(QUEUED_BYTES_MAX))])
def test_a_full_queue_refuses_only_clients_that_have_requests_in_it(count: int, body: bytes) -> None:
    queue = RequestQueue()
    assert all(queue.add(b"a", body, False) for _ in range(count))
    assert not queue.add(b"a", b"", False) and not queue.add(b"b", b"", True)
    others = [bytes([1, number // 256, number % 256]) for number in range(1, CLIENTS_MAX)]
    assert all(queue.add(other, b"", False) for other in others) and not queue.add(b"b", b"", False)
    for _ in range(2):  # of the first client, which may have further ones, and of the second
        queue.pop()
    assert len(queue) == count + len(others) - 2 and queue.add(b"b", b"", False)


def test_a_request_that_turns_the_force_off_is_accepted_despite_a_flood() -> None:
    queue = RequestQueue()
    assert all(queue.add(b"a", b"", False) for _ in range(QUEUED_MAX))
    assert all(queue.add(b"a", DISARM, True) for _ in range(QUEUED_MAX)) and not queue.add(b"a", DISARM, False)
    assert queue.add(b"b", DISARM, True)


def test_a_refusal_has_the_id_of_its_request() -> None:
    def answered(body: bytes) -> str:
        answer = msgpack.unpackb(encode_busy(body))
        assert answer == {
            "command_id": answer["command_id"],
            "success": False,
            "result": {},
            "error": BUSY_MESSAGE,
        }
        return str(answer["command_id"])

    assert answered(DISARM) == "a"
    for body in (b"", b"\xc1", b"\x91" * 3000, msgpack.packb({"command_id": 1}), msgpack.packb({"a": 1})):
        assert answered(body) == ""
    assert answered(msgpack.packb({"command_id": 129 * "x"})) == ""
