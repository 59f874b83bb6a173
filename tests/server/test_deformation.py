"""Topic `deformation`: sent when a load changes, recorded as sent, and multiplied by the client."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.daemons import make_daemon, subscribed
from helpers.telemetry_records import join, put, synthetic
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from softfinger.proxy.elastic.deformed import Deformed
from softfinger.proxy.record import AT, ROLLING
from softfinger.server.services.scene_topics import Deformation
from softfinger.server.wire.protocol import DEFORMATION, decode

pytestmark = pytest.mark.real_time

FORCE = (0.1, -0.2, 1.5)


def make_press(count: int) -> Any:
    rows = synthetic(count)
    for name in ("contacts0.force", "contacts1.force", "contacts2.force", "contact.displacement"):
        put(rows, name, 0.0)
    pressing = rows[100 : count - 100]
    put(pressing, "contact.mode", ROLLING)
    put(pressing, "contact.object", 0)
    put(pressing, "contacts0.force", FORCE)
    put(pressing, "contacts0.point", (0.003, 0.002, -0.0005))
    put(pressing, "contact.displacement", (0.0, 0.0, -0.0005))
    put(pressing[200:], "contacts0.force", (0.1, -0.2, 1.5 + 1e-5))  # below the published resolution
    return rows


def test_loads_are_sent_when_they_change_and_recorded_as_they_are_sent(tmp_path: Path) -> None:
    changes = {"commands.endpoint": "off", "device.recording": "tap"}
    path, messages = tmp_path / "a.mcap", []
    with (
        make_daemon(scene="press-a-pad", changes=changes) as daemon,
        subscribed(daemon.publisher.endpoint, DEFORMATION, "event") as socket,
    ):
        daemon.recordings.record(path, "press-a-pad")
        join(daemon.publisher, socket)
        # The daemon is not started; these ticks arrive in batches as from a hand.
        for batch in np.array_split(make_press(600), 60):
            daemon.deformation.sink.take(batch, 0)
        daemon.publisher.event("test", "end")
        while (frames := socket.recv_multipart())[0] != b"event":
            messages.append(decode(*frames))
        sent: list[tuple[int, int]] = []

        def publish(topic: str, tick: int, content: dict[str, Any]) -> None:
            sent.append((tick, len(content["loads"])))

        changing = Deformation(daemon.rendering, [""], publish)
        rows = make_press(1200)
        rows[:, AT.contacts0_force] = np.linspace(1.0, 2.0, len(rows))
        for row in rows:
            changing.sink.take(row[None], 0)
        with subscribed(daemon.publisher.endpoint, DEFORMATION) as late:  # a late subscriber gets the last message
            assert late.poll(60_000)
            assert decode(*late.recv_multipart()).loads == ()
    ticks = [tick for tick, count in sent if count]
    assert (ticks[0], sent[-1][1]) == (100, 0) and set(np.diff(ticks)) == {17}
    assert [len(message.loads) for message in messages] == [1, 0]
    assert messages[0].tick < 120 and 500 <= messages[1].tick < 520
    (load,) = messages[0].loads
    assert (load.finger, load.object, load.patch_radius) == ("", 0, 0.0075)
    # The object is at z = -0.02 m and not turned.
    assert load.force == pytest.approx([-x for x in FORCE], rel=1e-12)
    assert load.point == pytest.approx((0.003, 0.002, 0.02), abs=1e-12)

    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        recorded = [(schema, message) for schema, _, _, message in reader.iter_decoded_messages(topics=[DEFORMATION])]
    assert {schema.name for schema, _ in recorded if schema is not None} == {"softfinger.Deformation"}
    assert [message.tick for _, message in recorded] == [message.tick for message in messages]
    assert tuple(recorded[0][1].loads[0].force) == load.force and not recorded[1][1].loads

    surface = Deformed.of_scene("press-a-pad")
    moved = surface.at(messages[0].loads) - surface.vertices
    deepest = int(moved[:, 2].argmin())
    assert np.linalg.norm(surface.vertices[deepest] - load.point) < load.patch_radius
    assert moved[deepest, 2] < -1e-4 and (surface.at(messages[1].loads) == surface.vertices).all()
