"""Publisher over sockets: frames, values, events, health, endpoints, stalled subscribers; metrics."""

import json
import os
import re
import socket
import stat
import threading
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import msgpack
import numpy as np
import pytest
from helpers.daemons import subscribed
from helpers.encoder import contact_map
from helpers.pages import running
from helpers.telemetry_records import join, put, synthetic
from helpers.waits import until
from prometheus_client.parser import text_string_to_metric_families

from softfinger.config.errors import AddressInUse, ConfigError
from softfinger.proxy.record import AT, CAUSE_NAMES, MODE_NAMES, NAMED
from softfinger.server.app import Daemon
from softfinger.server.loop.guard import GUARD_NAMES
from softfinger.server.metrics.counts import FORCE_N, LATENESS_S, ROWS, STATUSES, MetricsCollector
from softfinger.server.metrics.service import make_dashboard
from softfinger.server.recording.recorder import RecorderState
from softfinger.server.recording.summary import summarize
from softfinger.server.socket_process.channel_messages import Figures
from softfinger.server.states import DaemonState
from softfinger.server.wire.client import Sample, record_of
from softfinger.server.wire.health import compute_work_of_hand
from softfinger.server.wire.protocol import decode, encode
from softfinger.server.wire.publisher import Publisher

pytestmark = pytest.mark.real_time


@pytest.fixture
def publisher():
    with Publisher("tcp://127.0.0.1:*", guard_names=("clamped", "slew")) as server:
        yield server


def receive(socket, count):
    """Return the maps of the next `count` messages."""
    messages = [socket.recv_multipart() for _ in range(count)]
    assert all(len(frames) == 2 for frames in messages)
    return [msgpack.unpackb(body) for _, body in messages]


def publish_and_receive(records, topic, count, **options):
    """Publish `records` in batches of 100; return the messages that a plain subscriber to `topic` receives."""
    with (
        Publisher("tcp://127.0.0.1:*", **options) as publisher,
        subscribed(publisher.endpoint, "contact", "event", "health") as socket,
    ):
        join(publisher, socket)
        for at in range(0, len(records), 100):
            publisher.publish(records[at : at + 100], drops=7)
        publisher.event("test", "end")
        received = []
        while not received or received[-1][0] != b"event" or received[-1][1]["kind"] != "test":
            frames = socket.recv_multipart()
            received.append((frames[0], msgpack.unpackb(frames[1])))
    maps = [message for name, message in received[:-1] if name == topic.encode()]
    assert len(maps) == count
    return maps


def test_missing_patches_are_omitted_and_restored():
    record = synthetic(1)[0]
    for i, number in enumerate((4, 2, -1)):
        record[NAMED[f"contacts{i}.object"].at] = number
    record[NAMED["contacts2.object"].at + 1 : NAMED["contact.torsion"].at] = 0.0
    body = encode(contact_map(record))
    assert [patch["object"] for patch in msgpack.unpackb(body)["contacts"]] == [4, 2]
    sample = Sample("contact", decode(b"contact", body), 0)
    assert record_of(sample) == record.tolist() and [patch.object for patch in sample["contacts"]] == [4, 2]


def test_transitions_become_events_with_cause_and_modes():
    story = [
        # tick, mode, cause, name, mode before
        (3, 1, "touch", "touch", 0),
        (5, 2, "drag", "slip", 1),
        (8, 1, "stop", "stick", 2),
        (9, 2, "theta_max", "slip", 1),
        (20, 1, "reverse", "stick", 2),
        (130, 0, "release", "release", 1),
    ]
    records = synthetic(150)
    for tick, mode, cause, _, _ in story:
        put(records[tick:], "contact.mode", mode)
        put(records[tick:], "contact.object", 4 if mode else -1)
        put(records[tick : tick + 1], "contact.cause", CAUSE_NAMES.index(cause))
    put(records[60:130], "contact.object", 0)  # the finger reaches another object while in contact
    events = publish_and_receive(records, "event", len(story), every=50)
    for event, (tick, mode, cause, name, before) in zip(events, story, strict=True):
        record = records[tick]
        vectors = {"force": record[AT.force : AT.force + 3], "point": record[AT.contact_point : AT.contact_point + 3]}
        assert event == {key: value.tolist() for key, value in vectors.items()} | {
            "schema": 1, "timestamp": record[AT.timestamp], "tick": tick, "kind": "contact", "name": name,
            "cause": cause, "from": before, "to": mode, "object": 4 if tick < 60 else 0, "finger": "",
            "normal_force": record[AT.contact_normal_force], "tangential_force": record[AT.contact_tangential_force],
        }  # fmt: skip


@pytest.mark.parametrize(
    ("field", "spans", "expected"),
    [
        ("servo.guard", [(100, 200, 1), (400, 410, 1), (150, 1000, 2), (700, 701, 8)],
         [(100, "guard", "clamped", 1), (150, "guard", "slew", 1), (400, "guard", "clamped", 1),
          (700, "guard", "bit 3", 1)]),
        # 150 rises, of which one tick in a hundred reports those since the last report
        ("servo.guard", [(tick, tick + 1, 1) for tick in range(100, 400, 2)],
         [(100, "guard", "clamped", 1), (200, "guard", "clamped", 50), (300, "guard", "clamped", 50),
          (400, "guard", "clamped", 49)]),
        ("servo.missed", [(100, 1000, 3), (110, 1000, 2), (120, 1000, 1), (500, 1000, 10)],
         [(100, "servo", "missed", 3), (200, "servo", "missed", 3), (500, "servo", "missed", 10)]),
    ],
    ids=["rising", "chattering", "missed"],
)  # fmt: skip
def test_events_of_guard_and_deadlines_are_limited_and_counted(field, spans, expected):
    records = synthetic(1000)
    values = np.zeros(1000, int)
    for first, last, value in spans:
        values[first:last] += value
    put(records, field, values)
    events = publish_and_receive(records, "event", len(expected), guard_names=("clamped", "slew"))
    assert [(e["tick"], e["kind"], e["name"], e["count"]) for e in events] == expected
    totals = np.cumsum([count for *_, count in expected]).tolist()
    assert field == "servo.guard" or [e["total"] for e in events] == totals


def test_health_sums_up_each_second():
    records = synthetic(2500, rate_hz=1000.0)
    mode = np.arange(2500) % 7 % 3
    put(records, "contact.mode", mode)
    put(records, "servo.late", np.random.default_rng(2).exponential(1e-5, 2500))
    put(records, "servo.missed", np.arange(2500) // 100)
    put(records[1200:], "servo.guard", 1)
    first, second = publish_and_receive(records, "health", 2)
    for health, ticks in ((first, slice(1, 1001)), (second, slice(1001, 2001))):
        rows = records[ticks]
        assert (health["tick"], health["timestamp"]) == (ticks.stop - 1, rows[-1, AT.timestamp])
        # an epoch time of 1.7e9 s resolves 2.4e-7 s
        assert health["rate"] == pytest.approx(1000.0, rel=1e-6)
        for name, at in (("late", AT.servo_late), ("exec", AT.servo_exec)):
            expected = np.percentile(rows[:, at], [50, 99, 99.9, 100])
            assert list(health[name].items()) == list(zip(("p50", "p99", "p999", "max"), expected, strict=True))
        counts = np.bincount(mode[ticks], minlength=3)
        assert health["modes"] == {"free": counts[0], "rolling": counts[1], "sliding": counts[2]}
        assert (health["missed"], health["drops"]) == ((ticks.stop - 1) // 100, 7)
    assert (first["guarded"], second["guarded"]) == (0, 801)


def test_health_energy_is_the_work_of_the_hand():
    records = synthetic(2001, rate_hz=1000.0)
    put(records, "force", [0.0, 0.0, 2.0])
    put(records, "torque", 0.0)
    put(records, "probe.orientation", [1.0, 0.0, 0.0, 0.0])
    position = np.zeros((2001, 3))
    position[:, 2] = -0.03 * np.arange(2001) / 1000.0  # pressed down at 30 mm/s against 2 N: 0.06 W
    put(records, "probe.position", position)
    first, second = publish_and_receive(records, "health", 2)
    # 1000 sums of terms rounded to 1e-16 relative
    energies = [first["energy"], second["energy"], second["energy_total"]]
    assert energies == pytest.approx([0.06, 0.06, 0.12], rel=1e-12)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_work_of_a_torque_is_torque_times_angle(sign):
    axis = np.array([0.6, 0.0, 0.8])
    angle = np.linspace(0.0, 0.5, 101)
    start = np.array([0.5, 0.5, -0.5, 0.5])
    turned = []
    for i, half in enumerate(angle / 2.0):
        w, v = np.cos(half), np.sin(half) * axis
        product = [w * start[0] - v @ start[1:], *(w * start[1:] + start[0] * v + np.cross(v, start[1:]))]
        turned.append(np.array(product) * (sign if i % 2 else 1.0))
    records = synthetic(101)
    put(records, "force", 0.0)
    put(records, "torque", -0.1 * axis)
    put(records, "probe.orientation", np.array(turned))
    # 100 angles of 5 mrad, each from an atan2 of rounded products
    assert compute_work_of_hand(records) == pytest.approx(0.05, rel=1e-10)


def test_unusable_records_do_no_work():
    records = synthetic(4)
    put(records, "force", [1.0, 0.0, 0.0])
    put(records, "torque", 0.0)
    put(records, "probe.orientation", [1.0, 0.0, 0.0, 0.0])
    put(records, "probe.position", [[0, 0, 0], [-1, 0, 0], [np.nan, 0, 0], [5, 0, 0]])
    assert compute_work_of_hand(records) == 1.0


def test_events_from_other_threads_do_not_mix_with_ticks(publisher):
    threads = [
        threading.Thread(target=lambda n=n: [publisher.event("test", str(n), index=i) for i in range(200)])
        for n in range(4)
    ]
    with subscribed(publisher.endpoint, "contact", "event") as socket:
        join(publisher, socket)
        for thread in threads:
            thread.start()
        for record in synthetic(500):
            publisher.publish(record[None])
        for thread in threads:
            thread.join()
        maps = receive(socket, 1300)
    assert [m["tick"] for m in maps if "dt" in m] == list(range(500))
    for n in range(4):
        assert [m["index"] for m in maps if m.get("name") == str(n)] == list(range(200))


def test_last_event_before_close_arrives(publisher):
    with subscribed(publisher.endpoint, "event") as socket:
        join(publisher, socket)
        publisher.publish(synthetic(10))
        publisher.event("lifecycle", "stopped", message="asked to")
        publisher.close()
        publisher.close()
        publisher.event("lifecycle", "after", message="nobody hears this")
        publisher.publish(synthetic(1))
        (event,) = receive(socket, 1)
        assert not socket.poll(50)
    assert (event["kind"], event["name"], event["tick"], event["message"]) == ("lifecycle", "stopped", 9, "asked to")


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1", "127.8.9.1"])
def test_a_wildcard_port_is_resolved(host):
    with Publisher(f"tcp://{host}:*") as publisher:
        assert int(publisher.endpoint.rpartition(":")[2]) > 0


REFUSED = {
    "CURVE keys": "tcp://*:5555 tcp://0.0.0.0:5555 tcp://192.168.1.7:5555 tcp://[::]:5555 tcp://eth0:5555",
    "is not an endpoint": "5555 tcp://127.0.0.1 tcp://127.0.0.1:99999 tcp://:5555 udp://127.0.0.1:5555 ipc:// inproc://x",
    "has no file": "ipc://@telemetry ipc://*",
    "nowhere": "ipc:///nowhere/telemetry",
}


@pytest.mark.parametrize(("endpoint", "words"), [(word, why) for why, text in REFUSED.items() for word in text.split()])
def test_an_endpoint_is_refused_with_its_reason(endpoint, words):
    with pytest.raises(ConfigError, match=words):
        Publisher(endpoint)


def test_ipc_socket_is_for_user_and_group(tmp_path):
    mask = os.umask(0o022)
    try:
        with Publisher(f"ipc://{tmp_path}/telemetry"):
            assert stat.S_IMODE((tmp_path / "telemetry").stat().st_mode) == 0o660
        assert os.umask(0o022) == 0o022
    finally:
        os.umask(mask)


def test_a_plain_file_at_an_ipc_path_is_unchanged(tmp_path):
    path = tmp_path / "notes.txt"
    path.write_text("mine")
    with pytest.raises(ConfigError, match="is not a socket"):
        Publisher(f"ipc://{path}")
    assert path.read_text() == "mine"


@pytest.mark.parametrize("planted", ["telemetry", "telemetry.lock"])
def test_link_at_an_ipc_path_is_not_followed(planted, tmp_path):
    (tmp_path / planted).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ConfigError, match=r"telemetry"):
        Publisher(f"ipc://{tmp_path}/telemetry")
    assert not (tmp_path / "elsewhere").exists()


UNITS = ("seconds", "newtons", "info", "total")
COUNTED = re.compile(r"softfinger_[a-z_]+")


def index_samples(families) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in families
        for sample in family.samples
    }


@pytest.mark.parametrize("batch", [1, 300, 5000])
def test_figures_equal_those_computed_from_records(batch: int) -> None:
    count, random = 2 * ROWS + 77, np.random.default_rng(5)
    fingers = [synthetic(count, seed=seed) for seed in (1, 2)]
    for rows in fingers:
        put(rows, "contact.mode", random.integers(0, 3, count))
        put(rows, "servo.guard", random.integers(0, 1 << len(GUARD_NAMES), count))
        put(rows, "servo.device", random.choice([0, *STATUSES], count))
        put(rows, "dt", 0.125)
    late = random.exponential(1e-4, count)
    put(fingers[0], "servo.late", late)
    put(fingers[0], "servo.missed", np.arange(count))
    recorded = RecorderState(6, 8, 7, "", True, 9, 0.25)
    names, figures = ["thumb", "index"], (Figures(3, 4, 5), 6)
    counts = MetricsCollector(names, lambda: figures, lambda: recorded, lambda: DaemonState.ARMED)
    together = np.concatenate(fingers, axis=1)
    for start in range(0, count, batch):
        counts.add_records(together[start : start + batch], 9)
    stats = index_samples(counts.collect())
    totals = {
        "ticks_total": count, "deadlines_missed_total": count - 1, "records_dropped_total": 9, "subscribers": 3,
        "messages_lost_total": 4, "connections_refused_total": 5, "recorded_ticks_total": 6, "recorded_bytes_total": 7,
        "unrecorded_ticks_total": 8, "unrecorded_events_total": 9, "recording_worst_write_seconds": 0.25,
    }  # fmt: skip
    assert {name: stats[f"softfinger_{name}", ()] for name in totals} == totals
    for end in LATENESS_S:
        assert stats["softfinger_lateness_seconds_bucket", (("le", f"{end:g}"),)] == np.count_nonzero(late <= end)
    for name, rows in zip(("thumb", "index"), fingers, strict=True):
        label, norm = ("finger", name), np.linalg.norm(rows[:, AT.force : AT.force + 3], axis=1)
        for end in FORCE_N:
            key = (label, ("le", f"{end:g}"))
            assert stats["softfinger_force_newtons_bucket", key] == np.count_nonzero(norm <= end)
        for number, mode in enumerate(MODE_NAMES):
            spent = 0.125 * np.count_nonzero(rows[:, AT.contact_mode] == number)
            assert stats["softfinger_mode_seconds_total", (label, ("mode", mode))] == spent
        for bit, cause in enumerate(GUARD_NAMES):
            ticks = np.count_nonzero(rows[:, AT.servo_guard].astype(int) >> bit & 1)
            assert stats["softfinger_guarded_ticks_total", (("cause", cause), label)] == ticks
        for status, text in STATUSES.items():
            ticks = np.count_nonzero(rows[:, AT.servo_device] == status)
            assert stats["softfinger_device_errors_total", (label, ("status", text))] == ticks


def scrape(daemon: Daemon) -> dict:
    with urllib.request.urlopen(f"{daemon.metrics_endpoint}/metrics", timeout=60.0) as answer:
        return index_samples(text_string_to_metric_families(answer.read().decode()))


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    changes = {"metrics__endpoint": "127.0.0.1:0", "recording__directory": str(tmp_path_factory.mktemp("recordings"))}
    with running("replay", "paper-plane", **changes) as daemon:
        yield daemon


def test_a_running_daemon_is_scraped(daemon: Daemon) -> None:
    host, port = daemon.metrics_endpoint.removeprefix("http://").split(":")
    with socket.create_connection((host, int(port))):
        first = scrape(daemon)["softfinger_ticks_total", ()]
        until(lambda: scrape(daemon)["softfinger_ticks_total", ()] > first)
    stats = scrape(daemon)
    assert stats["softfinger_execution_seconds_count", ()] == stats["softfinger_ticks_total", ()]
    modes = sum(value for (name, _), value in stats.items() if name == "softfinger_mode_seconds_total")
    # Ticks of a recording are a period each; rounding of sums of thousands.
    assert modes == pytest.approx(1e-3 * stats["softfinger_ticks_total", ()], rel=1e-9)
    with (
        pytest.raises(AddressInUse, match=r"\[metrics\] endpoint"),
        running("replay", "paper-plane", metrics__endpoint=f"{host}:{port}"),
    ):
        pass


def test_recordings_add_up(daemon: Daemon) -> None:
    files = [Path(daemon.rendering.rig.recording.directory) / name for name in ("first.mcap", "second.mcap")]
    for file in files:
        before = scrape(daemon)["softfinger_recorded_ticks_total", ()]
        daemon.recordings.begin(file.name, "paper-plane")
        until(lambda before=before: scrape(daemon)["softfinger_recorded_ticks_total", ()] > before)
        daemon.recordings.end()
    until(lambda: daemon.recordings.collect_totals().bytes >= sum(file.stat().st_size for file in files))
    stats = scrape(daemon)
    assert stats["softfinger_recorded_bytes_total", ()] == sum(file.stat().st_size for file in files)
    assert stats["softfinger_recorded_ticks_total", ()] == sum(summarize(file)["ticks"] for file in files)
    assert stats["softfinger_unrecorded_ticks_total", ()] == stats["softfinger_unrecorded_events_total", ()] == 0
    assert stats["softfinger_recording_worst_write_seconds", ()] > 0.0


def strip_endings(names: set[str]) -> set[str]:
    return {re.sub("_(bucket|sum|count)$", "", name) for name in names}


def test_the_dashboard_uses_all_metrics(daemon: Daemon) -> None:
    with urllib.request.urlopen(f"{daemon.metrics_endpoint}/dashboard.json", timeout=60.0) as answer:
        board = json.load(answer)
    assert board == make_dashboard()
    queries = [target["expr"] for panel in board["panels"] for target in panel["targets"]]
    queried = {name for query in queries for name in COUNTED.findall(query)}
    published = {name for name, _ in scrape(daemon)}
    assert queried <= published and strip_endings(published) == strip_endings(queried)


def test_names_follow_prometheus_rules_and_are_on_the_page() -> None:
    page = (Path(__file__).parents[2] / "docs" / "operate" / "metrics.md").read_text("utf-8")
    rows = {row[0]: set(re.findall(r"`(\w+)`", row[1])) for row in re.findall(r"^\| `(\w+)` \| (.*?) \|", page, re.M)}
    stats: dict[str, set[str]] = {}
    for family in MetricsCollector([""], lambda: (Figures(), 0), RecorderState, lambda: DaemonState.READY).collect():
        for sample in family.samples:
            name = re.sub("_(bucket|sum|count)$", "", sample.name)
            assert name.endswith(UNITS) or name in ("softfinger_subscribers", "softfinger_state"), name
            stats.setdefault(name, set()).update(sample.labels.keys() - {"le"})
    assert rows == stats
