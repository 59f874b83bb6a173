"""Fingertip on a plane: acceptance cases with results worked out by hand.

The plane of conftest.paper_mapping: r = 10 mm, K_n = K_t = k_tau = 1000 N/m, pressed 1 mm so that f_N = 1 N, mu 0.6 /
0.5, k_z = 0.05 N m/rad, mu_t = 4 mm, no damping, 1 kHz. EXACT covers the rounding of a few hundred additions of forces.
"""

import numpy as np
import pytest
from references.hand import on_plane, pressed

from softfinger.proxy.record import ROLLING, SLIDING

pytestmark = pytest.mark.plain

R = 0.01
EXACT = 1e-12


def test_press() -> None:
    trace = on_plane(pressed().go(100))
    assert trace.force[0] == pytest.approx([0, 0, 0], abs=0)
    assert trace.force[1:] == pytest.approx(np.tile([0.0, 0.0, 1.0], (101, 1)), abs=EXACT)
    assert trace.torque == pytest.approx(np.zeros((102, 3)), abs=EXACT)
    assert trace.events == [(1, "touch")]


@pytest.mark.parametrize("ticks", [1, 10, 200])
def test_roll_at_a_fixed_position_winds_the_coupling(ticks: int) -> None:
    """A roll of 0.05 rad moves the proxy by r times as much, and the coupling pulls the probe towards it."""
    trace = on_plane(pressed().go(ticks, turn=[0.05, 0, 0]))
    last = trace.steps[-1]
    assert last.force == pytest.approx([0, -0.5, 1], abs=EXACT)
    assert last.torque == pytest.approx([-0.005, 0, 0], abs=EXACT)
    assert last.proxy_position == pytest.approx([0, -0.5e-3, R], abs=EXACT)
    assert last.point == pytest.approx([0, -0.5e-3, 0], abs=EXACT)
    assert last.finger_point == pytest.approx([0, -R * np.sin(0.05), -R * np.cos(0.05)], abs=EXACT)
    assert last.rolled == pytest.approx(0.05, abs=EXACT)
    assert last.spin == pytest.approx(0, abs=EXACT)
    assert last.mode == ROLLING
    assert trace.events == [(1, "touch")]


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("k_tau", "angle"), [(None, 0.06), (250.0, 0.24)])
def test_roll_past_theta_max_slides(k_tau: float | None, angle: float) -> None:
    """A roll at a fixed position slides at theta_max = mu_s f_N / (k_tau r): peak mu_s f_N, then mu_d f_N."""
    trace = on_plane(pressed().go(501, turn=[0.5, 0, 0]), rolling={"torque_stiffness_n_per_m": k_tau})
    assert trace.causes == ["touch", "theta_max"]
    tick = trace.events[1][0]
    # 501 ticks for 0.5 rad: theta_max is between two ticks.
    assert tick == 1 + int(np.ceil(angle * 501 / 0.5))
    assert trace.tangential.max() == pytest.approx(0.6, rel=EXACT)
    assert trace.tangential[tick] == pytest.approx(0.6, rel=EXACT)
    assert trace.force[tick + 1 :] == pytest.approx(np.tile([0, -0.5, 1], (501 - tick + 1, 1)), abs=EXACT)
    assert (trace.mode[tick:] == SLIDING).all()


def test_roll_with_the_probe_following() -> None:
    trace = on_plane(pressed().go(1000, move=[0, -R, 0], turn=[1, 0, 0]))
    assert trace.tangential.max() < 1e-12
    assert trace.proxy[-1] == pytest.approx([0, -R, R], abs=EXACT)
    assert trace.steps[-1].rolled == pytest.approx(1.0, abs=EXACT)
    assert trace.events == [(1, "touch")]


def test_drag_stop_and_drag_again() -> None:
    """Both drags peak at mu_s f_N and slide at mu_d f_N, with the proxy 0.5 mm behind; the stop sticks."""
    hand = pressed().go(500, move=[0.025, 0, 0])
    first_end = hand.at
    hand.go(300)
    second_start = hand.at
    hand.go(500, move=[0.025, 0, 0])
    trace = on_plane(hand)
    assert trace.causes == ["touch", "drag", "stop", "drag"]
    slips = [tick for tick, cause in trace.events if cause == "drag"]
    for slip, start, end in zip(slips, [1, second_start], [first_end, len(hand.poses) - 1], strict=True):
        assert trace.tangential[start : end + 1].max() == pytest.approx(0.6, rel=EXACT)
        assert trace.tangential[slip] == pytest.approx(0.6, rel=EXACT)
        assert trace.force[slip + 1 : end + 1, 0] == pytest.approx(-0.5, rel=EXACT)
        lag = trace.poses[slip + 1 : end + 1, 0] - trace.proxy[slip + 1 : end + 1, 0]
        assert lag == pytest.approx(0.5e-3, rel=1e-10)
    # The stop does not release the stored force.
    assert trace.force[first_end:second_start, 0] == pytest.approx(-0.5, rel=EXACT)


def test_drag_then_reverse() -> None:
    hand = pressed().go(500, move=[0.025, 0, 0])
    turn = hand.at
    hand.go(500, move=[-0.025, 0, 0])
    trace = on_plane(hand)
    assert trace.causes == ["touch", "drag", "reverse", "drag"]
    assert trace.force[: turn + 1, 0].min() == pytest.approx(-0.6, rel=EXACT)
    assert trace.force[turn:, 0].max() == pytest.approx(0.6, rel=EXACT)
    # The force on the hand rises from -0.5 N by K times the distance moved back, until the peak.
    peak = int(trace.force[:, 0].argmax())
    rise = np.diff(trace.force[turn:peak, 0])
    assert rise == pytest.approx(1000 * 50e-6, abs=1e-10)
    # Only the 0.5 mm stored by the drag unwind; after that the force opposes the motion.
    assert (trace.force[turn + 11 :, 0] > 0).all()
    # Work of the hand against the coupling: it never gets back more than it has put in.
    work = -np.cumsum(trace.force[1:, 0] * np.diff(trace.poses[:, 0]))
    assert work.min() > -1e-12
    stored = 0.5 * 1000 * (0.5e-3) ** 2
    assert work[turn:].min() >= work[turn - 1] - stored


def test_spin_and_back() -> None:
    """The anchor follows the slip at the torsional limit: 0.16 rad back reaches the limit in the other direction."""
    trace = on_plane(pressed().go(500, turn=[0, 0, 0.5]).go(160, turn=[0, 0, -0.16]))
    assert trace.steps[-1].torque == pytest.approx([0, 0, 0.004], abs=EXACT)


def test_roll_and_back() -> None:
    trace = on_plane(pressed().go(200, turn=[0.05, 0, 0]).go(200, turn=[-0.05, 0, 0]))
    assert trace.tangential[-1] < 1e-12
    assert trace.causes == ["touch"]


def test_roll_then_drag_against_it() -> None:
    """A roll of 0.03 rad uses half of the cone: a drag that adds to it slides after 0.3 mm."""
    hand = pressed().go(100, turn=[0.03, 0, 0])
    start = hand.at
    hand.go(143, move=[0, 1e-3, 0])
    trace = on_plane(hand)
    assert trace.causes == ["touch", "drag"]
    tick = trace.events[1][0]
    # 143 ticks for 1 mm: 0.3 mm is between two ticks.
    assert tick - start == int(np.ceil(0.3 * 143))
    assert trace.tangential.max() == pytest.approx(0.6, rel=EXACT)
    assert trace.tangential[tick + 1 :] == pytest.approx(0.5, rel=EXACT)


def test_tiny_counter_tilt_does_not_disable_sliding() -> None:
    for tilt in ([0, 1e-6, 0], [0, -1e-6, 0], [1e-6, 0, 0]):
        hand = pressed().go(1, turn=tilt).go(497, move=[0.025, 0, 0])
        trace = on_plane(hand)
        assert trace.causes == ["touch", "drag"]
        assert trace.tangential.max() == pytest.approx(0.6, rel=EXACT)
        assert trace.tangential[-1] == pytest.approx(0.5, rel=EXACT)


def test_slip_and_spin_share_the_limit_surface() -> None:
    """Slip at 20 mm/s and spin at 5 rad/s share one limit: 0.223607 N and -0.00357771 N m."""
    hand = pressed().go(400, move=[0.4 * 0.02, 0, 0], turn=[0, 0, 0.4 * 5.0])
    trace = on_plane(hand, material={"torsion": {"model": "limit_surface"}})
    assert trace.causes == ["touch", "drag"]
    # (F v, tau_max omega) = (0.5 * 0.02, 0.004 * 5) = (0.01, 0.02): shares of 1 and 2 in sqrt(5).
    assert trace.tangential[-1] == pytest.approx(0.5 / np.sqrt(5), abs=1e-9)
    assert trace.torque[-1, 2] == pytest.approx(-0.004 * 2 / np.sqrt(5), abs=1e-11)
    assert (round(trace.tangential[-1], 6), round(trace.torque[-1, 2], 8)) == (0.223607, -0.00357771)


@pytest.mark.parametrize("time_constant", [0.0, 0.002])
@pytest.mark.parametrize("speed", [0.05, 0.1, 0.4])
def test_withdraw_under_damping_releases_once(speed: float, time_constant: float) -> None:
    hand = pressed(0.002).go(50)
    start = hand.at
    hand.go(int(0.004 / speed * 1000), move=[0, 0, 0.004])
    damped, probe = {"damping_ns_per_m": 3.0}, {"velocity_time_constant_s": time_constant}
    trace = on_plane(hand, material=damped, coupling=damped, probe=probe)
    assert trace.causes == ["touch", "release"]
    out = trace.events[1][0]
    assert trace.poses[out, 2] >= R > trace.poses[out - 1, 2]
    assert trace.normal_force.min() >= 0.0
    assert trace.force[:, 2].min() >= 0.0
    # While the finger moves out, damping reduces K delta by B v, but not below zero.
    if time_constant == 0.0:
        depth = R - trace.poses[start + 1 : out, 2]
        assert trace.normal_force[start + 1 : out] == pytest.approx(np.maximum(1000 * depth - 3 * speed, 0), abs=1e-9)


def test_sliding_under_ripple_does_not_stick() -> None:
    """A slide at 50 mm/s whose f_N varies by 20 % at 20 Hz does not stick; the force is mu_d times the current f_N."""
    hand = pressed().go(100, move=[0.005, 0, 0])
    for i in range(1, 501):
        depth = 0.001 * (1 + 0.2 * np.sin(2 * np.pi * 20 * i / 1000))
        hand.go_to(1, [0.005 + 50e-6 * i, 0, R - depth])
    trace = on_plane(hand)
    assert trace.causes == ["touch", "drag"]
    assert trace.normal_force[200:].max() == pytest.approx(1.2, rel=1e-3)
    assert trace.tangential[102:] == pytest.approx(0.5 * trace.normal_force[102:], rel=EXACT)
