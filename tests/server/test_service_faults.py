"""Failing services and a clock that is set: the run continues, or ends with a specific error."""

from __future__ import annotations

import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from helpers.waits import ends_within

from softfinger.config.errors import RecordingError, SafetyStop
from softfinger.proxy.record import AT, CAUSE_TOUCH, RECORD_SIZE, ROLLING
from softfinger.server.metrics.counts import MetricsCollector
from softfinger.server.metrics.service import MetricsService
from softfinger.server.recording.recorder import RecorderState
from softfinger.server.services import recordings
from softfinger.server.services.commands import CommandService
from softfinger.server.services.scene_topics import WorldState
from softfinger.server.services.watches import HotplugWatch
from softfinger.server.socket_process.setup import Figures
from softfinger.server.states import DaemonState
from softfinger.server.wire.events import RecordEvents
from softfinger.server.wire.health import HealthSummary

pytestmark = pytest.mark.plain

WAIT_S = 20.0


class BrokenSource:
    def __getattr__(self, name: str) -> Any:
        raise OSError(f"{name} is gone")


@pytest.mark.parametrize("name", ["hotplug", "metrics", "world"])
def test_a_failed_service_is_reported_and_ends_nothing(name: str) -> None:
    events: list[tuple[str, str, str]] = []
    came = threading.Event()

    def event(kind: str, fault_name: str, message: str) -> None:
        events.append((kind, fault_name, message))
        came.set()

    broken = cast(Any, BrokenSource())
    if name == "metrics":
        counts = MetricsCollector(
            [""],
            lambda: (Figures(), 0),
            lambda: RecorderState(),
            lambda: DaemonState.READY,
        )
        bound = SimpleNamespace(
            endpoint="tcp://127.0.0.1:1", listener=broken, files=SimpleNamespace(close=lambda: None)
        )
        service: Any = MetricsService(cast(Any, bound), counts, event)
    else:
        service = HotplugWatch(broken, event) if name == "hotplug" else WorldState(broken, print, event)
    service.start()
    assert came.wait(WAIT_S)
    service.stop()
    ((kind, fault_name, message),) = events
    assert (kind, fault_name) == ("fault", name) and "is gone" in message


def test_commands_that_fail_end_a_run_that_needs_heartbeats() -> None:
    events: list[Any] = []
    ended: list[Exception] = []
    served: list[Any] = []

    class Failing:
        is_reachable = True

        def end_at(self, time_ns: int) -> None: ...

        def is_inhibited_by(self, why: str) -> bool:
            raise OSError("no memory")

    rig = SimpleNamespace(commands=SimpleNamespace(heartbeat_s=-1.0))  # missed immediately
    rendering = SimpleNamespace(rig=rig, force=Failing())
    actions = SimpleNamespace(
        replace=print,
        publisher=SimpleNamespace(set_preparing=print, serve=served.append),
        fail=ended.append,
        event=lambda *words, **more: events.append((words, more)),
    )
    commands = CommandService("ipc:///nowhere", cast(Any, rendering), cast(Any, actions), "a scene")
    commands.start()
    served[0].each_period()
    commands.stop()
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


def test_a_recording_that_is_still_being_opened_is_one_error_at_the_end(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """As on a network file system without a server."""
    opening, answered = threading.Event(), threading.Event()

    def hang(*_: object) -> None:
        opening.set()
        answered.wait()
        raise OSError("gone")

    monkeypatch.setattr(recordings, "open_recording", hang)
    monkeypatch.setattr(recordings, "CLOSE_S", 0.05)
    service = recordings.Recordings(cast(Any, None), [""], print)
    path = tmp_path / "a.mcap"

    def record() -> None:
        with pytest.raises(RecordingError, match="gone"):
            service.record(path, "a scene")

    client = threading.Thread(target=record)
    client.start()
    assert opening.wait(WAIT_S)
    with ends_within(60), pytest.raises(RecordingError, match=rf"^{path}: cannot be opened, because its disk"):
        service.stop()
    answered.set()
    client.join()
    service.stop()
