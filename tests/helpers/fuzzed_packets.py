"""Seeds of `fuzzing` that are not shipped as files, and the functions of the drivers that read bytes of a device.

A packet either gives finite numbers (all NaN if the device may have no pose) or is ignored. A tick with a non-finite
pose has no force (tests/server/test_plausibility.py).
"""

import io
import json
import struct
from collections.abc import Callable
from contextlib import suppress
from math import hypot, isfinite, isnan
from pathlib import Path
from typing import Any, Final

import msgpack
import numpy as np
import trimesh
from PIL import Image

MODELS: Final = [
    b"""<mujoco model="m"><option timestep="0.001"/><worldbody><body name="box" pos="0 0 0.1"><freejoint/>
<geom name="g" type="box" size=".02 .02 .02" mass="0.1"/></body><body pos="0.1 0 0"><joint type="slide" axis="1 0 0"
range="0 1" limited="true"/><geom type="sphere" size="0.01"/></body></worldbody></mujoco>""",
    b"""<robot name="r"><link name="base"/><link name="arm"><inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0"
iyy="1" iyz="0" izz="1"/></inertial><collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>
<joint name="j" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/><limit lower="-1" upper="1"
effort="1" velocity="1"/></joint></robot>""",
]
SOLID: Final = trimesh.Trimesh(
    ((0.0, 0.0, 0.0), (0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.01)),
    ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)),
    process=False,
)
STL: Final = [SOLID.export(file_type="stl"), SOLID.export(file_type="stl_ascii").encode()]
OBJ: Final = [SOLID.export(file_type="obj").encode()]
PLY: Final = [SOLID.export(file_type="ply", encoding=encoding) for encoding in ("ascii", "binary")]
TWICE: Final = trimesh.Scene(SOLID)
TWICE.add_geometry(SOLID, transform=np.diag((1.0, 1.0, 2.0, 1.0)))
GLB: Final = [TWICE.export(file_type="glb")]


def pictures() -> list[bytes]:
    heights = (np.arange(600) % 251).astype(np.uint8).reshape(20, 30)
    made = []
    for pixels in (heights, heights.astype(np.uint16) * 1000):
        out = io.BytesIO()
        Image.fromarray(pixels).save(out, "png")
        made.append(out.getvalue())
    return made


def arrays() -> list[bytes]:
    made = []
    for kind in (np.float64, np.float32, np.uint16):
        out = io.BytesIO()
        np.save(out, np.arange(64, dtype=kind).reshape(8, 8))
        made.append(out.getvalue())
    return made


def commands() -> list[bytes]:
    requests: list[tuple[str, Any]] = [
        ("get_state", {}), ("set_params", {"values": {"object.table.material.stiffness_n_per_m": 900.0}}),
        ("set_scene", {"scene": "paper-plane", "overrides": {}}), ("mark", {"label": "a", "data": {"b": [1, None]}}),
        ("drive", {"object": "disc", "position_m": [0.0, 0.0, 0.0], "orientation_wxyz": [1.0, 0.0, 0.0, 0.0]}),
        ("record_start", {"file": "run.mcap"}), ("zero", {"position_m": [0, 0, 0]}), ("mesh", {"object": 1}),
        ("hand", {"position_m": [0.0, 0.0, 0.01]}),
    ]  # fmt: skip
    return [msgpack.packb({"command_id": "7", "method": method, "params": params}) for method, params in requests]


def targets(make: Callable[..., Any]) -> dict[str, Any]:
    """Targets of the devices; `make` is fuzzing.Target."""
    from softfinger.drivers.haply.messages import Malformed, Missing
    from softfinger.drivers.serial.frames import FRAME_BYTES

    text = b" -59.276   13.383 -148.002   0.0919 -1.8483  1.0370 -1.9512 0".ljust(FRAME_BYTES - 1) + b"\n"
    items = bytes.fromhex("0600ff0901a101150026ff0075089540810295409102c0")
    packets = {
        "hid": ([bytes(64), bytes(range(64))], _hid, ()),
        "hid-descriptor": ([items], _descriptor, (ValueError,)),
        "serial-text": ([text, text * 3], _serial_text, ()),
        "serial-described": ([bytes(64), bytes(range(64))], _serial_described, ()),
        "falcon": ([b"<AAAAAAAAAAAAAA>", b"<PAAPIHAACDAAAHA>" * 3], _falcon, ()),
        "spacemouse": ([bytes([1, *range(12)]), bytes([2, 0, 1, 0, 2, 0, 3]), bytes([3, 1, 0])], _spacemouse, ()),
        "frame": ([struct.pack("<12d", 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1)], _frames, ()),
        "haply": (_haply_seeds(), _haply, (Malformed, Missing)),
    }
    return {
        name: make(lambda seeds=seeds: seeds, take, refusals, named=False)
        for name, (seeds, take, refusals) in packets.items()
    }


def _finite_or_refused(usable: bool, values: Any) -> None:
    assert not usable or all(map(isfinite, values)), f"taken, and not finite: {list(values)}"


def _hid(_: Path, data: bytes) -> None:
    from helpers.hid_devices import RIGS
    from helpers.rig_files import rig_options
    from softfinger.drivers.fields import table

    for rig in RIGS:
        report = rig_options(rig).reports.input
        values, scratch, rows = np.zeros(table.SENSED_SIZE), np.zeros(1, np.int64), table.make_input_table(report.field)
        packet = np.frombuffer(data.ljust(report.bytes, b"\0"), np.uint8)
        usable = table.decode(packet.ctypes.data, rows.ctypes.data, len(rows), scratch.ctypes.data, values)
        _finite_or_refused(bool(usable), values.tolist())


def _descriptor(_: Path, data: bytes) -> None:
    from softfinger.drivers.system.descriptor import parse_descriptor

    lengths = parse_descriptor(data)
    assert len(str(lengths)) < 100_000 and all(length >= 0 for sizes in lengths for length in sizes.values())


def _serial_text(_: Path, data: bytes) -> None:
    from softfinger.drivers.serial import frames

    scratch, newest = np.zeros(frames.NUMBERS), np.zeros(frames.NUMBERS)
    for start in range(0, len(data), 200):
        piece = data[start : start + 200]
        buffer = np.zeros(frames.LOOKBACK + 256, np.uint8)
        buffer[frames.LOOKBACK : frames.LOOKBACK + len(piece)] = np.frombuffer(piece, np.uint8)
        size = frames.decode_stream(buffer.ctypes.data, len(piece), scratch, newest)
        _finite_or_refused(size > 0, newest.tolist())


def _serial_described(_: Path, data: bytes) -> None:
    from helpers.rig_files import rig_options
    from softfinger.drivers.fields import table
    from softfinger.drivers.serial import packets

    for rig in ("haply-2diy", "hapkit"):
        frame = rig_options(rig).frames.input
        shape, fields = packets.make_shape(frame, False), table.make_input_table(frame.field)
        numbers = np.zeros(table.SENSED_SIZE), np.zeros(table.SENSED_SIZE)
        buffer = np.zeros(len(data) + frame.bytes, np.uint8)
        buffer[: len(data)] = np.frombuffer(data, np.uint8)
        where = (fields.ctypes.data, len(fields), np.zeros(1, np.int64).ctypes.data)
        for aligned in (False, True):
            filled = np.array([len(data)])
            size = packets.decode_stream(buffer.ctypes.data, filled, aligned, shape.ctypes.data, where, numbers)
            assert 0 <= filled[0] <= len(data)
            _finite_or_refused(size > 0, numbers[1].tolist())


def _falcon(_: Path, data: bytes) -> None:
    from softfinger.drivers.block import Block
    from softfinger.drivers.falcon import conversion
    from softfinger.drivers.falcon.block import AT

    block = Block(AT)
    real = block.word.view(np.float64)
    real[AT.position : AT.position + 3] = real[AT.centre : AT.centre + 3] = conversion.HOME
    for byte in data:
        if conversion.process_byte(block.handle, byte):
            conversion.convert_reply(block.handle)
            place = real[AT.sample : AT.sample + 3].tolist()
            assert all(map(isnan, place)) or hypot(*place) < 1.0, place


def _spacemouse(_: Path, data: bytes) -> None:
    from softfinger.drivers.spacemouse import puck

    deflection, buttons = np.zeros(6), np.zeros(1)
    padded = np.frombuffer(data.ljust(64, b"\0"), np.uint8)
    puck.decode(padded, len(data), deflection, buttons)
    _finite_or_refused(True, [*deflection.tolist(), *buttons.tolist()])


def _frames(_: Path, data: bytes) -> None:
    """Numbers that a vendor's library returns as a pose: twelve from Force Dimension, a matrix from libHD."""
    from softfinger.drivers.block import Block
    from softfinger.drivers.forcedimension import exchange as forcedimension
    from softfinger.drivers.openhaptics import block as hd
    from softfinger.drivers.openhaptics import exchange as openhaptics

    numbers = np.frombuffer(data.ljust(160, b"\0")[:160], np.float64)
    theirs = Block(forcedimension.AT)
    theirs.numbers(forcedimension.AT.frame, 12)[:] = numbers[:12]
    sample = np.zeros(9)
    forcedimension._convert_pose(theirs.handle, sample)
    _turned_or_nothing(sample[3:7].tolist())
    theirs = Block(hd.AT)
    theirs.numbers(hd.AT.position, 3)[:] = numbers[:3]
    theirs.numbers(hd.AT.matrix, 16)[:] = numbers[3:19]
    _turned_or_nothing(openhaptics._make_pose(theirs.handle)[3:7].tolist())


def _turned_or_nothing(orientation: list[float]) -> None:
    assert all(map(isnan, orientation)) or abs(hypot(*orientation) - 1.0) < 0.01, orientation


def _haply_seeds() -> list[bytes]:
    place, turn = {"x": 0.01, "y": 0.1, "z": 0.02}, {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}
    state = {
        "inverse3": [{"device_id": "049D", "state": {"cursor_position": place}, "status": {"ready": True}}],
        "wireless_verse_grip": [{"device_id": "7", "state": {"orientation": turn, "buttons": {"a": True}}}],
    }
    listed = {"session_id": 1, "inverse3": [{"device_id": "049D", "config": {"mount": None}}]}
    return [json.dumps(message).encode() for message in (state, listed)]


def _haply(_: Path, data: bytes) -> None:
    from softfinger.drivers.haply.messages import DeviceRef, Malformed, read_inventory, read_state

    with suppress(Malformed):
        read_inventory(data)
    pose = read_state(data, DeviceRef("inverse3", "049D"), DeviceRef("wireless_verse_grip", "7"))
    assert hypot(*pose.position) <= 10.0 or all(map(isnan, pose.position)), pose
    _turned_or_nothing(list(pose.orientation))
