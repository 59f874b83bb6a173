"""Contents of recordings, from files and from a daemon, read by softfinger and by other libraries."""

from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2
from helpers.recorded import about, event, recorded, run
from helpers.waits import WAIT_S, eventually
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from test_recorder import quiet_rig, read

from softfinger.config.errors import CommandRefused, RecordingError
from softfinger.config.load import load_scene
from softfinger.drivers.poses import load_poses
from softfinger.drivers.resample import resample
from softfinger.proxy.record import AT, FIELDS
from softfinger.server import cli
from softfinger.server.app import Daemon
from softfinger.server.recording import schemas
from softfinger.server.recording.mcapfile import INDEX_MEMORY_BYTES, McapFile
from softfinger.server.recording.reader import TickBlock, read_contents
from softfinger.server.recording.summary import summarize
from softfinger.server.wire.control import Control
from softfinger.server.wire.protocol import EVENT_EXTRA_KEYS

pytestmark = pytest.mark.real_time


def test_other_readers_find_everything(tmp_path: Path) -> None:
    touch = {"cause": "touch", "from": 0, "to": 1, "object": 0, "finger": ""}
    touch |= {"force": [0.0, 0.0, 1.0], "point": [0.0, 0.0, 0.0], "normal_force": 1.0, "tangential_force": 0.0}
    mark = event("mark", "mark", 9, command_id="a", label="trial 7", data={"hand": "left"})
    path = recorded(tmp_path / "a.mcap", run(), [event("contact", "touch", 5, **touch), mark])
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary_ = reader.get_summary()
        assert reader.get_header().library == f"softfinger {version('softfinger')}"
        assert summary_.statistics.chunk_count > 5  # 64 KiB each
        messages: dict[str, list[Any]] = {}
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            assert schema is not None and message.log_time >= 10**18 and channel.message_encoding == "protobuf"
            messages.setdefault(channel.topic, []).append(decoded)
            assert channel.topic != "contact" or message.log_time == round(decoded.timestamp * 1e9)
        assert {metadata.name for metadata in reader.iter_metadata()} >= {"scene", "rig", "scene_name"}
    assert len(messages["contact"]) == len(run()) == summary_.statistics.channel_message_counts[1]
    for row in (0, 400, len(run()) - 1):
        for field in FIELDS:
            value = messages["contact"][row]
            for name in field.name.split("."):
                value = getattr(value, name)
            np.testing.assert_array_equal(np.reshape(value, -1), run()[row, field.at : field.at + field.size])
            assert field.kind == "float" or isinstance(value, int)
    first = messages["event"][0]
    assert (first.cause, first.to, list(first.force)) == ("touch", 1, [0, 0, 1])
    assert (messages["mark"][0].label, messages["mark"][0].more) == ("trial 7", '{"data": {"hand": "left"}}')
    pose = messages["pose"][-1]
    stamped = pose.timestamp.seconds + 1e-9 * pose.timestamp.nanos
    row = int(np.argmin(np.abs(run()[:, AT.timestamp] - stamped)))
    assert (pose.frame_id, pose.pose.position.z) == ("world", run()[row, AT.probe_position + 2])
    assert pose.pose.orientation.w == run()[row, AT.probe_orientation]
    assert {frame.child_frame_id for frame in messages["tf"]} == {"fingertip", "proxy"}
    assert messages["tf"][-1].translation.z == run()[row, AT.proxy_position + 2]
    (entities,) = {tuple(entity.id for entity in scene.entities) for scene in messages["scene"]}
    assert entities == ("table", "proxy")
    assert messages["scene"][0].entities[1].spheres[0].size.x == 0.02
    # One picture per sixtieth of a second, at the first tick in it.
    assert len(messages["pose"]) == len(np.unique(np.floor(run()[:, AT.timestamp] * 60.0)))


NUMBERS = {
    schemas.POSE: {"timestamp": 1, "frame_id": 2, "pose": 3},
    schemas.FRAME: {"parent_frame_id": 2, "child_frame_id": 3, "translation": 4, "rotation": 5},
    schemas.SCENE: {"deletions": 1, "entities": 2},
    "foxglove.SceneEntity": {"frame_locked": 5, "cubes": 8, "spheres": 9, "cylinders": 10, "lines": 11, "models": 14},
    "foxglove.LinePrimitive": {"type": 1, "thickness": 3, "points": 5, "indices": 8},
    "foxglove.CylinderPrimitive": {"size": 2, "bottom_scale": 3, "color": 5},
    "foxglove.Quaternion": {"x": 1, "w": 4},
}
"""Field numbers in foxglove-sdk's .proto files."""


@pytest.mark.parametrize("name", NUMBERS)
def test_foxglove_messages_have_foxglove_numbers(name: str) -> None:
    fields = schemas.make_message_class(name).DESCRIPTOR.fields_by_name
    assert {field: fields[field].number for field in NUMBERS[name]} == NUMBERS[name]


def test_every_event_survives_encoding() -> None:
    values = {"int": 7, "float": 0.5, "str": "x", "float[3]": [1.0, 2.0, 3.0], "map": {"a": {"b": [1, "c"]}}}
    for kind, keys in [*EVENT_EXTRA_KEYS.items(), ("fault", ())]:
        original = event(kind, "it", 3) | {key.name: values[key.type] for key in keys} | {"message": "new", "n": 1}
        decoded = schemas.make_message_class(schemas.EVENT).FromString(schemas.encode_event(original))
        assert schemas.decode_event(decoded) == original


def test_ticks_of_another_version_are_read_by_name(tmp_path: Path) -> None:
    files = descriptor_pb2.FileDescriptorSet.FromString(schemas.make_descriptor_set(schemas.TICK))
    (tick,) = files.file[0].message_type
    fields = [field for field in tick.field if field.name != "torque"]
    del tick.field[:]
    for number, field in enumerate(fields, 2):
        field.number = number
    tick.field.extend(fields)
    tick.field.add(name="novel", number=1, type=1, label=1)
    data = files.SerializeToString()
    message = schemas.load_message_class(data, schemas.TICK)(tick=5, force=[1.0, 2.0, 3.0], novel=9.0)
    message.probe.position.extend([0.1, 0.2, 0.3])
    path = tmp_path / "other.mcap"
    with path.open("wb", buffering=0) as file:
        mcap = McapFile(file)
        channel = mcap.channel("contact", schemas.TICK, data)
        mcap.message(channel, 1, message.SerializeToString())
        mcap.finish()
    (ticks,) = [part for part in read_contents(path) if isinstance(part, TickBlock)]
    assert ticks.column("force").tolist() == [[1.0, 2.0, 3.0]] and ticks.column("tick").tolist() == [5.0]
    assert ticks.column("novel").tolist() == [9.0] and ticks.column("torque") is None
    with pytest.raises(RecordingError, match="another version"):
        ticks.records()


def test_an_index_larger_than_memory_is_complete(tmp_path: Path) -> None:
    chunk_index = 87  # bytes of one with a single channel, by the specification
    count = 2 * INDEX_MEMORY_BYTES // chunk_index
    path = tmp_path / "long.mcap"
    with path.open("wb", buffering=0) as file:
        mcap = McapFile(file)
        channel = mcap.channel("contact", schemas.TICK, schemas.make_descriptor_set(schemas.TICK))
        for number in range(count):
            mcap.message(channel, number, b"")
            mcap.flush()
        mcap.finish()
    with path.open("rb") as file:
        summary = make_reader(file, validate_crcs=True).get_summary()
        assert [entry.message_start_time for entry in summary.chunk_indexes] == list(range(count))
        assert summary.statistics.message_count == summary.statistics.chunk_count == count
    assert [entry.name for entry in tmp_path.iterdir()] == ["long.mcap"]


def test_its_poses_are_played_to_the_bit(tmp_path: Path) -> None:
    holed = np.delete(run(), [50, 51, 52], axis=0)
    path = recorded(tmp_path / "a.mcap", holed)
    poses = resample(load_poses(path), 1000.0)
    pose = slice(AT.probe_position, AT.probe_position + 7)
    at = holed[:, AT.tick].astype(int)
    assert len(poses) == len(run()) and poses[at].tobytes() == np.ascontiguousarray(holed[:, pose]).tobytes()


def test_a_daemon_records_by_command(tmp_path: Path) -> None:
    with Daemon(quiet_rig(tmp_path), load_scene("paper-plane"), scene_name="paper-plane") as daemon:
        daemon.start()
        with Control(daemon.commands_endpoint, WAIT_S) as control:
            with pytest.raises(CommandRefused, match="refused: nothing is being recorded"):
                control.record_stop()
            started = control.record_start("a.mcap")
            with pytest.raises(CommandRefused, match=r"refused: .*a\.mcap is being recorded"):
                control.record_start("b.mcap")
            marked = control.mark("trial 7", {"hand": "left"}).tick
            # Enough ticks for one tap. Records reach the file shortly after the servo made them, and the state after
            # that.
            assert eventually(lambda: control.get_state().sequence >= started.tick + 2500)
            stopped = control.record_stop()
            second = control.record_start("b.mcap")
        daemon.stop()
        assert daemon.wait(60.0)
    assert Path(started.file) == tmp_path / "a.mcap" and Path(second.file).exists()
    assert eventually(lambda: summarize(tmp_path / "a.mcap")["whole"])
    records, events, notes, end = read(tmp_path / "a.mcap")
    assert (stopped.dropped, stopped.error, end.cut) == (0, "", "")
    assert len(records) >= 2500 and records[0, AT.tick] <= started.tick
    np.testing.assert_array_equal(np.diff(records[:, AT.tick]), 1.0)
    (mark,) = [entry for entry in events if entry["kind"] == "mark"]
    assert (mark["label"], mark["data"]) == ("trial 7", {"hand": "left"}) and abs(mark["tick"] - marked) <= 1000
    assert {"touch", "release"} <= {entry["name"] for entry in events if entry["kind"] == "contact"}
    assert notes["scene_name"] == "paper-plane" and notes["rig"]["device"]["recording"] == "tap"
    assert notes["versions"]["softfinger"] and notes["machine"]["cpu"] and notes["settings"][0]["name"]
    assert notes["end"] == {"ticks": len(records), "dropped": 0, "events_dropped": 0}
    assert summarize(tmp_path / "b.mcap")["whole"]


def test_record_writes_what_a_daemon_sends(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    rig = quiet_rig(tmp_path)
    with Daemon(rig, load_scene("paper-plane"), scene_name="paper-plane") as daemon:
        daemon.recordings.record(tmp_path / "own.mcap", "paper-plane")
        daemon.start()
        words = ["record", str(tmp_path / "wire.mcap"), "--endpoint", daemon.publisher.endpoint]
        words += ["--commands", daemon.commands_endpoint, "--timeout", "60", "--duration", "0.5"]
        with caplog.at_level("INFO"):
            assert cli.main(words) == 0
        daemon.stop()
        assert daemon.wait(60.0)
    assert "0.5 s are over" in caplog.text and "no tick lost" in caplog.text
    theirs, _, notes, end = read(tmp_path / "wire.mcap")
    own, *_ = read(tmp_path / "own.mcap")
    assert len(theirs) == 500 and end.cut == "" and notes["lost"] == 0 and notes["every"] == 1
    assert notes["scene"] == about()["scene"] and notes["scene_name"] == "paper-plane"
    first = int(theirs[0, AT.tick])
    assert theirs.tobytes() == own[first : first + 500].tobytes()
