"""Frames of text and of bytes: published examples and checksums, exact numbers, random bytes, damaged streams, invalid
descriptions."""

import re
import struct
from collections.abc import Callable
from math import floor
from typing import Any

import numpy as np
import pytest
from helpers.refusals import refusal
from helpers.rig_files import with_key
from hypothesis import given
from hypothesis import strategies as st

from softfinger.config.load import build, load_rig
from softfinger.drivers.fields import table
from softfinger.drivers.serial import frames, packets
from softfinger.drivers.serial.device import Options, _encode_frame
from softfinger.drivers.serial.frames import FRAME_BYTES, LOOKBACK, NUMBERS
from softfinger.drivers.serial.options import CHECKS, Checksum, Frame, InputFrame
from softfinger.proxy.kernels.jit.decorators import entry

pytestmark = pytest.mark.plain

# A frame in the maker's program, from its device (haptikfabrikenapi, src/uhaptikfabriken.h).
PUBLISHED = b" -59.276   13.383 -148.002   0.0919 -1.8483  1.0370 -1.9512 0"
NUMBER = rb"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)"
FRAME = re.compile(rb" *(" + NUMBER + rb")" + 6 * (rb" +(" + NUMBER + rb")") + rb" +([+-]?[0-9]+)[ \n]*\n")


def pad_frame(text: bytes) -> bytes:
    return text.ljust(FRAME_BYTES - 1) + b"\n"


@entry
def decode_all(rows: Any, values: Any, usable: Any) -> None:
    for n in range(len(rows)):
        usable[n] = frames.decode(rows[n].ctypes.data, values[n])


@entry
def feed(stream: Any, sizes: Any, buffer: Any, scratch: Any, results: Any) -> int:
    at = came = 0
    newest = scratch[1]
    for size in sizes:
        for k in range(size):
            buffer[LOOKBACK + k] = stream[at + k]
        at += size
        if frames.decode_stream(buffer.ctypes.data, size, scratch[0], newest) > 0:
            for k in range(NUMBERS):
                results[came, k] = newest[k]
            came += 1
    return came


def decode(*messages: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Return numbers (n, NUMBERS) of frames, and which of them are valid."""
    rows = np.frombuffer(b"".join(messages), np.uint8).reshape(-1, FRAME_BYTES)
    values, usable = np.full((len(rows), NUMBERS), np.nan), np.zeros(len(rows), np.bool_)
    decode_all(rows, values, usable)
    return values, usable


def encode(*force: float) -> bytes:
    out = np.zeros(FRAME_BYTES + 1, np.uint8)
    frames.encode(force, out.ctypes.data)
    assert out[-1] == 0
    return out[:-1].tobytes()


def parse_text(frame: bytes) -> list[float] | None:
    match = FRAME.fullmatch(frame)
    if match is None or any(sum(48 <= c <= 57 for c in text) > frames.DIGITS_MAX for text in match.groups()):
        return None
    values = [float(text) for text in match.groups()]
    largest = [frames.REACH_MM] * 3 + [frames.ANGLE_MAX_RAD] * 4 + [frames.INFO_MAX]
    return values if all(abs(value) <= most for value, most in zip(values, largest, strict=True)) else None


@pytest.mark.parametrize("end", [b"", b"\n"], ids=["one newline", "two newlines"])
def test_the_published_frame(end: bytes) -> None:
    values, usable = decode(pad_frame(PUBLISHED + end))
    assert usable.all()
    assert values[0].tolist() == [-59.276, 13.383, -148.002, 0.0919, -1.8483, 1.0370, -1.9512, 0.0]


def test_frames_to_the_device() -> None:
    assert encode(0.1, -2.0, 3.3333) == pad_frame(b"100 -2000 3333 2 0 0 0")
    assert encode(0.0, -0.0, 0.0) == frames.ZERO == pad_frame(b"0 0 0 2 0 0 0")
    assert encode(-0.0004, 0.0006, 0.009) == pad_frame(b"0 1 9 2 0 0 0")
    assert encode(32.0, -32.0, 10.0) == pad_frame(b"32000 -32000 10000 2 0 0 0")


@given(st.tuples(*[st.floats(-32.0, 32.0)] * 3))
def test_forces_are_rounded_to_a_millinewton(force: tuple[float, float, float]) -> None:
    words = encode(*force).split()
    assert [int(word) for word in words] == [*(floor(1e3 * f + 0.5) for f in force), 2, 0, 0, 0]


@pytest.mark.parametrize(
    "text",
    [
        b"nan 0 0 0 0 0 0 0", b"0 inf 0 0 0 0 0 0", b"0 0 -inf 0 0 0 0 0", b"1e3 0 0 0 0 0 0 0", b"0x1 0 0 0 0 0 0 0",
        b"0 0 0 0 0 0 0", b"0 0 0 0 0 0 0 0 0", b"0 0 0 0 0 0 0 0.0", b"0 0 0 0 0 0 0 32769", b"- 0 0 0 0 0 0 0",
        b"1.2.3 0 0 0 0 0 0 0", b"-59.276-13.383 0 0 0 0 0 0", b". 0 0 0 0 0 0 0", b"10000.1 0 0 0 0 0 0 0",
        b"0 0 0 100.1 0 0 0 0", b"1234567890123 0 0 0 0 0 0 0", b"0.0000000000000 0 0 0 0 0 0 0", b"0\n0 0 0 0 0 0 0",
        b"\n0 0 0 0 0 0 0 0", b"0\t0 0 0 0 0 0 0", b"0 0 0 0 0 0 0 0\0", b"0 0 0 0 0 0 0 0 x", b"", b"9" * 63,
    ],
)  # fmt: skip
def test_invalid_frames_are_rejected(text: bytes) -> None:
    assert not decode(pad_frame(text))[1].any() and parse_text(pad_frame(text)) is None
    assert not decode(pad_frame(PUBLISHED)[:-1] + b" ")[1].any()  # without a newline at its end


@pytest.mark.scaled
def test_damaged_frames(cases: Callable[[int, int], int]) -> None:
    generator = np.random.default_rng(17)
    alphabet = np.frombuffer(b"0123456789" * 4 + b" .-+ .-+einfax,\n\r\0\xff\x80", np.uint8)
    base = np.frombuffer(pad_frame(PUBLISHED) + pad_frame(PUBLISHED + b"\n"), np.uint8).reshape(2, FRAME_BYTES)
    accepted, block = 0, cases(20_000, 100_000)
    blocks = cases(1, 10)
    for _ in range(blocks):
        rows = np.tile(base, (block // 2, 1))
        for _ in range(3):
            at = generator.integers(0, FRAME_BYTES, block)
            rows[np.arange(block), at] = alphabet[generator.integers(0, len(alphabet), block)]
        values, usable = np.full((block, NUMBERS), np.nan), np.zeros(block, np.bool_)
        decode_all(rows, values, usable)
        good = values[usable]
        accepted += len(good)
        assert np.isfinite(good).all() and np.abs(good[:, :3]).max() <= frames.REACH_MM
        assert np.abs(good[:, 3:7]).max() <= frames.ANGLE_MAX_RAD
        for n in range(cases(1000, 2000)):
            numbers = parse_text(rows[n].tobytes())
            assert (numbers is not None) == usable[n], rows[n].tobytes()
            assert numbers is None or numbers == values[n].tolist()
    assert 0.1 < accepted / (blocks * block) < 0.9


def numbered_frame(n: int) -> bytes:
    """Return a frame with `n` in each number, so that a frame made of two is detectable; the ends alternate."""
    mm, rad = n / 1e3, n / 1e4
    text = f"{mm: 8.3f} {-mm: 8.3f} {2 * mm: 8.3f} {rad: 7.4f} {-rad: 7.4f} {rad: 7.4f} 0 {n}"
    return pad_frame(text.encode() + b"\n" * (n % 2))


@pytest.mark.scaled
def test_a_damaged_stream_is_resynchronised(cases: Callable[[int, int], int]) -> None:
    """Frames with bytes removed, repeated, changed and inserted, in pieces of any size: each valid frame after a valid
    frame is found, and no other is read. No two neighbours are damaged, and none by the length of a frame: if just 64
    bytes of two frames remain, the format cannot detect it."""
    generator = np.random.default_rng(23)
    stream, whole, count = bytearray(), [], cases(4000, 20_000)
    for n in range(count):
        frame = numbered_frame(n)
        kind = generator.integers(0, 8) if not whole or whole[-1] else None
        at, size = generator.integers(0, FRAME_BYTES), int(generator.integers(1, 40))
        if kind == 0:
            frame = frame[:at] + frame[at + size :]
        elif kind == 1:
            frame = frame[:at] + frame[at : at + size] + frame[at:]
        elif kind == 2:
            frame = frame[:at] + generator.bytes(size) + frame[at:]
        whole.append(frame == numbered_frame(n))
        stream += frame
    sizes = generator.integers(1, FRAME_BYTES + 1, len(stream) // 16)  # so that a piece completes at most one frame
    sizes = sizes[np.cumsum(sizes) <= len(stream)]
    rows_out = np.zeros((len(sizes), NUMBERS))
    buffer = np.full(LOOKBACK + FRAME_BYTES, frames.NEWLINE, np.uint8)
    rows_out = rows_out[: feed(np.frombuffer(bytes(stream), np.uint8), sizes, buffer, np.zeros((2, NUMBERS)), rows_out)]
    tells = rows_out[:, 7]
    for column, scale in enumerate((1e3, -1e3, 500.0, 1e4, -1e4, 1e4)):
        np.testing.assert_allclose(rows_out[:, column] * scale, tells, atol=1e-6)  # rounding of numbers below 2e4
    assert (np.diff(tells) > 0).all()
    certain = {n for n in range(1, count - 1) if whole[n] and whole[n - 1]}
    assert certain <= set(tells.astype(int).tolist()) and len(certain) > count // 4
    assert not all(whole)


DIGITS = b"123456789"
CHECKSUMS = {"sum8": 0xDD, "xor8": 0x31, "crc8": 0xF4, "crc16-ccitt": 0x29B1, "crc16-modbus": 0x4B37}
"""Of the digits 1 to 9; the CRCs are CRC-8/SMBUS, CRC-16/IBM-3740 and CRC-16/MODBUS of the reveng catalogue."""


@entry
def feed_packets(stream: Any, sizes: Any, buffer: Any, filled: Any, how: Any, memory: Any, counts: Any) -> int:
    shape, fields, scratch, spare, newest = memory
    at = came = 0
    for size in sizes:
        for k in range(size):
            buffer[filled[0] + k] = stream[at + k]
        filled[0] += size
        at += size
        tables = (fields.ctypes.data, how[1], scratch.ctypes.data)
        if (
            packets.decode_stream(buffer.ctypes.data, filled, how[0] != 0, shape.ctypes.data, tables, (spare, newest))
            > 0
        ):
            counts[came] = newest[table.COUNTS]
            came += 1
    return came


def decode_counts(
    frame: InputFrame, stream: bytes, sizes: Any, aligned: bool = False, big: bool = False
) -> list[float]:
    fields = table.make_input_table(frame.field, big)
    buffer, counts = np.zeros(2 * frame.bytes + 2048, np.uint8), np.zeros(len(sizes))
    memory = (
        packets.make_shape(frame, big), fields, np.zeros(1, np.int64),
        np.zeros(table.SENSED_SIZE), np.zeros(table.SENSED_SIZE),
    )  # fmt: skip
    data = np.frombuffer(stream, np.uint8)
    how = np.array([aligned, len(fields)])
    count = feed_packets(data, np.array(sizes), buffer, np.zeros(1, np.int64), how, memory, counts)
    return counts[:count].tolist()


@pytest.mark.parametrize("kind", CHECKS)
@pytest.mark.parametrize("big", [False, True])
def test_checksums_of_the_catalogue(kind: Any, big: bool) -> None:
    frame = Frame(bytes=12, check=Checksum(kind=kind, offset=10, first=1))
    shape = packets.make_shape(frame, big)
    data = np.frombuffer(b"!" + DIGITS + b"\0\0", np.uint8).copy()
    packets.complete_frame(data.ctypes.data, shape.ctypes.data)
    size = 2 if CHECKSUMS[kind] > 0xFF else 1
    assert int.from_bytes(data[10 : 10 + size].tobytes(), "big" if big else "little") == CHECKSUMS[kind]
    rows = InputFrame(bytes=12, check=frame.check, field=build_fields("uint8", 5))
    assert decode_counts(rows, data.tobytes(), [12], big=big) == [ord("5")]
    for at in range(1, 10 + size):
        damaged = data.copy()
        damaged[at] ^= 0x10
        assert decode_counts(rows, damaged.tobytes(), [12], big=big) == []


def build_fields(kind: str, offset: int, **more: Any) -> Any:
    wanted = {"bytes": 12, "field": [{"meaning": "a", "offset": offset, "type": kind, **more}]}
    return build(InputFrame, wanted, "frame").field


def numbered_packet(n: int) -> bytes:
    frame = Frame(bytes=6, start=(0xA5,), check=Checksum(kind="crc8", offset=5))
    data, shape = (
        np.frombuffer(b"\xa5" + struct.pack("<i", n) + b"\0", np.uint8).copy(),
        packets.make_shape(frame, False),
    )
    packets.complete_frame(data.ctypes.data, shape.ctypes.data)
    return data.tobytes()


@pytest.mark.scaled
def test_a_damaged_stream_of_packets_is_resynchronised(cases: Callable[[int, int], int]) -> None:
    rng = np.random.default_rng(41)
    stream, whole, count = bytearray(), [], cases(2500, 10_000)
    for n in range(count):
        frame, at = numbered_packet(n), int(rng.integers(0, 6))
        match int(rng.integers(0, 12)):
            case 0:
                frame = frame[:at] + frame[at + 1 :]
            case 1:
                frame = frame[:at] + frame[at : at + 2] + frame[at:]
            case 2:
                frame = frame[:at] + rng.bytes(int(rng.integers(1, 20))) + frame[at:]
            case 3:
                frame = frame[:at] + bytes([frame[at] ^ 0x21]) + frame[at + 1 :]
        whole.append(frame == numbered_packet(n))
        stream += frame
    sizes = rng.integers(1, 7, len(stream) // 3)
    sizes = sizes[np.cumsum(sizes) <= len(stream)]
    layout = InputFrame(
        bytes=6, start=(0xA5,), check=Checksum(kind="crc8", offset=5), field=build_fields("int32", 1, least=0, most=1e5)
    )
    counts = decode_counts(layout, bytes(stream), sizes)
    # a piece of six bytes may complete one frame and contain another: the later of two in a piece counts
    rising = [n for n in counts if n == int(n) and int(n) < count]
    wrong = len(counts) - len(rising) + int((np.diff(rising) <= 0).sum())
    assert wrong <= 10  # at most some 3000 damaged frames, each with a few marks in it, 1 in 256 of which pass
    certain = {n for n in range(2, count - 10) if whole[n] and whole[n - 1] and whole[n - 2]}
    assert len(certain) > count // 4 and len(certain - {int(n) for n in counts}) <= 10


def test_an_answer_without_a_checksum_is_known_by_its_length() -> None:
    frame = InputFrame(bytes=9, start=(5,), field=build_fields("float32", 5, least=-4.0, most=4.0))
    answer = b"\x05" + struct.pack("<ff", 1.0, 0.5)
    assert decode_counts(frame, answer, [9], aligned=True) == [0.5]
    assert decode_counts(frame, answer, [4, 5], aligned=True) == [0.5]
    assert decode_counts(frame, 2 * answer, [9, 9], aligned=True) == [0.5, 0.5]
    assert decode_counts(frame, 2 * answer, [12, 6], aligned=True) == [0.5]
    assert decode_counts(frame, answer[:-1], [8], aligned=True) == []
    assert decode_counts(frame, answer + b"\x05", [10], aligned=True) == []
    assert decode_counts(frame, 2 * answer, [18], aligned=True) == [0.5]
    for damaged in (b"\x06" + answer[1:], b"\x06" + answer[1:] + answer, answer + b"\x06" + answer[1:]):
        assert decode_counts(frame, damaged, [len(damaged)], aligned=True) == []
    for bad in (float("nan"), float("inf"), 5.0):
        assert decode_counts(frame, b"\x05" + struct.pack("<ff", 1.0, bad), [9], aligned=True) == []
    shipped = build(Options, load_rig("haply-2diy").device.options, "haply-2diy").frames
    for degrees, counts in ((140.0, 1), (400.0, 0)):
        answer = b"\x05" + struct.pack("<ff", 40.0, degrees)
        assert len(decode_counts(shipped.input, answer, [9], aligned=True)) == counts


def test_shipped_frames_byte_by_byte() -> None:
    frames = build(Options, load_rig("haply-2diy").device.options, "haply-2diy").frames
    assert frames is not None and frames.setup is not None
    assert _encode_frame(frames.output, frames) == b"\x02\x05" + bytes(8)
    # HaplyHAPI 1.0.1, version 3: motor and encoder 1 on port 2, both turning 1, offsets 168 and 12, 4880 counts
    numbers = struct.pack("<4f", 12.0, 4880.0, 168.0, 4880.0)
    assert _encode_frame(frames.setup, frames) == bytes([1, 5, 3, 1, 1, 3, 1, 1, 0, 0]) + numbers
    frames = build(Options, load_rig("hapkit").device.options, "hapkit").frames
    assert frames is not None and _encode_frame(frames.output, frames) == b"\x5a\x00\x00\xa3"


CHANGES: list[tuple[str, Any, str]] = [
    ("frames.input.check.kind", "crc7", "check.kind = 'crc7': must be one of 'crc16-ccitt'"),
    ("frames.input.check.offset", 4, r"field\[0\].offset = 1: byte 4 belongs to check"),
    ("frames.input.check.offset", 6, "byte 6 is beyond a frame of 6: move it"),
    ("frames.input.check.first", 5, "check.first = 5: must be below offset = 5"),
    ("frames.input.field.0.offset", 0, r"field\[0\].offset = 0: byte 0 belongs to start"),
    ("frames.input.field.0.offset", 4, r"field\[0\].offset = 4: bytes 4 to 7 exceed a frame of 6"),
    ("frames.input.field.0.meaning", "b", "frames.input.field: has no a, required for paddle"),
    ("frames.output.field.0.meaning", "force_x", "frames.output.field: has no torque_a, required for paddle"),
    ("frames.input.check", None, "a stream needs a check, or start and end"),
    ("frames.setup", {"bytes": 1, "field": [{"meaning": "torque_a", "offset": 0, "type": "int8"}]}, "must be constant"),
    ("kinematics", None, "and frames belong together: set both or none"),
    ("baud", 12345, "baud = 12345: must be one of"),
    ("force_max_n", 33.0, "force_max_n = 33.0: must be a number from 0 to 32"),
    ("timeout_s", 0.01, "timeout_s = 0.01: must be at least quiet_s = 0.02"),
    ("product_id", 0x0483, "product_id = 1155: vendor_id and product_id belong together"),
]


@pytest.mark.parametrize(
    ("path", "value", "message"), CHANGES, ids=[f"{path} {value}"[:40] for path, value, _ in CHANGES]
)
def test_a_description_that_cannot_be_is_refused(path: str, value: Any, message: str) -> None:
    options = with_key(load_rig("hapkit").device.options, path, value)
    text = refusal(build, Options, options, "rig [device]")
    assert re.search(message, text), text
