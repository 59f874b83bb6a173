"""Mechanisms described in a rig, in the exchanges of both board drivers, call by call: joint angles in, torques out."""

import struct
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest
import test_hid_exchange
import test_serial_exchange
from helpers.plain_by_call import BY_CALL

from softfinger.drivers.base import OK, STALE

pytestmark = BY_CALL

PANTOGRAPH = {"kind": "pantograph", "base_m": 0.038, "inner_m": 0.07, "outer_m": 0.0875, "torque_max_nm": 0.01}
DELTA = {
    "kind": "delta", "base_m": 0.06, "end_m": 0.03, "arm_m": 0.08, "rod_m": 0.17, "torque_max_nm": 0.2,
    "origin_m": [0.0, 0.0, 0.2],
}  # fmt: skip


class Joints:
    """A board of either driver whose messages contain a float32 per joint."""

    def __init__(self, driver: str, kinematics: dict[str, Any], names: str, patch: pytest.MonkeyPatch) -> None:
        messages = {
            direction: {
                "bytes": 4 * len(names),
                "field": [{"meaning": f"{m}{n}", "offset": 4 * k, "type": "float32"} for k, n in enumerate(names)],
            }
            for direction, m in (("input", ""), ("output", "torque_"))
        }
        keys: dict[str, Any] = {"kinematics": kinematics, "mounting": {}}
        self.format, self.board = f"<{len(names)}f", self.open(driver, keys, messages, patch)

    def open(self, driver: str, keys: Any, messages: Any, patch: pytest.MonkeyPatch) -> Any:
        if driver == "hid":
            return test_hid_exchange.Board(patch, **keys, reports=messages)
        return test_serial_exchange.Board(test_serial_exchange.described(**keys, frames=messages), patch)

    def read(self, angles: Iterable[float]) -> Any:
        return self.board.read(struct.pack(self.format, *angles))

    def torques(self, *force: float) -> tuple[int, np.ndarray]:
        """Return the status of a force, and the torques (N m) sent for it."""
        status = self.board.write(*force, 0.0, 0.0, 0.0)
        sent = self.board.node.sent if isinstance(self.board, test_hid_exchange.Board) else self.board.port.sent
        return status, np.array(struct.unpack(self.format, sent[-1][-struct.calcsize(self.format) :]))

    def count(self, name: str) -> int:
        return int(self.board.counts().get(name, 0))


Make = Callable[[dict[str, Any], str], Joints]


@pytest.fixture(params=["serial", "hid"])
def make(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Make:
    return lambda kinematics, names: Joints(request.param, kinematics, names, monkeypatch)


def test_a_singular_pose_is_counted_and_a_motors_limit_is_another(make: Make) -> None:
    joints = make(PANTOGRAPH, "ab")
    # first, both inner links outward along the line of their joints: their ends are 0.178 m apart, beyond the reach of
    # the outer links
    for degrees, largest, counts in (((180.0, 0.0), 0.0, (1, 0)), ((150.0, 30.0), 0.01, (1, 1))):
        for force, status in ((5.0, STALE), (0.0, OK)):  # a zero needs no motor
            assert joints.read(np.radians(degrees))[0] == OK
            outcome, torques = joints.torques(0.0, force, 0.0)
            assert outcome == status
            assert np.abs(torques).max() == pytest.approx(largest if force else 0.0)
        assert (joints.count("singular"), joints.count("cut")) == counts
    assert joints.count("written") == 4


def test_a_pose_that_is_none_is_counted_as_singular(make: Make) -> None:
    joints = make(DELTA, "abc")
    status, sample = joints.read((0.0, np.pi, 0.0))
    assert status == OK and np.isnan(sample[:3]).all()
    assert joints.count("singular") == 1 and np.isfinite(joints.read((0.5, 0.5, 0.5))[1]).all()
    assert joints.count("singular") == 1


def test_torques_of_a_delta_do_the_work_of_the_force(make: Make) -> None:
    joints = make(DELTA, "abc")
    angles, step, force = np.array([0.5, 0.6, 0.4]), np.array([1e-3, -2e-3, 3e-3]), np.array([0.3, -0.2, 0.5])
    ahead, behind = (joints.read(angles + sign * step)[1][:3] for sign in (1, -1))
    joints.read(angles)
    status, torques = joints.torques(*force)
    assert status == OK and (torques != 0.0).all()
    # an error of the third order in steps of 3e-3
    assert torques @ (2 * step) == pytest.approx(force @ (ahead - behind), rel=1e-4)
