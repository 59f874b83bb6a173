"""Encoding of HID reports: published layouts, all types, descriptions in rigs, report descriptors, random bytes."""

import re
import struct
import tomllib
from math import inf, isfinite, nan
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from emulators.boards import BOARDS
from helpers.hid_devices import described, rig_options
from helpers.rig_files import with_key
from hypothesis import example, given
from hypothesis import strategies as st

from softfinger.config.errors import ConfigError
from softfinger.config.load import build
from softfinger.config.schema import Rig
from softfinger.drivers.fields import table as reports
from softfinger.drivers.fields.options import COMMANDED, SENSED, TYPES, InputField, OutputField
from softfinger.drivers.hid.device import Options
from softfinger.drivers.hid.options import InputReport, OutputReport
from softfinger.drivers.system.descriptor import parse_descriptor

pytestmark = pytest.mark.plain

CODES = dict(zip(TYPES, "bBhHiIf", strict=True))


def decode(report: InputReport, data: bytes, big: bool = False) -> tuple[bool, dict[str, float]]:
    values, scratch, packet = np.zeros(reports.SENSED_SIZE), np.zeros(1, np.int64), np.frombuffer(data, np.uint8)
    rows = reports.make_input_table(report.field, big)
    usable = reports.decode(packet.ctypes.data, rows.ctypes.data, len(rows), scratch.ctypes.data, values)
    return bool(usable), dict(zip(SENSED, values.tolist(), strict=True))


def encode(report: OutputReport, big: bool = False, **values: float) -> tuple[bool, bytes]:
    out, scratch = np.zeros(1 + report.bytes, np.uint8), np.zeros(1, np.int64)
    numbers = np.array([values.get(name, 0.0) for name in COMMANDED])
    numbers[reports.CONSTANT] = 1.0
    rows = reports.make_output_table(report.field, big)
    cut = reports.encode(numbers, rows.ctypes.data, len(rows), scratch.ctypes.data, out[1:].ctypes.data)
    return bool(cut), out.tobytes()


def test_woodenhaptics_v1_layout() -> None:
    wire = rig_options("woodenhaptics-2015").reports
    usable, values = decode(wire.input, bytes.fromhex("f401 e0fc b004 ffff".replace(" ", "")))
    assert usable
    assert [values[k] for k in "abc"] == [-500, -800, 1200] and values["buttons"] == 0
    _, out = encode(wire.output, current_a=-0.00063, current_b=0.27578, current_c=0.32046)
    assert out.hex() == "00" + "ffff" + "1401" + "4001" + "0000"


@pytest.mark.parametrize(
    ("rig", "size", "preset"), [("woodenhaptics-polhem-v1", 64, 0), ("woodenhaptics-polhem-v1-lpc1768", 0, 7)]
)
def test_woodenhaptics_v2_layout(rig: str, size: int, preset: int) -> None:
    """A Teensy pads its reports to 64 bytes, an LPC1768 does not."""
    wire = rig_options(rig).reports
    usable, values = decode(wire.input, struct.pack("<7h", 1, -2, 3, 10044, 55, 66, 1).ljust(size, b"\xff"))
    assert usable
    assert [values[k] for k in "abcdef"] == [1, -2, 3, 66, 55, 44] and values["buttons"] == 1 + 2
    assert decode(wire.input, struct.pack("<7h", 0, 0, 0, 5000, 0, 0, 0).ljust(size))[1]["buttons"] == 0
    _, out = encode(wire.output, current_a=2.0, current_b=-2.0, current_c=0.0005)
    assert out == b"\0" + struct.pack("<7h", 2000, -2000, 1, 0, 0, 0, 0).ljust(size, b"\0")
    _, out = encode(wire.preset, preset_a=preset, preset_b=0, preset_c=-5000)
    assert out == b"\0" + struct.pack("<7h", 0, 0, 0, 1, preset, 0, -5000).ljust(size, b"\0")


def test_makers_descriptors() -> None:
    lengths = {name: [parse_descriptor(hid.descriptor) for hid in board.interfaces] for name, board in BOARDS.items()}
    assert lengths["teensy"] == [({0: 64}, {0: 64}), ({0: 64}, {0: 32})]
    assert lengths["lpc1768-14"] == [({0: 14}, {0: 14})] and lengths["lpc1768-8"] == [({0: 8}, {0: 8})]


@given(st.sampled_from(TYPES), st.binary(min_size=4, max_size=4), st.integers(0, 5), st.booleans())
@example("float32", struct.pack("<f", nan), 0, False)
@example("float32", struct.pack(">f", -inf), 0, True)
def test_every_type_is_decoded_like_struct(kind: str, data: bytes, offset: int, big: bool) -> None:
    field = InputField(meaning="x", offset=offset, type=kind, scale=2.0, bias=1.0)
    report = InputReport(bytes=offset + 4, field=(field,))
    usable, values = decode(report, b"\x5a" * offset + data, big)
    (raw,) = struct.unpack_from("<>"[big] + CODES[kind], data)
    assert usable == isfinite(raw)
    if usable:
        assert values["x"] == 2.0 * raw + 1.0


@given(st.sampled_from(TYPES), st.floats(-1e10, 1e10), st.integers(0, 5), st.booleans())
def test_every_type_is_encoded_like_struct(kind: str, value: float, offset: int, big: bool) -> None:
    report = OutputReport(bytes=offset + 4, field=(OutputField(meaning="force_x", offset=offset, type=kind),))
    cut, out = encode(report, big, force_x=value)
    code = "<>"[big] + CODES[kind]
    size = struct.calcsize(code)
    (back,) = struct.unpack_from(code, out, 1 + offset)
    assert out == b"\0" * (1 + offset) + out[1 + offset : 1 + offset + size] + b"\0" * (4 - size)
    if kind == "float32":
        assert back == np.float32(value)
        return
    info = np.iinfo(kind)
    assert back == min(max(np.floor(value + 0.5), info.min), info.max)
    assert cut == (not info.min - 0.5 <= value < info.max + 0.5)


def test_descriptors_give_report_lengths() -> None:
    # Two input reports (ids 1 and 2; 6 bytes, and 12 bits padded to 2 bytes) and no output report; a pushed size.
    numbered = bytes.fromhex("05010908a101 8501 7510 9503 8102 8502 a4 7504 9503 8102 b4 c0".replace(" ", ""))
    assert parse_descriptor(numbered) == ({1: 6, 2: 2}, {})
    assert str(parse_descriptor(numbered)) == "input 6 bytes with id 1 and 2 bytes with id 2, output none"
    with pytest.raises(ValueError, match="truncated"):
        parse_descriptor(numbered[:5])
    # Long items, which HID 1.11 reserves: prefix, number of data bytes, tag, data. The last one is incomplete.
    long_item = bytes.fromhex("fe 02 f0 81 02")
    assert parse_descriptor(long_item + numbered + long_item + b"\xfe") == ({1: 6, 2: 2}, {})


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("reports.input.bytes", 20, r"field\[5\].offset = 20: bytes 20 to 23 exceed a report of 20"),
        ("reports.input.field.1.offset", 2, r"field\[1\].offset = 2: byte 2 already belongs to field\[0\]"),
        ("reports.input.field.0.type", "int24", r"field\[0\].type = 'int24': must be one of .*'int8'"),
        ("reports.input.field.0.meaning", "w", r"field\[0\].meaning = 'w': must be one of"),
        ("reports.input.field.0.meaning", "y", r"field\[1\].meaning = 'y': another field has the same meaning"),
        ("reports.input.field.3.meaning", "buttons", r"input.field = \['qx', 'qy', 'qz'\]: a cartesian device"),
        ("reports.output.field.2.meaning", "constant", "output.field: has no force_z, required for cartesian"),
        ("kinematics.kind", "chain", "kinematics.capstan_m is missing"),
        ("kinematics.kind", "gear", "kinematics.kind = 'gear': must be one of .*'cartesian'"),
        ("reports", "woodenhaptics-v3", "'woodenhaptics-v3': not in the library"),
        ("calibrate", True, "is for chains only"),
        ("mounting", {"orientation_wxyz": [0, 0, 0, 0]}, "all zero is not an orientation"),
        ("reports.preset", {"bytes": 8, "field": []}, "preset.bytes = 8: must have the length and id of"),
    ],
)  # fmt: skip
def test_a_description_that_cannot_be_is_refused(path: str, value: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build(Options, with_key(described(), path, value), "rig [device]")


def test_a_usb_interface_is_no_node() -> None:
    build(Options, described(path="1-2.3:1.0", through="thread"), "rig")
    build(Options, described(path="/dev/hidraw3", through="node"), "rig")
    with pytest.raises(ConfigError, match=r"path = '1-2.3:1.0': is a path of hidapi on USB, .* such as /dev/hidraw0"):
        build(Options, described(path="1-2.3:1.0", through="node"), "rig")


def test_a_named_format_can_be_changed() -> None:
    own = {"name": "woodenhaptics-v1", "output": {"bytes": 8, "field": [
        {"meaning": f"current_{k}", "offset": 2 * n, "type": "int16", "scale": -1000.0} for n, k in enumerate("abc")
    ]}}  # fmt: skip
    changed = rig_options("woodenhaptics-2015", reports=own).reports
    assert changed.output.field[0].scale == -1000.0
    assert changed.input == rig_options("woodenhaptics-2015").reports.input


def test_the_description_in_the_docs_is_valid() -> None:
    page = (Path(__file__).resolve().parents[2] / "docs" / "devices" / "hid.md").read_text("utf-8")
    match = re.search(r"```toml\n(.*?)```", page, re.DOTALL)
    rig = build(Rig, tomllib.loads(match[1]), "docs/devices/hid.md")
    assert build(Options, rig.device.options, "docs/devices/hid.md [device]").reports.input.id == 3
