"""Messages of the Inverse Service: poses, commands, versions."""

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfinger.config.errors import DeviceError
from softfinger.drivers.haply.messages import (
    DeviceRef,
    encode_command,
    find_force_key,
    is_identity,
    parse_version,
    read_state,
)

pytestmark = pytest.mark.plain

DEVICE, GRIP = DeviceRef("inverse3", "049D"), DeviceRef("wireless_verse_grip", "7")
NUMBERS = st.none() | st.floats(-1e12, 1e12)


@pytest.mark.scaled
@given(st.lists(NUMBERS, min_size=7, max_size=7))
def test_a_pose_is_in_bounds_or_nan(values: list[float | None]) -> None:
    x, y, z, w, i, j, k = values
    state = {
        "inverse3": [{"device_id": "049D", "state": {"cursor_position": {"x": x, "y": y, "z": z}}}],
        "wireless_verse_grip": [{"device_id": "7", "state": {"orientation": {"w": w, "x": i, "y": j, "z": k}}}],
    }
    pose = read_state(json.dumps(state).encode(), DEVICE, GRIP)
    assert math.hypot(*pose.position) <= 10.0 or all(map(math.isnan, pose.position))
    size = math.hypot(*pose.orientation)
    assert all(map(math.isnan, pose.orientation)) or size == pytest.approx(1.0, abs=1e-12)  # rounding


def test_a_state_is_a_pose_with_the_orientation_and_buttons_of_the_grip() -> None:
    grip = {"orientation": {"w": 0.9, "x": 0.0, "y": 1.2, "z": 0.0}, "buttons": {"a": True, "b": False, "c": True}}
    others = [{"device_id": "1", "state": {"cursor_position": {"x": 9.0, "y": 9.0, "z": 9.0}}}]
    state = {
        "inverse3": [*others, {"device_id": "049D", "state": {"cursor_position": {"x": 0.1, "y": 0.2, "z": 0.3}}}],
        "wireless_verse_grip": [{"device_id": "7", "state": grip}],
    }
    message = json.dumps(state).encode()
    assert read_state(message, DEVICE, None) == ((0.1, 0.2, 0.3), (1.0, 0.0, 0.0, 0.0), 0.0, "")
    position, orientation, buttons, _ = read_state(message, DEVICE, GRIP)
    assert position == (0.1, 0.2, 0.3) and buttons == 5.0
    assert orientation == pytest.approx((0.6, 0.0, 0.8, 0.0), abs=1e-15)  # one rounding


IDENTITY = {
    "position": {"x": 0, "y": 0, "z": 0},
    "rotation": {"w": 1, "x": 0, "y": 0, "z": 0},
    "scale": {"x": 1, "y": 1, "z": 1},
}


@pytest.mark.parametrize(
    ("change", "is_accepted"),
    [
        ({}, True),
        ({"rotation": {"w": -1, "x": 0, "y": 0, "z": 0}}, True),
        ({"position": {"x": 0, "y": 0.01, "z": 0}}, False),
        ({"rotation": {"w": 0.8, "x": 0.6, "y": 0, "z": 0}}, False),
        ({"scale": {"x": 1, "y": 1, "z": 2}}, False),
        ({"scale": None}, False),
    ],
)
def test_a_mount_that_changes_positions_is_recognised(change: dict[str, object], is_accepted: bool) -> None:
    mount = IDENTITY | change
    assert is_identity(mount) is is_accepted and is_identity({"transform": mount}) is is_accepted
    assert is_identity(None) and is_identity({}) and is_identity({"transform": {}})


def test_a_command_has_the_key_of_the_version() -> None:
    force = (0.1, -1e-9, 2.0 / 3.0)
    message = json.loads(encode_command(DEVICE, "values", force))
    assert message == {
        "inverse3": [
            {"device_id": "049D", "commands": {"set_cursor_force": {"values": dict(zip("xyz", force, strict=True))}}}
        ]
    }
    assert json.loads(encode_command(DEVICE, "vector", force, basis=True))["session"] == {
        "configure": {"basis": {"permutation": "XYZ"}}
    }


def test_versions() -> None:
    assert [find_force_key(parse_version(text)) for text in ("3.1.0", "3.4.2.0", "3.5.0", "v3.10.1")] == [
        "values", "values", "vector", "vector",
    ]  # fmt: skip
    for text in ("3.0.7", "4.0", "2.9", "", "3", "x.y"):
        with pytest.raises(DeviceError, match="version"):
            parse_version(text)
