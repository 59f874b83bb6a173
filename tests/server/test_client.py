"""Client against a real publisher and peers that send invalid messages; fixtures for other projects' tests."""

import copy
import gc
import os
import shutil
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import msgpack
import numpy as np
import pytest
import zmq
from helpers.encoder import contact_map
from helpers.programs import run_program
from helpers.telemetry_records import put, synthetic
from helpers.waits import WAIT_S

from softfinger.config.errors import ConfigError
from softfinger.proxy.record import AT, FIELDS
from softfinger.server.wire.client import SAMPLES_MAX, NoTelemetry, Window, subscribe
from softfinger.server.wire.protocol import MAX_BYTES, TOPICS, ProtocolError, encode
from softfinger.server.wire.publisher import Publisher

pytestmark = pytest.mark.real_time


@pytest.fixture
def publisher():
    with Publisher("tcp://127.0.0.1:*") as server:
        yield server


def join_subscription(publisher, topics=("contact",), timeout_s=30.0):
    """Return a subscription that already receives; a late one would miss earlier messages."""
    subscription = subscribe(publisher.endpoint, (*topics, "event"), timeout_s)
    while (sample := subscription.receive(0.02)) is None or sample.topic != "event":
        publisher.event("test", "joined")
    publisher.event("test", "all here")
    while (sample := next(subscription)).topic != "event" or sample["name"] != "all here":
        pass
    return subscription


def test_iterator_gives_typed_samples_in_order(publisher):
    records = synthetic(300)
    with join_subscription(publisher) as samples:
        publisher.publish(records)
        for record, sample in zip(records, samples, strict=False):
            assert (sample.topic, sample.lost) == ("contact", 0)
            for field in FIELDS:
                expected = tuple(record[field.at : field.at + field.size].tolist())
                place, _, key = field.name.partition(".")
                if place.startswith("contacts"):  # list with a message for each patch
                    value = getattr(sample["contacts"][int(place.removeprefix("contacts"))], key)
                else:
                    value = sample[field.name]
                assert value == (expected if field.size > 1 else expected[0])
            assert sample.contact.mode == sample["contact.mode"] == sample["contact"].mode
            assert type(sample.tick) is int


def test_other_topics_and_plain_maps(publisher):
    with join_subscription(publisher, ("contact", "health")) as samples:
        publisher.publish(synthetic(1001))
        publisher.event("fault", "device lost", message="unplugged", detail={"code": -1})
        received = [next(samples) for _ in range(1003)]
    health, event = received[-2], received[-1]
    assert (health.topic, event.topic, event.as_map()["kind"]) == ("health", "event", "fault")
    assert health.modes.free == health["modes.free"] == 1000
    assert health.as_map()["late"]["p50"] == health.late.p50
    assert event["message"] == event.message == "unplugged" and event["detail.code"] == -1
    assert msgpack.unpackb(encode(received[0].as_map())) == contact_map(synthetic(1)[0])


def test_a_sample_is_copied_and_has_no_unknown_key(publisher):
    with join_subscription(publisher) as samples:
        publisher.publish(synthetic(1))
        sample = next(samples)
    assert copy.deepcopy(sample) == sample
    with pytest.raises(KeyError, match=r"contact\.colour"):
        sample["contact.colour"]
    with pytest.raises(AttributeError, match="no key 'colour'"):
        _ = sample.colour


@pytest.mark.parametrize(
    ("every", "rows", "lost"),
    [
        (1, np.delete(synthetic(30), [10, 11, 12, 13, 14, 20], axis=0), {15: 5, 21: 1}),
        (5, np.delete(synthetic(101), slice(41, 56), axis=0), {60: 3}),
        (1, np.vstack([synthetic(5, first_tick=1000), synthetic(5)]), {}),
    ],
    ids=["gaps", "every fifth", "a restart"],
)
def test_lost_counts_published_ticks_only(every, rows, lost):
    with Publisher("tcp://127.0.0.1:*", every=every) as publisher, join_subscription(publisher) as samples:
        publisher.publish(rows)
        received = [next(samples) for _ in range(np.count_nonzero(rows[:, AT.tick] % every == 0))]
    assert {sample.tick: sample.lost for sample in received if sample.lost} == lost


def test_a_stalled_client_counts_its_losses_and_affects_no_other(tmp_path):
    count = 60_000  # more than publisher, kernel and client buffer together
    with (
        Publisher(f"ipc://{tmp_path}/telemetry", backlog=1000) as publisher,
        join_subscription(publisher) as samples,
        join_subscription(publisher) as reading,
    ):
        records, ticks = synthetic(500), []  # fewer than the backlog
        for first in range(0, count, len(records)):
            put(records, "tick", first + np.arange(len(records)))
            publisher.publish(records)
            ticks += [next(reading).tick for _ in range(len(records))]
        assert ticks == list(range(count))
        received = [next(samples)]
        while (sample := samples.receive(1.0)) is not None:  # until the backlog is read; then new messages arrive
            received.append(sample)
        publisher.publish(synthetic(1, first_tick=count))
        received.append(next(samples))
        received = [sample for sample in received if sample.topic == "contact"]
        lost = sum(sample.lost for sample in received)
        assert 1 <= publisher.figures.lost <= lost
    assert (received[0].tick, received[-1].tick) == (0, count) and len(received) + lost == count + 1


def test_missing_telemetry_raises_with_endpoint_and_remedy(publisher):
    with (
        subscribe(publisher.endpoint, timeout_s=0.05) as samples,
        pytest.raises(NoTelemetry, match=rf"no telemetry from {publisher.endpoint} within 0\.05 s: .*softfinger run"),
    ):
        next(samples)


def test_receive_returns_none_without_a_message(publisher):
    with subscribe(publisher.endpoint) as samples:
        assert samples.receive(0.0) is None
    with join_subscription(publisher) as samples:
        for wait_s in (1e9, None, 30.0):
            publisher.event("test", "here")
            assert samples.receive(wait_s)["name"] == "here" and samples.receive(0.0) is None
            assert samples.receive(-1.0) is None


class SignalReceived(Exception):
    """Raised by the signal handler."""


@pytest.mark.parametrize("wait_s", [None, 60.0])
def test_a_signal_ends_the_wait(publisher, wait_s):
    def ring(number, frame):
        raise SignalReceived

    before = signal.signal(signal.SIGALRM, ring)
    try:
        with join_subscription(publisher) as samples:
            signal.setitimer(signal.ITIMER_REAL, 0.2)
            with pytest.raises(SignalReceived):
                samples.receive(wait_s)
            publisher.event("test", "after")
            assert samples.receive(5.0)["name"] == "after"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def test_closed_subscription_ends_the_loop(publisher):
    samples = subscribe(publisher.endpoint)
    samples.close()
    samples.close()
    assert list(samples) == []


def test_a_deleted_subscription_closes_its_socket(publisher):
    """A warning of an unclosed socket would fail this test."""
    samples = join_subscription(publisher)
    publisher.publish(synthetic(2))
    next(samples)
    del samples
    gc.collect()


@pytest.mark.parametrize("endpoint", ["", "5555", "tcp://", "tcp:/127.0.0.1:5555", "carrier://pigeon"])
def test_malformed_endpoint_is_refused(endpoint):
    with pytest.raises(ConfigError, match=r"cannot connect to endpoint .*tcp://127\.0\.0\.1:5555"):
        subscribe(endpoint)


@pytest.mark.parametrize("topics", [(), ("contact", "contacts")])
def test_unknown_topics_are_refused(topics):
    with pytest.raises(ConfigError, match="choose from contact, event, health"):
        subscribe(topics=topics)


@pytest.mark.parametrize("samples", [0, SAMPLES_MAX + 1, 10.0])
def test_an_impossible_length_of_a_window_is_refused(samples):
    with pytest.raises(ConfigError, match=f"samples = {samples}: must be an integer from 1 to 1000000"):
        Window(samples=samples)


GOOD = contact_map(synthetic(1)[0])
EVENT = {"schema": 1, "timestamp": 1.0, "tick": 1, "kind": "test", "name": "x"}


@contextmanager
def subscribed_peer(topics):
    """Yield a plain publisher's socket and a client's subscription that it knows."""
    with zmq.Context() as context, context.socket(zmq.XPUB) as peer:
        peer.linger = 0
        port = peer.bind_to_random_port("tcp://127.0.0.1")
        with subscribe(f"tcp://127.0.0.1:{port}", topics, timeout_s=WAIT_S) as samples:
            for _ in topics:
                peer.recv()  # a subscription has arrived
            yield peer, samples


@pytest.mark.parametrize(
    ("frames", "says"),
    [
        ([b"contact"], "1 frames"),
        ([b"contact", encode(GOOD), b"more"], "3 frames"),
        ([b"contacts", encode(GOOD)], "unknown topic 'contacts'"),
        ([b"contact\xff", encode(GOOD)], "unknown topic"),
        ([b"contact", b""], "does not follow"),
        ([b"contact", b"\xc1"], "does not follow"),
        ([b"contact", b"hello"], "does not follow"),
        ([b"contact", encode(GOOD)[:-1]], "truncated"),
        ([b"contact", encode(GOOD) + b"\x00"], "trailing"),
        ([b"contact", b"\xdf\xff\xff\xff\xff"], "truncated"),
        ([b"contact", b"\x81\xa1x" + b"\x91" * 60000], "recursion"),
        ([b"contact", msgpack.packb({key: GOOD[key] for key in GOOD if key != "timestamp"})], "timestamp"),
        ([b"contact", msgpack.packb(GOOD | {"force": [1.0, 2.0]})], "force"),
        ([b"contact", msgpack.packb(GOOD | {"force": [1.0, 2.0, "3"]})], "force"),
        ([b"contact", msgpack.packb(GOOD | {"tick": 1.5})], "tick"),
        ([b"contact", msgpack.packb(GOOD | {"contact": 1})], "contact"),
        ([b"contact", msgpack.packb(GOOD | {"schema": 2})], "schema 2, this client understands 1"),
        ([b"contact", msgpack.packb({"schema": 2})], "schema 2, this client understands 1"),
        ([b"contact", b"\xc0" * (MAX_BYTES + 1)], "longer than the limit"),
        ([b"event", msgpack.packb(EVENT | {"kind": 3})], "kind"),
        ([b"event", b"\x86" + msgpack.packb(EVENT)[1:] + b"\xa1x\xdd\xff\xff\xff\xff"], "truncated"),
        ([b"event", b"\x86" + msgpack.packb(EVENT)[1:] + b"\x01\x02"], "does not follow"),
        ([b"event", b"\x86" + msgpack.packb(EVENT)[1:] + b"\xa1x" + b"\x91" * 60000 + b"\xc0"], "recursion"),
        ([b"health", msgpack.packb({"schema": 1, "timestamp": 1.0, "tick": 1})], "rate"),
    ],
)
def test_an_invalid_message_raises_and_the_next_is_read(frames, says):
    with subscribed_peer(TOPICS) as (peer, samples):
        peer.send_multipart(frames)
        peer.send_multipart([b"contact", msgpack.packb(GOOD | {"tick": 77})])
        with pytest.raises(ProtocolError, match=says):
            next(samples)
        assert next(samples).tick == 77


def test_integers_and_unknown_keys_are_accepted():
    message = GOOD | {"dt": 1, "force": [0, 0, 2], "colour": {"red": [1, 2]}}
    with subscribed_peer(["contact"]) as (peer, samples):
        peer.send_multipart([b"contact", msgpack.packb(message)])
        sample = next(samples)
    assert sample.force == (0.0, 0.0, 2.0) and type(sample.force[2]) is float


def fill_window(publisher, window):
    """Publish tick 0 until the window receives it: a window subscribes to contact messages only."""
    while not window.update(0.02):
        publisher.publish(synthetic(1))
    while window.update(0.05):
        pass


def test_window_has_the_last_ticks_in_order(publisher):
    records = synthetic(1000)
    with Window(publisher.endpoint, 64) as window:
        assert len(window) == 0 and window["force"].shape == (0, 3)
        fill_window(publisher, window)
        last = 0
        for at in range(1, 1000, 37):
            batch = records[at : at + 37]
            publisher.publish(batch)
            last += len(batch)
            while window["tick"][-1] < last:
                assert window.update(5.0) > 0
            newest = records[max(0, last - 63) : last + 1]
            for field in FIELDS:
                columns = newest[:, field.at : field.at + field.size]
                np.testing.assert_array_equal(window[field.name], columns if field.size > 1 else columns[:, 0])
        assert last == 999 and window["tick"].dtype == np.int64 and window.lost == 0


def test_window_counts_losses_and_resets_with_the_server(publisher):
    records = synthetic(50)
    with Window(publisher.endpoint, 100) as window:
        fill_window(publisher, window)
        publisher.publish(records[11:20])
        publisher.publish(records[25:])
        while len(window) < 35:
            assert window.update(5.0) > 0
        assert window.lost == 15
        publisher.publish(records[:3])
        while window["tick"][-1] != 2:
            assert window.update(5.0) > 0
        assert window["tick"].tolist() == [0, 1, 2]


def test_window_refuses_unknown_fields(publisher):
    with Window(publisher.endpoint, 1) as window, pytest.raises(KeyError, match=r"choose from timestamp, tick"):
        window["colour"]


EXAMPLE = Path(__file__).parents[2] / "examples" / "pytest"
LIGHT = """
import sys
before = set(sys.modules)
import softfinger.server.pytest_plugin
heavy = {"numpy", "numba", "zmq", "msgspec", "msgpack", "google", "mcap"} & (set(sys.modules) - before)
sys.exit(f"imported: {heavy}" if heavy else 0)
"""

DIES = """
def test_dies(softfinger_daemon):
    softfinger_daemon(recording="no-such-recording")

def test_is_killed(softfinger_daemon):
    daemon = softfinger_daemon(scene="frictionless-plane", recording="tap")
    daemon.process.kill()
    daemon.process.wait()

def test_asserts(softfinger_daemon):
    daemon = softfinger_daemon(scene="frictionless-plane", recording="tap")
    assert daemon.control.get_state().sequence < 0

def test_is_not_commanded(softfinger_daemon):
    daemon = softfinger_daemon(scene="frictionless-plane", recording="tap", words=["--commands", "off"])
    assert next(iter(daemon.subscribe())).tick >= 0
"""


def run_pytest(folder: Path) -> subprocess.CompletedProcess[str]:
    words = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-rA", str(folder)]
    with TemporaryDirectory(prefix="with spaces ") as runtime:  # commands use a socket in it
        environment = os.environ | {"XDG_RUNTIME_DIR": runtime}
        return run_program(words, cwd=folder, env=environment, timeout=600)


def test_the_plugin_imports_no_large_modules() -> None:
    """Every pytest in the environment loads the plugin, so it imports neither a compiler nor NumPy."""
    run_program([sys.executable, "-c", LIGHT], check=True)


@pytest.mark.exhaustive  # four daemons; `make test` has the fixture's passes and failures below
def test_the_example_project_passes(tmp_path: Path) -> None:
    project = tmp_path / "project"
    shutil.copytree(EXAMPLE, project, ignore=shutil.ignore_patterns("__pycache__"))
    completed = run_pytest(project)
    assert completed.returncode == 0, completed.stdout
    assert "4 passed" in completed.stdout


def test_a_failed_daemon_fails_the_test_with_its_log(tmp_path: Path) -> None:
    (tmp_path / "test_bad.py").write_text(DIES)
    completed = run_pytest(tmp_path)
    assert completed.returncode == 1
    assert "ended with exit code 3" in completed.stdout and "'no-such-recording' is neither a file" in completed.stdout
    assert "ERROR test_bad.py::test_is_killed - Failed: the daemon ended with exit code -9" in completed.stdout
    assert "FAILED test_bad.py::test_asserts" in completed.stdout
    assert "PASSED test_bad.py::test_is_not_commanded" in completed.stdout
    assert "softfinger's log" in completed.stdout and "INFO scene frictionless-plane" in completed.stdout
