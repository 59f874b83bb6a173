"""Data sent to Foxglove and Rerun, read back with their libraries; without a library, one line names the package."""

import json
import struct
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from helpers.called import called, read_stdout
from helpers.recorded import event, recorded, run
from helpers.waits import repeated
from mcap.reader import make_reader
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from softfinger.config.errors import AddressInUse, ConfigError
from softfinger.config.load import describe, load_scene
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.proxy.records import Records
from softfinger.server.bridges import foxglove
from softfinger.server.bridges.rerun import RerunSink
from softfinger.server.recording import picture
from softfinger.server.recording.reader import RecordedWorld, read_contents
from softfinger.server.recording.schemas import FRAME, SCENE, TICK, make_message_class
from softfinger.server.recording.writer import RecordingFile, Topics

WHY = "`make setup` does not install this package, which is larger than softfinger: see docs/operate/bridges.md"


class Viewer(AbstractContextManager[Any]):
    """Client of Foxglove's protocol (https://github.com/foxglove/ws-protocol) that subscribes to every topic."""

    def __init__(self, port: int) -> None:
        self.topics: dict[str, dict[str, Any]] = {}
        self._subscribed: dict[int, str] = {}
        self._socket = connect(
            f"ws://127.0.0.1:{port}", subprotocols=[Subprotocol("foxglove.sdk.v1")], max_size=None, proxy=None
        )

    def messages(self) -> Iterator[tuple[str, int, bytes]]:
        """Return topic, time (ns) and data of each message."""
        while True:
            data = self._socket.recv(timeout=60.0)
            if isinstance(data, str):
                message = json.loads(data)
                if message["op"] == "advertise":
                    self._subscribe(message["channels"])
            elif data[0] == 1:
                number, time_ns = struct.unpack_from("<IQ", data, 1)
                yield self._subscribed[number], time_ns, data[13:]

    def _subscribe(self, channels: list[dict[str, Any]]) -> None:
        wanted = []
        for channel in channels:
            self.topics[channel["topic"]] = channel
            self._subscribed[channel["id"]] = channel["topic"]
            wanted.append({"id": channel["id"], "channelId": channel["id"]})
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def __exit__(self, *_: object) -> None:
        self._socket.close()


@pytest.fixture
def sample() -> Records:
    records = Records(run())
    return records[np.argmax(records["force"][:, 2])]


def set_force(record: Records, force: Any) -> Records:
    changed = record.copy()
    changed["force"][:] = force
    return changed


def read_arrow(data: bytes) -> tuple[Any, np.ndarray]:
    """Return the arrow of a SceneUpdate and its direction: Foxglove draws arrows along x."""
    (entity,) = make_message_class(SCENE).FromString(data).entities
    (arrow,) = entity.arrows
    w, x, y, z = (getattr(arrow.pose.orientation, axis) for axis in "wxyz")
    assert w * w + x * x + y * y + z * z == pytest.approx(1.0, abs=1e-9)  # rounding of a square root
    return arrow, np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])


@pytest.mark.parametrize(
    "direction", [(0, 0, 1), (0, -1, 0), (1, 0, 0), (-1, 0, 0), (-0.6, 0.0, 0.8), (0.36, -0.48, 0.8)]
)
def test_the_arrow_of_a_force(direction: tuple[float, ...], sample: Records) -> None:
    arrow, points = read_arrow(picture.encode_force(set_force(sample, 1.5 * np.array(direction)), 0, ""))
    np.testing.assert_allclose(points, direction, atol=1e-9)  # rounding
    assert arrow.shaft_length + arrow.head_length == pytest.approx(0.03, rel=1e-12)
    place = arrow.pose.position
    assert (place.x, place.y, place.z) == tuple(sample["proxy.position"])
    (deletion,) = make_message_class(SCENE).FromString(picture.encode_force(set_force(sample, 0.0), 0, "")).deletions
    assert deletion.id == "fingertip/force"


@pytest.mark.parametrize(("viewer", "library"), [("rerun", "rerun"), ("foxglove", "foxglove")])
def test_a_missing_library_is_named(viewer: str, library: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    result = called("bridge", viewer)
    assert result.returncode == ConfigError.exit_code and f"pip install 'softfinger[{viewer}]'" in result.stderr


def read_batches(file: Path) -> dict[str, list[Any]]:
    chunk = pytest.importorskip("rerun.chunk", reason=WHY)
    batches: dict[str, list[Any]] = {}
    for part in chunk.RrdReader(str(file)).stream():
        batches.setdefault(part.entity_path, []).append(part.to_record_batch())
    return batches


def values(batches: list[Any], ending: str) -> np.ndarray:
    named = [(batch, name) for batch in batches for name in batch.schema.names if name.endswith(ending)]
    return np.array([row for batch, name in named for row in batch.column(name).to_pylist()])


def test_rerun_shows_every_tick_of_a_recording(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason=WHY)
    mark = event("mark", "mark", 100, message="now")
    trial, out = recorded(tmp_path / "trial.mcap", run(), [mark]), tmp_path / "trial.rrd"
    read_stdout("bridge", "rerun", str(trial), "--save", str(out))
    batches, records = read_batches(out), Records(run())
    assert {"/world/fingertip", "/world/proxy", "/world/force", "/events", "/plots/contact.mode"} <= set(batches)
    assert any(path.startswith("/world/objects/table/") for path in batches)
    force = values(batches["/plots/force"], "Scalars:scalars")
    np.testing.assert_array_equal(force, records["force"])
    ticks = values(batches["/plots/force"], "tick")
    np.testing.assert_array_equal(ticks, records["tick"])
    shown, _ = picture.select_displayed(run(), np.nan)
    arrows = values(batches["/world/force"], "Arrows3D:vectors")[:, 0]
    # Rerun stores geometry in single precision.
    np.testing.assert_allclose(arrows, 0.02 * records[shown]["force"], rtol=1e-6, atol=1e-9)
    turns = values(batches["/world/fingertip"], "Transform3D:quaternion")[:, 0]
    np.testing.assert_allclose(turns[:, [3, 0, 1, 2]], records[shown]["probe.orientation"], atol=1e-6)


@pytest.mark.parametrize("words", [("--save", "no/such/folder/x.rrd"), ("--connect", "nowhere")])
def test_rerun_errors_are_reported_in_one_line(words: tuple[str, str]) -> None:
    pytest.importorskip("rerun", reason=WHY)
    result = called("bridge", "rerun", *words)
    assert result.returncode == ConfigError.exit_code and f"{' '.join(words)}: Rerun reports: " in result.stderr


def test_rerun_shows_a_running_daemon(tmp_path: Path, endpoints: tuple[str, str]) -> None:
    pytest.importorskip("rerun", reason=WHY)
    out = tmp_path / "live.rrd"
    words = ["--endpoint", endpoints[0], "--commands", endpoints[1], "--timeout", "60"]
    read_stdout("bridge", "rerun", *words, "--save", str(out), "--duration", "0.5")
    batches = read_batches(out)
    assert any(path.startswith("/world/objects/table/") for path in batches)
    ticks = values(batches["/plots/force"], "tick")
    assert len(ticks) > 100 and (np.diff(ticks) > 0).all()


def test_foxglove_has_the_topics_of_a_recording() -> None:
    pytest.importorskip("foxglove", reason=WHY)
    records, server = run(), foxglove.Server(0)
    try:
        shown = Topics(server, [""], load_scene("paper-plane"))
        with Viewer(int(server.url.rpartition(":")[2])) as viewer:
            shown.event(event("lifecycle", "started", 0))
            came: dict[str, tuple[int, bytes]] = {}
            with send_repeatedly(shown, records[:300]):
                for topic, time_ns, data in viewer.messages():
                    came[topic] = time_ns, data
                    if {"contact", "pose", "tf", "forces", "scene"} <= set(came):
                        break
    finally:
        server.close()
    assert {"contact", "pose", "tf", "forces", "scene", "event"} <= set(viewer.topics)
    assert viewer.topics["contact"]["schemaName"] == TICK
    time_ns, data = came["contact"]
    tick = make_message_class(TICK).FromString(data)
    row = Records(records)[tick.tick]
    assert list(tick.force) == row["force"].tolist() and time_ns == round(tick.timestamp * 1e9)


def send_repeatedly(shown: Topics, records: np.ndarray) -> AbstractContextManager[None]:
    """Send from another thread repeatedly, because a subscription takes effect with a delay."""
    later = records.copy()

    def send() -> None:
        shown.ticks(later)
        later[:, AT.timestamp] += 1.0  # so that the scene is due again

    return repeated(send)


def test_a_port_in_use_raises_an_error_with_advice() -> None:
    pytest.importorskip("foxglove", reason=WHY)
    first = foxglove.Server(0)
    try:
        with pytest.raises(AddressInUse, match="--port 0"):
            foxglove.Server(int(first.url.rpartition(":")[2]))
    finally:
        first.close()


def record_lift(path: Path) -> tuple[Path, dict[str, Any]]:
    box = {"name": "box", "position": [0.0, 0.0, 0.12], "orientation": [0.0, 0.0, 0.0, 1.0]}
    world = {"schema": 1, "timestamp": 1.7e9, "tick": 7, "bodies": [box | {"velocity": [0.0] * 3, "rate": [0.0] * 3}]}
    row = np.zeros((1, RECORD_SIZE))
    row[:, AT.timestamp], row[:, AT.probe_orientation] = 1.7e9, 1.0
    about = {"scene": describe(load_scene("lift-a-box"))}
    recording = RecordingFile(path.open("wb", buffering=0), ("thumb", "index"), about)
    for finger in ("thumb", "index"):
        recording.ticks(row, finger)
    recording.message("world", world)
    recording.close()
    return path, world


def test_bodies_are_recorded_and_their_objects_drawn_in_their_frames(tmp_path: Path) -> None:
    path, world = record_lift(tmp_path / "lift.mcap")
    assert [part.world for part in read_contents(path) if isinstance(part, RecordedWorld)] == [world]
    frames, entities = {}, {}
    with path.open("rb") as file:
        for schema, _, message in make_reader(file).iter_messages():
            if schema.name == FRAME:
                frame = make_message_class(FRAME).FromString(message.data)
                frames[frame.child_frame_id] = frame
            elif schema.name == SCENE:
                update = make_message_class(SCENE).FromString(message.data)
                entities |= {entity.id: entity.frame_id for entity in update.entities}
    assert (frames["body/box"].parent_frame_id, frames["body/box"].translation.z) == ("world", 0.12)
    assert (frames["body/box"].rotation.w, frames["body/box"].rotation.z) == (0.0, 1.0)
    assert (entities["box"], entities["floor"]) == ("body/box", "world")


def test_rerun_draws_a_height_map_as_triangles(monkeypatch: pytest.MonkeyPatch) -> None:
    library = Mock()
    monkeypatch.setitem(sys.modules, "rerun", library)
    RerunSink(Mock(), [], load_scene("heightmap"))
    drawn = library.Mesh3D.call_args.kwargs
    points, triangles = np.array(drawn["vertex_positions"]), drawn["triangle_indices"]
    assert points.shape[1] == 3 and triangles.shape[1] == 3 and np.unique(triangles).tolist() == [*range(len(points))]


def test_rerun_moves_objects_with_their_body(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason=WHY)
    path, _ = record_lift(tmp_path / "lift.mcap")
    read_stdout("bridge", "rerun", str(path), "--save", str(tmp_path / "lift.rrd"))
    batches = read_batches(tmp_path / "lift.rrd")
    place = values(batches["/world/bodies/box"], "Transform3D:translation")
    np.testing.assert_allclose(place.reshape(-1), [0.0, 0.0, 0.12], rtol=1e-6)  # single precision
    assert any(name.startswith("/world/bodies/box/box/") for name in batches)
    assert any(name.startswith("/world/objects/floor/") for name in batches)
