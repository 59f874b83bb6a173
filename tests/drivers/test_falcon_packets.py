"""Packets of the Falcon: published examples, all counts, and noise."""

from collections.abc import Callable

import numpy as np
import pytest
from helpers.examples import Cases

from softfinger.drivers.base import FORCE_OFF, OK
from softfinger.drivers.block import Block
from softfinger.drivers.falcon import conversion, packets
from softfinger.drivers.falcon.block import AT
from softfinger.drivers.falcon.conversion import FALCON, HOME, RAD_PER_COUNT, THETA_ZERO
from softfinger.drivers.kinematics.delta import compute_leg_angles
from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.proxy.kernels.jit.memory import uint8_at

pytestmark = pytest.mark.plain


def packet(motors: tuple[int, int, int], state: int) -> bytes:
    out = np.zeros(packets.SIZE, np.uint8)
    packets.encode(motors, state, out)
    return out.tobytes()


@pytest.mark.parametrize(
    ("motors", "state", "wire"),
    [
        ((4095, 3906, 4034), packets.BLUE, "3c 50 50 50 41 43 45 50 41 43 4d 50 41 45 41 3e"),
        ((-65, 136, -159), packets.BLUE, "3c 50 4c 50 50 49 49 41 41 42 47 50 50 45 41 3e"),
    ],
)
def test_published_packets(motors: tuple[int, int, int], state: int, wire: str) -> None:
    assert packet(motors, state).hex(" ") == wire
    assert packets.decode(np.frombuffer(bytes.fromhex(wire), np.uint8)) == (motors, state)


def blank() -> np.ndarray:
    word = Block(AT).word
    real = word.view(np.float64)
    real[AT.position : AT.position + 3] = real[AT.centre : AT.centre + 3] = HOME
    return word


@entry
def _stream(handle: int, data: np.ndarray, out: np.ndarray) -> int:
    came = 0
    for byte in data:
        if conversion.process_byte(handle, byte):
            counts, _ = packets.decode(uint8_at(handle + 8 * AT.newest))
            for k in range(3):
                out[came, k] = counts[k]
            came += 1
    return came


@pytest.mark.scaled
def test_packets_with_noise_between(cases: Callable[[int, int], int]) -> None:
    rng = np.random.default_rng(3)
    number = cases(5000, 1_000_000)
    counts = rng.integers(-32768, 32768, (number, 3))
    wire = np.full((number, 24), 0x41, np.uint8)  # up to eight bytes of noise before each
    wire[:, :8] = rng.integers(0x3D, 0x100, (number, 8))  # bytes above '<', which would start a packet
    wire[::3, 3] = ord("<")  # start of a truncated packet
    wire[:, 8] = ord("<")
    for axis in range(3):
        for nibble in range(4):
            wire[:, 9 + 4 * axis + nibble] += ((counts[:, axis] >> (4 * nibble)) & 15).astype(np.uint8)
    wire[:, 21] += rng.integers(0, 128, number).astype(np.uint8)
    wire[:, 23] = ord(">")
    out, word = np.zeros((number + 10, 3), np.int64), blank()
    assert _stream(word.ctypes.data, wire.reshape(-1), out) == number
    np.testing.assert_array_equal(out[:number], counts)
    assert word[AT.garbled] >= number


@pytest.mark.parametrize("broken", [n for n in range(16) if n != packets.FILLER])
def test_a_packet_with_one_wrong_byte_is_dropped(broken: int) -> None:
    wire = bytearray(packet((1, 2, 3), 0))
    wire[broken] = 0x20
    word = blank()
    assert _stream(word.ctypes.data, np.frombuffer(bytes(wire), np.uint8), np.zeros((2, 3), np.int64)) == 0


@pytest.mark.parametrize("filler", [0x00, 0x20, 0x3E, 0x42, 0xFF])
def test_the_filler_byte_may_have_any_value(filler: int) -> None:
    wire = bytearray(packet((1, 2, 3), 0) * 3)
    wire[packets.FILLER] = filler
    word, out = blank(), np.zeros((3, 3), np.int64)
    assert _stream(word.ctypes.data, np.frombuffer(bytes(wire), np.uint8), out) == 3
    assert out.tolist() == [[1, 2, 3]] * 3
    assert (word[AT.fillers], word[AT.garbled]) == (1, 0)


def answer(word: np.ndarray, counts: tuple[int, int, int], state: int) -> int:
    word.view(np.uint8)[8 * AT.newest : 8 * AT.newest + 16] = np.frombuffer(packet(counts, state), np.uint8)
    return conversion.convert_reply(word.ctypes.data)


@pytest.mark.scaled
def test_any_counts_give_a_matching_position_or_none(cases: Cases) -> None:
    rng, count = np.random.default_rng(5), cases(500, 2000)
    word = blank()
    sample = word.view(np.float64)[AT.sample : AT.sample + 9]
    for row in rng.integers(-32768, 32768, (count, 3)).tolist() + rng.integers(-1500, 1500, (count, 3)).tolist():
        assert answer(word, (row[0], row[1], row[2]), packets.HOMED) == OK
        if np.isfinite(sample[:3]).all():
            theta, _ = compute_leg_angles(FALCON, (sample[0], sample[2], 0.11 - sample[1]))
            wanted = THETA_ZERO + RAD_PER_COUNT * np.array(row)
            np.testing.assert_allclose(theta, wanted, atol=1e-11)  # the position is rounded to 1e-17 m of 0.1 m
        else:
            assert np.isnan(sample[:3]).all()
    assert 0 < word[AT.unreached] < 2 * count


def test_buttons_and_lost_homing() -> None:
    word = blank()
    word[AT.armed] = 1
    assert answer(word, (0, 0, 0), 0x05) == OK  # no homing bits yet
    assert word.view(np.float64)[AT.sample + 8] == 5.0 and answer(word, (0, 0, 0), 0x70) == OK
    assert answer(word, (0, 0, 0), 0x30) == FORCE_OFF
