"""The node of examples/bridges, but for rclpy: its messages are made of ROS 2's own definitions, and go through CDR."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.recorded import run
from rosbags.typesys import Stores, get_typestore

from softfinger.proxy.records import Records
from softfinger.server.wire.client import Sample

NODE = Path(__file__).resolve().parents[1] / "examples" / "bridges" / "ros2_node.py"
PACKAGES = ("geometry_msgs", "std_msgs", "builtin_interfaces")


def sample_of(record: Records) -> Sample:
    """A contact message with what the node takes of it."""
    probe = {key: record[f"probe.{key}"].tolist() for key in ("position", "orientation")}
    wrench = {key: record[key].tolist() for key in ("force", "torque")}
    return Sample("contact", {"timestamp": float(record["timestamp"]), "probe": probe} | wrench)


@pytest.fixture(scope="module")
def node() -> ModuleType:
    spec = importlib.util.spec_from_file_location("ros2_node", NODE)
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


@pytest.mark.parametrize("release", [Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY])
def test_messages_say_what_the_telemetry_says(release: Stores, node: ModuleType) -> None:
    """Pose, wrench and frame of a tick, serialised and read again by an implementation of ROS 2's formats."""
    store = get_typestore(release)
    known = {name.rpartition("/")[2]: made for name, made in store.types.items() if name.startswith(PACKAGES)}
    record = Records(run()[1000:1001])[0].copy()
    record["probe.orientation"][:] = np.cos(0.5), 0.0, np.sin(0.5), 0.0  # 1 rad about y
    record["force"][:], record["torque"][:] = (0.1, 0.2, 0.3), (0.0, 0.001, 0.002)
    pose, wrench, frame = (through(store, each) for each in node.messages(SimpleNamespace(**known), sample_of(record)))

    assert pose.header.stamp.sec + 1e-9 * pose.header.stamp.nanosec == pytest.approx(record["timestamp"], abs=1e-6)
    assert (pose.header.frame_id, wrench.header.frame_id) == ("world", "fingertip")
    assert (frame.header.frame_id, frame.child_frame_id) == ("world", "fingertip")
    assert xyz(pose.pose.position) == xyz(frame.transform.translation) == record["probe.position"].tolist()
    q = pose.pose.orientation
    assert [q.w, q.x, q.y, q.z] == record["probe.orientation"].tolist() and q == frame.transform.rotation
    # Back into the world: x and z of a turn of 1 rad about y.
    turn = np.array([[np.cos(1), 0, np.sin(1)], [0, 1, 0], [-np.sin(1), 0, np.cos(1)]])
    np.testing.assert_allclose(turn @ xyz(wrench.wrench.force), record["force"], atol=1e-15)  # rounding
    np.testing.assert_allclose(turn @ xyz(wrench.wrench.torque), record["torque"], atol=1e-15)


def through(store: Any, message: Any) -> Any:
    name = message.__msgtype__
    return store.deserialize_cdr(store.serialize_cdr(message, name), name)


def xyz(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]
