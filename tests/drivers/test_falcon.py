"""Falcon: packets (published examples, all counts, noise) and kinematics (published positions and torques, inversion
over the workspace, Jacobian, limits)."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from emulators import falcon as other
from helpers.examples import Cases

from softfinger.config.load import build, load_rig
from softfinger.drivers.base import FORCE_OFF, OK
from softfinger.drivers.block import Block
from softfinger.drivers.falcon import conversion, packets
from softfinger.drivers.falcon.block import AT
from softfinger.drivers.falcon.conversion import FALCON, HOME, RAD_PER_COUNT, THETA_ZERO, compute_motor_counts
from softfinger.drivers.falcon.device import Options
from softfinger.drivers.falcon.options import COUNTS_PER_NM
from softfinger.drivers.kinematics.delta import compute_leg_angles, compute_torques, forward
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


RADIUS_M = 0.04
SEED = 7


def angles(*counts: float) -> tuple[float, float, float]:
    a, b, c = (THETA_ZERO + RAD_PER_COUNT * n for n in counts)
    return a, b, c


def places(number: int) -> np.ndarray:
    """Return positions (number, 3) m in the device's frame, uniform over the workspace."""
    rng = np.random.default_rng(SEED)
    direction = rng.normal(size=(number, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    return direction * RADIUS_M * np.cbrt(rng.random((number, 1))) + HOME


@pytest.mark.parametrize(
    ("counts", "place_mm"),
    [
        ((0, 0, 0), (0, 0, 134.602)),
        ((500, 500, 500), (0, 0, 156.860)),
        ((-500, -500, -500), (0, 0, 110.754)),
        ((300, -200, 100), (14.528, -11.579, 136.148)),
        ((-60, 400, -700), (-35.650, -11.603, 121.938)),
    ],
)
def test_published_positions(counts: tuple[int, int, int], place_mm: tuple[float, float, float]) -> None:
    place, converged = forward(FALCON, angles(*counts), HOME)
    assert converged
    np.testing.assert_allclose(1e3 * np.array(place), place_mm, rtol=0, atol=5.001e-4)  # half of the last digit


def test_published_torques() -> None:
    for force, torque_mnm, digit in (
        ((1.0, 0.0, 0.0), (15.488, -52.725, 37.237), 1e-3),
        ((0.0, 0.0, 1.0), (24.18, 24.18, 24.18), 1e-2),
    ):
        torque, able = compute_torques(FALCON, HOME, force)
        assert able
        np.testing.assert_allclose(1e3 * np.array(torque), torque_mnm, rtol=0, atol=0.5001 * digit)


@pytest.mark.scaled
def test_forward_inverts_inverse_over_the_workspace(cases: Cases) -> None:
    count = cases(5000, 100_000)
    near = np.random.default_rng(SEED + 1).uniform(-1e-3, 1e-3, (count, 3))
    worst = 0.0
    for place, off in zip(places(count).tolist(), near.tolist(), strict=True):
        theta, _ = compute_leg_angles(FALCON, tuple(place))
        start = HOME if off[0] > 0.0 else (place[0] + off[0], place[1] + off[1], place[2] + off[2])
        position, converged = forward(FALCON, theta, start)
        assert converged, place
        worst = max(worst, math.dist(place, position))
    assert worst < 1e-9


def test_a_failed_search_restarts_at_the_centre() -> None:
    for place in places(100):
        theta, _ = compute_leg_angles(FALCON, tuple(place))
        for last in ((math.nan, 0.0, 0.11), (0.5, -0.5, -0.4)):
            position, converged = forward(FALCON, theta, last)
            assert converged and math.dist(place, position) < 1e-9


def test_torques_do_the_work_of_the_force() -> None:
    rng = np.random.default_rng(SEED)
    h = 1e-6
    for place in places(300):
        force, motion = rng.normal(size=3), rng.normal(size=3)
        torque, able = compute_torques(FALCON, tuple(place), tuple(force))
        assert able
        ahead, _ = compute_leg_angles(FALCON, tuple(place + h * motion))
        behind, _ = compute_leg_angles(FALCON, tuple(place - h * motion))
        turned = (np.array(ahead) - np.array(behind)) / (2 * h)
        assert np.dot(torque, turned) == pytest.approx(force @ motion, abs=1e-6)  # as the differences above


def test_two_derivations_of_the_legs_agree() -> None:
    for place in places(300):
        theta, _ = compute_leg_angles(FALCON, tuple(place))
        theirs = [other.leg_angle(leg, tuple(place)) for leg in other.LEGS]
        np.testing.assert_allclose(theta, theirs, rtol=0, atol=1e-12)  # acos near 1 loses four digits


@pytest.mark.parametrize("counts", [(32767, -32768, 0), (-3000, -3000, -3000), (2500, 2500, 2500), (math.nan, 0, 0)])
def test_counts_without_a_position_are_not_found(counts: tuple[float, float, float]) -> None:
    assert not forward(FALCON, angles(*counts), HOME)[1]


def test_no_force_out_of_reach() -> None:
    for place in ((0.2, 0.0, 0.11), (0.0, 0.0, 0.4), (math.nan, 0.0, 0.11), (0.0, 0.0, -0.1)):
        torque, able = compute_torques(FALCON, place, (0.0, 0.0, 1.0))
        assert not able
        assert torque == (0.0, 0.0, 0.0)
        assert compute_motor_counts(10000.0, place, (0.0, 0.0, 1.0)) == ((0, 0, 0), True)


RECORDED = {
    (0.0, 0.0, -100.0): (4095, 3906, 4034),
    (0.0, 0.0, -50.0): (2752, 2780, 2888),
    (0.0, 0.0, -25.0): (1311, 1453, 1526),
    (0.0, 0.0, -12.5): (661, 731, 766),
    (0.0, -12.5, 0.0): (-2900, 27, 929),
    (-12.5, 0.0, 0.0): (399, -3087, 1135),
    (1.0, 0.0, 0.0): (-65, 136, -159),
    (10.0, 0.0, 0.0): (-679, 2529, -1862),
    (0.0, 10.0, 0.0): (2481, -669, -1691),
}
"""Motor counts that the maker's driver sent for a force (N): packets traced by libnifalcon's author."""


def test_motors_turn_as_in_recorded_packets() -> None:
    options = build(Options, load_rig("falcon").device.options, "falcon [device]")
    gain = -COUNTS_PER_NM if options.motors_reversed else COUNTS_PER_NM
    for force, recorded in RECORDED.items():
        counts, _ = compute_motor_counts(gain, HOME, force)
        assert np.sign(counts).tolist() == np.sign(recorded).tolist(), force


def test_counts_are_scaled_together() -> None:
    force = (3.0, -2.0, 60.0)
    wanted = 10000.0 * np.array(compute_torques(FALCON, HOME, force)[0])
    counts, cut = compute_motor_counts(10000.0, HOME, force)
    assert cut
    assert max(map(abs, counts)) == 4095
    np.testing.assert_allclose(counts, wanted * 4095 / np.abs(wanted).max(), atol=0.5)  # integer counts
    few, cut = compute_motor_counts(10000.0, HOME, (0.0, 0.0, 1.0))
    assert not cut
    assert few == (242, 242, 242)
    assert compute_motor_counts(-10000.0, HOME, (0.0, 0.0, 1.0))[0] == (-242, -242, -242)
