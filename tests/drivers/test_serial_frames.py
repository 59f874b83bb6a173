"""Text frames: published examples, exact numbers, random bytes, resynchronisation of a stream."""

import re
from collections.abc import Callable
from math import floor
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfinger.drivers.serial import frames
from softfinger.drivers.serial.frames import FRAME_BYTES, LOOKBACK, NUMBERS
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
    assert encode(0.0, -0.0, 0.0) == pad_frame(b"0 0 0 2 0 0 0")
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
