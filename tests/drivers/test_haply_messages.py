"""Messages of the Inverse Service: poses, commands, versions."""

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfinger.config.errors import DeviceError
from softfinger.drivers.haply.messages import DeviceRef, encode_command, find_force_key, parse_version, read_state

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
