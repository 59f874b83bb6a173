"""Messages of the Inverse Service: parsing of valid and of arbitrary messages, commands, versions."""

import json
import math
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfinger.config.errors import DeviceError
from softfinger.drivers.haply.messages import (
    DeviceRef,
    Malformed,
    Missing,
    encode_command,
    find_force_key,
    parse_version,
    read_inventory,
    read_state,
)

pytestmark = pytest.mark.plain

DEVICE, GRIP = DeviceRef("inverse3", "049D"), DeviceRef("wireless_verse_grip", "7")
KEYS = ["inverse3", "wireless_verse_grip", "device_id", "state", "cursor_position", "orientation", "x", "y", "z", "w"]
JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(KEYS), inner, max_size=6),
    max_leaves=20,
)


@pytest.mark.scaled
@given(st.binary(max_size=200) | JSON.map(lambda value: json.dumps(value).encode()))
def test_any_bytes_are_a_state_or_an_error(message: bytes) -> None:
    for read in (lambda: read_state(message, DEVICE, GRIP), lambda: read_inventory(message)):
        with suppress(Malformed, Missing):
            read()


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
