"""Simulated handle compared with closed forms and with a high-order integration of its equations."""

from math import sqrt

import numpy as np
import pytest
from references import handle
from scipy.linalg import expm as scipy_expm

from softfinger.drivers.simulated import plant as simulation
from softfinger.drivers.simulated.plant import Handle, Impedance, PlantState, make_plant, make_rest_state
from softfinger.proxy.kernels.jit.decorators import entry

pytestmark = pytest.mark.plain

T = 0.001
STILL = (1.0, 0.0, 0.0, 0.0)
GOOD = Handle((0.2,) * 3)


@entry
def travel(plant, state, commands, goals, turns, line, places, forces):
    """Run one tick per row of `commands` (n, 3); store positions, velocities, motor forces and orientations (n, 13)."""
    for i in range(commands.shape[0]):
        command = (commands[i, 0], commands[i, 1], commands[i, 2])
        goal = (goals[i + 1, 0], goals[i + 1, 1], goals[i + 1, 2])
        turn = (turns[i + 1, 0], turns[i + 1, 1], turns[i + 1, 2], turns[i + 1, 3])
        state = simulation.advance(plant, state, command, goal, turn, line)
        x = simulation.sense(plant, state)
        for k in range(3):
            forces[i, k] = x[k]
            places[i, k], places[i, 3 + k], places[i, 6 + k] = state.position[k], state.velocity[k], state.force[k]
        for k in range(4):
            places[i, 9 + k] = state.orientation[k]


class Journey:
    """A plant driven through `commands` (n, 3) from rest at the origin, or from `start`."""

    def __init__(
        self, plant: simulation.Plant, commands, goals=None, turns=None, start: PlantState | None = None
    ) -> None:
        commands = np.ascontiguousarray(commands, dtype=float)
        n = len(commands)
        goals = np.zeros((n + 1, 3)) if goals is None else np.ascontiguousarray(goals, dtype=float)
        turns = np.tile(STILL, (n + 1, 1)) if turns is None else np.ascontiguousarray(turns, dtype=float)
        places, self.felt = np.zeros((n, 13)), np.zeros((n, 3))
        state = make_rest_state(tuple(goals[0]), tuple(turns[0])) if start is None else start
        travel(plant, state, commands, goals, turns, np.zeros(simulation.DELAY_LINE_SIZE), places, self.felt)
        self.x, self.v, self.force, self.q = np.split(places, [3, 6, 9], axis=1)


def along_z(values) -> np.ndarray:
    return np.column_stack([np.zeros_like(values), np.zeros_like(values), values])


def moving(v: float) -> PlantState:
    return make_rest_state((0.0, 0.0, 0.0))._replace(velocity=(0.0, 0.0, v))


@pytest.mark.parametrize("period", [0.01, 0.001, 0.000125])
def test_free_mass_under_constant_force(period):
    mass, force = np.array([0.1, 0.3, 2.0]), np.array([1.0, -2.0, 0.5])
    trip = Journey(make_plant(period, Handle(tuple(mass))), np.tile(force, (500, 1)))
    t = period * np.arange(1, 501)[:, None]
    np.testing.assert_allclose(trip.x, force * t**2 / 2.0 / mass, rtol=1e-13)  # 500 additions
    np.testing.assert_allclose(trip.v, force * t / mass, rtol=1e-13)


def test_damped_mass_runs_down():
    for b in (0.5, 5.0, 8000.0):
        trip = Journey(make_plant(T, Handle((0.2,) * 3, (b,) * 3)), np.zeros((200, 3)), start=moving(0.3))
        t = T * np.arange(1, 201)
        np.testing.assert_allclose(trip.v[:, 2], 0.3 * np.exp(-b * t / 0.2), rtol=1e-11, atol=simulation.FLUSH_MAX)
        np.testing.assert_allclose(trip.x[:, 2], -0.3 * 0.2 / b * np.expm1(-b * t / 0.2), rtol=1e-12)


def test_hand_spring_swings_at_its_frequency():
    m, c, k, x0 = 0.2 + 0.1, 1.5, 300.0, 0.01
    plant = make_plant(T, Handle((0.2,) * 3), Impedance(mass=0.1, damping=c, stiffness=k))
    start = make_rest_state((0.0, 0.0, 0.0))._replace(position=(0.0, 0.0, x0))
    trip = Journey(plant, np.zeros((2000, 3)), start=start)
    decay = c / (2.0 * m)
    w = sqrt(k / m - decay**2)
    t = T * np.arange(1, 2001)
    expected = x0 * np.exp(-decay * t) * (np.cos(w * t) + decay / w * np.sin(w * t))
    np.testing.assert_allclose(trip.x[:, 2], expected, atol=1e-12 * x0)  # 2000 steps, each rounded once


def test_lag_is_of_first_order():
    m, tau, f = 0.2, 0.004, 2.0
    trip = Journey(make_plant(T, Handle((m,) * 3, lag=tau)), along_z(np.full(300, f)))
    t = T * np.arange(1, 301)
    np.testing.assert_allclose(trip.force[:, 2], -f * np.expm1(-t / tau), rtol=1e-12)
    np.testing.assert_allclose(trip.v[:, 2], f / m * (t + tau * np.expm1(-t / tau)), rtol=1e-10)
    x = f / m * (t**2 / 2.0 - tau * t - tau**2 * np.expm1(-t / tau))
    np.testing.assert_allclose(trip.x[:, 2], x, rtol=1e-9)  # the closed form itself loses digits at small t


@pytest.mark.parametrize("delay", [0, 1, 2, 7, simulation.DELAY_MAX])
def test_force_acts_after_exactly_the_delay(delay):
    commands = np.zeros((40, 3))
    commands[3] = 0.5, 1.0, -2.0
    trip = Journey(make_plant(T, Handle((0.2,) * 3, delay=delay)), commands)
    steps = np.diff(trip.v, axis=0, prepend=0.0)
    assert np.nonzero(steps.any(axis=1))[0].tolist() == [3 + delay]
    np.testing.assert_allclose(steps[3 + delay], commands[3] * T / 0.2, rtol=1e-13)


def test_saturation_preserves_the_direction():
    commands = np.array([[3.0, 0.0, 4.0], [30.0, 0.0, 40.0], [1e150, 0.0, 0.0]])
    trip = Journey(make_plant(T, Handle((0.2,) * 3, force_max=10.0)), commands)
    assert trip.force[0].tolist() == [3.0, 0.0, 4.0]
    np.testing.assert_allclose(trip.force[1], [6.0, 0.0, 8.0], rtol=1e-15)
    np.testing.assert_allclose(trip.force[2], [10.0, 0.0, 0.0], rtol=1e-15)


def test_encoders_round_to_their_nearest_step():
    step, forces = 1e-4, np.tile((0.5, -0.4, 0.3), (300, 1))
    fine = Journey(make_plant(T, Handle((0.2,) * 3)), forces)
    coarse = Journey(make_plant(T, Handle((0.2,) * 3, resolution=step)), forces)
    assert coarse.x.tobytes() == fine.x.tobytes() == fine.felt.tobytes()
    assert all(len(np.unique(felt)) > 100 for felt in coarse.felt.T)
    np.testing.assert_allclose(coarse.felt / step, np.rint(coarse.felt / step), atol=1e-9)  # of 1000 steps
    assert np.abs(coarse.felt - coarse.x).max() <= 0.5 * step * (1.0 + 1e-12)


CASES = {
    "drag": handle.Handle(0.2, 1.0, 0.4),
    "lag": handle.Handle(0.2, 1.0, 0.4, lag=0.003),
    "hand": handle.Handle(0.3, 3.0, 0.3, hand_damping=2.0, stiffness=300.0),
    "fast lag": handle.Handle(0.4, 9.0, 0.8, lag=0.0005, hand_damping=8.0, stiffness=1000.0),
    "all": handle.Handle(0.3, 3.0, 0.3, lag=0.002, hand_damping=2.0, stiffness=800.0),
    "stiff": handle.Handle(0.05, 0.5, 0.2, lag=0.001, hand_damping=0.1, stiffness=20000.0),
    "linear": handle.Handle(0.3, 3.0, 0.0, lag=0.002, hand_damping=2.0, stiffness=800.0),
}


def wander(h: handle.Handle, period: float, n: int, seed: int):
    """Return positions and velocities (n, 2) of the plant and of the reference, under random forces and goals."""
    rng = np.random.default_rng(seed)
    commands = 0.6 * np.sin(0.21 * np.arange(n)) + 0.4 * rng.normal(size=n)
    goals = 0.002 * np.sin(0.1 * np.arange(n + 1)) + 0.0002 * rng.normal(size=n + 1)
    goals *= 800.0 / max(800.0, h.stiffness)  # a spring that exceeds friction in every tick would never stick
    goals[0] = 0.0
    alone = Handle((h.mass,) * 3, (h.damping,) * 3, (h.friction,) * 3, h.lag)
    plant = make_plant(period, alone, Impedance(damping=h.hand_damping, stiffness=h.stiffness))
    trip = Journey(plant, along_z(commands), along_z(goals))
    return np.column_stack([trip.x[:, 2], trip.v[:, 2]]), handle.integrate(h, period, commands, goals, 0.0)[1:]


def assert_close(got, want):
    assert np.array_equal(got[:, 1] == 0.0, want[:, 1] == 0.0)  # stuck at the same ticks
    np.testing.assert_allclose(got, want, atol=1e-9 * np.abs(want).max(axis=0).min(), rtol=1e-9)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", list(CASES))
@pytest.mark.parametrize("period", [0.001, 0.01])
def test_stick_and_slip_agree_with_a_high_order_integration(name, period):
    """Under random forces and goals, with stops, sticking and reversals inside ticks, the motion is equal to 1e-9."""
    got, want = wander(CASES[name], period, 120, seed=5)
    if CASES[name].friction:
        assert (want[:, 1] == 0.0).any() and (want[:, 1] != 0.0).any()  # it sticks and it moves
    assert_close(got, want)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("seed", range(12))
def test_random_handles_agree_with_a_high_order_integration(seed):
    """Masses, frictions, lags and hands over their usual ranges, 8 kHz to 100 Hz: the motion is equal to 1e-9."""
    rng = np.random.default_rng(seed)
    h = handle.Handle(
        10.0 ** rng.uniform(-1.5, 0.5), 10.0 ** rng.uniform(-1, 1), rng.uniform(0.05, 1.0),
        rng.choice([0.0, 10.0 ** rng.uniform(-3.5, -2)]), rng.choice([0.0, 5.0]), 10.0 ** rng.uniform(0, 4),
    )  # fmt: skip
    assert_close(*wander(h, 1.0 / rng.choice([8000.0, 1000.0, 300.0, 100.0]), 60, seed))


def test_nothing_gains_energy_without_a_command():
    rng = np.random.default_rng(3)
    for _ in range(20):
        m, k, c = rng.uniform(0.05, 1.0), 10.0 ** rng.uniform(1, 4), rng.uniform(0.0, 5.0)
        friction, lag = rng.choice([0.0, 0.2]), rng.choice([0.0, 0.002])
        alone = Handle((m,) * 3, (rng.uniform(0.0, 2.0),) * 3, (friction,) * 3, lag)
        plant = make_plant(T, alone, Impedance(damping=c, stiffness=k))
        start = make_rest_state((0.0, 0.0, 0.0))._replace(position=(0.001, -0.01, 0.02), velocity=(0.3, 0.0, -0.1))
        trip = Journey(plant, np.zeros((800, 3)), start=start)
        energy = 0.5 * m * trip.v**2 + 0.5 * k * trip.x**2
        # Without losses only rounding changes it: some ulps per tick.
        assert (np.diff(energy, axis=0) <= 1e-14 * energy[0]).all()
        assert energy[-1, 0] < energy[0, 0]  # the axis with an initial velocity; another may stick at its start


def test_orientation_follows_directly_or_with_its_lag():
    angle, tau = 1.2, 0.02
    turned = (np.cos(angle / 2.0), 0.0, np.sin(angle / 2.0), 0.0)
    turns = np.array([STILL] + [turned] * 100)
    direct = Journey(make_plant(T, Handle((0.2,) * 3)), np.zeros((100, 3)), turns=turns)
    assert direct.q.tolist() == [list(turned)] * 100
    lagging = Journey(make_plant(T, Handle((0.2,) * 3, orientation_lag=tau)), np.zeros((100, 3)), turns=turns)
    remaining = angle - 2.0 * np.arctan2(lagging.q[:, 2], lagging.q[:, 0])
    np.testing.assert_allclose(remaining, angle * np.exp(-T * np.arange(1, 101) / tau), rtol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(lagging.q, axis=1), 1.0, rtol=1e-15)


def test_matrix_exponential_agrees_with_scipy():
    rng = np.random.default_rng(1)
    for scale in (1e-6, 0.1, 1.0, 30.0):
        for matrix in (rng.normal(size=(7, 7)), np.triu(rng.normal(size=(5, 5)), 1), -np.eye(3)):
            want = scipy_expm(scale * matrix)
            # Squaring ten times loses three digits at most.
            np.testing.assert_allclose(simulation.expm(scale * matrix), want, rtol=0.0, atol=1e-12 * np.abs(want).max())
    assert np.array_equal(simulation.expm(np.zeros((3, 3))), np.eye(3))


@pytest.mark.sampled(1)
@pytest.mark.parametrize("lag", [0.0, 0.02])
def test_decaying_states_reach_zero(lag):
    commands = np.zeros((20000, 3))
    commands[:20] = 0.3, -0.2, 0.1
    moved = Journey(make_plant(T, GOOD._replace(damping=(3.0, 8.0, 20.0), lag=lag)), commands)
    for state in (moved.v, moved.force):
        assert np.all((state == 0.0) | (np.abs(state) >= simulation.FLUSH_MAX))
    assert np.all(moved.v[-1] == 0.0) and np.all(moved.force[-1] == 0.0)
    # Half a second after the push only the handle's damping remains: v decreases by exp(-B T / M) per tick.
    assert moved.v[3000, 0] / moved.v[2999, 0] == pytest.approx(np.exp(-3.0 / 0.2 * T), rel=1e-12)
