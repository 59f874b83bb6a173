"""The node of examples/bridges: its messages follow ROS 2's definitions, and it runs if rclpy is installed."""

import importlib.util
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.recorded import run
from helpers.waits import repeated
from rosbags.typesys import Stores, get_typestore

from softfinger.proxy.records import Records
from softfinger.server.wire.client import Sample, subscribe

NODE = Path(__file__).resolve().parents[1] / "examples" / "bridges" / "ros2_node.py"
PACKAGES = ("geometry_msgs", "std_msgs", "builtin_interfaces")
MESSAGES, WAIT_S = 20, 120.0


def sample_of(record: Records) -> Sample:
    probe = {key: record[f"probe.{key}"].tolist() for key in ("position", "orientation")}
    wrench = {key: record[key].tolist() for key in ("force", "torque")}
    return Sample("contact", {"timestamp": float(record["timestamp"]), "probe": probe} | wrench)


def imported(types: dict[str, type]) -> ModuleType:
    """The node, to which the packages of ROS 2 are these types, by their full names."""
    spec = importlib.util.spec_from_file_location("ros2_node", NODE)
    assert spec is not None and spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        for package in PACKAGES:
            own = {name.rpartition("/")[2]: module for name, module in types.items() if name.startswith(f"{package}/")}
            patch.setitem(sys.modules, package, ModuleType(package))
            patch.setitem(sys.modules, f"{package}.msg", SimpleNamespace(**own))
        spec.loader.exec_module(made)
    return made


@pytest.mark.parametrize("release", [Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY])
def test_ros_messages_equal_the_telemetry(release: Stores) -> None:
    store = get_typestore(release)
    record = Records(run()[1000:1001])[0].copy()
    record["probe.orientation"][:] = np.cos(0.5), 0.0, np.sin(0.5), 0.0
    record["force"][:], record["torque"][:] = (0.1, 0.2, 0.3), (0.0, 0.001, 0.002)
    pose, wrench = (through(store, message) for message in imported(store.types).messages(sample_of(record)))

    assert pose.header.stamp.sec + 1e-9 * pose.header.stamp.nanosec == pytest.approx(record["timestamp"], abs=1e-6)
    assert pose.header == wrench.header and pose.header.frame_id == "world"
    assert xyz(pose.pose.position) == record["probe.position"].tolist()
    q = pose.pose.orientation
    assert [q.w, q.x, q.y, q.z] == record["probe.orientation"].tolist()
    assert xyz(wrench.wrench.force) == [0.1, 0.2, 0.3] and xyz(wrench.wrench.torque) == [0.0, 0.001, 0.002]


@pytest.mark.real_time
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the libraries below rclpy
def test_a_ros_subscriber_receives_the_telemetry(endpoints: tuple[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    rclpy = pytest.importorskip(
        "rclpy", reason="rclpy is part of ROS 2; docs/operate/bridges.md describes its installation"
    )
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_DOMAIN_ID", "87")
    from geometry_msgs.msg import PoseStamped, WrenchStamped

    got: list[Any] = []
    with subscribe(endpoints[0], timeout_s=60.0) as samples:
        published = [next(samples)]
        with repeated(lambda: published.append(next(samples)), every_s=0.0):
            process = subprocess.Popen([sys.executable, NODE, endpoints[0]], env=os.environ)
            rclpy.init(signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
            try:
                node = rclpy.create_node("listener")
                received = [
                    node.create_subscription(kind, f"softfinger/{name}", got.append, 100)
                    for name, kind in (("pose", PoseStamped), ("wrench", WrenchStamped))
                ]
                until = time.monotonic() + WAIT_S
                while len(got) < MESSAGES and time.monotonic() < until and process.poll() is None:
                    rclpy.spin_once(node, timeout_sec=0.1)
                process.send_signal(signal.SIGINT)
                assert process.wait(60) == 0
                assert received and {type(message).__name__ for message in got} == {"PoseStamped", "WrenchStamped"}
            finally:
                process.kill()
                process.wait()
                rclpy.shutdown()
    by_time = {round(sample.timestamp * 1e9): sample for sample in published}
    for message in got:
        sample = by_time[message.header.stamp.sec * 10**9 + message.header.stamp.nanosec]
        if isinstance(message, WrenchStamped):
            assert xyz(message.wrench.force) == list(sample.force)
        else:
            assert xyz(message.pose.position) == list(sample["probe.position"])


def through(store: Any, message: Any) -> Any:
    name = message.__msgtype__
    return store.deserialize_cdr(store.serialize_cdr(message, name), name)


def xyz(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]
