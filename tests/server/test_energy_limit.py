"""Limit of the energy that a device gives in contacts: closed forms of a wall, and a simulated device with a delay."""

import math
from math import inf

import numpy as np
import pytest
from test_limits import ARM, LEVEL, NONE, T, make_guard, tick

from softfinger.config import schema
from softfinger.config.load import load_scene
from softfinger.drivers.simulated.options import Simulation
from softfinger.drivers.simulated.plant import Handle, Impedance, Intention, make_plant
from softfinger.drivers.simulated.plant import make_rest_state as resting
from softfinger.proxy.record import AT, ROLLING
from softfinger.server.loop import guard as g
from softfinger.server.loop import hand_limits as lim
from softfinger.server.loop.output import INITIAL_OUTPUT
from softfinger.server.loop.tuning import make_tuning
from softfinger.server.offline.closed_loop import run_closed_loop

pytestmark = pytest.mark.plain


def test_a_torque_fades_with_the_force():
    guard = make_guard(energy=0.2)
    given = 0.3 * (lim.ENERGY_TIME_CONSTANT_S + T) / lim.ENERGY_TIME_CONSTANT_S
    passed = INITIAL_OUTPUT._replace(limit_state=lim.INITIAL_LIMITS._replace(energy_given=given))
    passed, bits = tick(guard, passed, (50.0, 0.0, 0.0), mode=ROLLING, torque=(0.0, 0.0, 5.0))
    assert bits & g.ENERGY_SPENT
    assert passed.guard_state.force == pytest.approx((6.0, 0.0, 0.0), rel=1e-12)
    assert passed.guard_state.torque == pytest.approx((0.0, 0.0, 0.15), rel=1e-12)


def test_generated_energy_in_a_contact_fades_the_force():
    """The energy is P tau (1 - r^n); above the limit E the force has the share s = 2 - given / E."""
    guard, passed = make_guard(energy=0.1), INITIAL_OUTPUT
    shares, ratio = [], lim.ENERGY_TIME_CONSTANT_S / (lim.ENERGY_TIME_CONSTANT_S + T)
    for n in range(8000):
        passed, bits = tick(guard, passed, (4.0, 0.0, 0.0), (0.1 * T, 0.0, 0.0), ROLLING)
        shares.append(passed.guard_state.force[0] / 4.0)
        energy = passed.limit_state.energy_given
        if not bits & g.ENERGY_SPENT:  # the first tick has no force before it
            expected = 0.4 * T * ratio * (1.0 - ratio**n) / (1.0 - ratio)
            assert energy == pytest.approx(expected, rel=1e-9) and energy <= 0.1  # a thousand rounded steps
    whole = next(n for n, share in enumerate(shares) if share < 1.0)
    assert whole * T == pytest.approx(-math.log(1.0 - 0.1 / 0.4), abs=3 * T)
    # s P tau = E (2 - s): s = 2 E / (P tau + E) = 0.4; the work of a tick is forgotten a tick late, a thousandth.
    assert shares[-1] == pytest.approx(0.4, rel=2e-3)


@pytest.mark.parametrize(
    ("spent", "share"), [(-1.0, 1.0), (0.0, 1.0), (1.0, 1.0), (1.25, 0.75), (2.0, 0.0), (3.0, 0.0)]
)
def test_the_force_fades_between_once_and_twice_the_energy(spent, share):
    limits = lim.UNLIMITED._replace(energy=0.2)
    assert lim.compute_energy_scale(limits, 0.2 * spent) == pytest.approx(share, abs=1e-15)  # rounding


def test_energy_from_the_hand_counts_within_a_contact_only():
    guard, passed = make_guard(energy=0.1), INITIAL_OUTPUT
    for moved in [-0.001] * 100 + [0.001] * 100:
        passed, bits = tick(guard, passed, (0.0, 0.0, 4.0), (0.0, 0.0, moved), ROLLING)
        assert bits == 0
    assert abs(passed.limit_state.work) <= 4.0 * 0.001 * (1 + 1e-9)  # the first tick had no force yet
    for _ in range(200):
        passed, _ = tick(guard, passed, (0.0, 0.0, 4.0), (0.0, 0.0, -0.001), ROLLING)
    assert passed.limit_state.work > 0.7
    passed, _ = tick(guard, passed)
    assert passed.limit_state.work == 0.0


def test_free_motion_under_an_effect_gives_no_energy():
    guard, passed = make_guard(energy=0.01), INITIAL_OUTPUT
    for _ in range(1000):
        passed, bits = tick(guard, passed, (4.0, 0.0, 0.0), (0.001, 0.0, 0.0))
        assert bits == 0 and passed.limit_state.work == 0.0


def press_stiff_wall(energy, delay, ticks):
    """Return the records of a light hand on a stiff wall and a device with a delay, with a limit of energy (J)."""
    stiff = load_scene("frictionless-plane", {"object.0.material.stiffness_n_per_m": 5000.0})
    tuning = make_tuning(stiff, schema.Guard(ramp_s=0.01), [ARM])
    guard = tuning.guards[0]._replace(limits=lim.UNLIMITED._replace(energy=energy))
    plant = make_plant(T, Handle((0.2,) * 3, (0.3,) * 3, delay=delay), Impedance(0.05, 0.5, 300.0))
    wanted = np.array([0.0, 0.0, 0.005, *LEVEL])
    device = Simulation(plant, resting((0.0, 0.0, 0.008)), Intention(1.0, 0.0, NONE, 0.0, 0.0), wanted)
    return np.concatenate(list(run_closed_loop(tuning._replace(guards=(guard,)), [device], 1.0 / T, ticks)))[:, 0]


@pytest.mark.parametrize("energy", [0.05, inf])
def test_an_unstable_wall_fades(energy):
    records = press_stiff_wall(energy, 1, 1500)
    late = np.linalg.norm(records[1000:, AT.force : AT.force + 3], axis=1).max()
    spent = bool((records[:, AT.servo_guard].astype(int) & g.ENERGY_SPENT).any())
    generated = records[:, AT.limits_energy].max()
    if energy == inf:
        assert late == 12.0 and not spent
    else:
        assert late < 0.8 * 12.0 and spent and energy < generated < 2.0 * energy


def sum_with_decay(works):
    """Return the sums of works (J) after each work; positive sums decay as in the limit."""
    total, sums, ratio = 0.0, [], lim.ENERGY_TIME_CONSTANT_S / (lim.ENERGY_TIME_CONSTANT_S + T)
    for work in works:
        total = (total + work) * (ratio if total + work > 0.0 else 1.0)
        sums.append(total)
    return np.array(sums)


@pytest.mark.parametrize("late", [0, 1, 4])
@pytest.mark.parametrize("hz", [5.0, 20.0])
def test_energy_of_a_wall_per_cycle_follows_colgate(hz, late):
    """On a path A (1 - cos) into a wall K within one contact, a force `late` ticks late gives the hand K A^2 N
    sin((late + 1/2) 2 pi / N) sin(pi / N) per cycle of N ticks, which is Colgate's pi K A^2 sin(w (late + 1/2) T). The
    limit counts the energy of late = 0, and acts before the hand got 2 late + 1 times the limit."""
    stiffness, amplitude, count = 2000.0, 2e-3, round(1.0 / (T * hz))
    depths = amplitude * (1.0 - np.cos(2.0 * np.pi * np.arange(60 * count) / count))
    forces, moved = stiffness * depths, -np.diff(depths, prepend=0.0)
    acting = np.concatenate([np.zeros(1 + late), forces])[: len(forces)]  # during the motion to each position
    works = acting * moved

    def in_a_cycle(ticks):
        return stiffness * amplitude**2 * count * math.sin((ticks + 0.5) * 2 * np.pi / count) * math.sin(np.pi / count)

    assert works[count : 2 * count].sum() == pytest.approx(in_a_cycle(late), rel=1e-9)  # a sum of roundings
    continuous = np.pi * stiffness * amplitude**2 * math.sin(2.0 * np.pi * hz * (late + 0.5) * T)
    assert in_a_cycle(late) == pytest.approx(continuous, rel=1.0 / count)
    energy = 4.5 * in_a_cycle(0)
    guard, passed, bits, spent = make_guard(force_max=40.0, energy=energy), INITIAL_OUTPUT, 0, -1
    while not bits & g.ENERGY_SPENT:  # there are more ticks than needed, or an IndexError is raised
        spent += 1
        passed, bits = tick(guard, passed, (0.0, 0.0, forces[spent]), (0.0, 0.0, moved[spent]), ROLLING)
    assert spent > 4 * count  # and some more, because a part is forgotten
    stored = 0.5 * stiffness * depths[spent] ** 2
    generated, counted = sum_with_decay(works)[spent] + stored, passed.limit_state.energy_given + stored
    assert generated <= (2 * late + 1) * counted * (1.0 + 1e-9)  # rounding, for late = 0


@pytest.mark.parametrize("late", [1, 2, 4])
def test_a_delayed_device_gives_no_more_than_the_stated_energy(late):
    energy = 0.05
    records = press_stiff_wall(energy, late, 1000)
    forces, places = (records[:, at : at + 3] for at in (AT.force, AT.probe_position))
    acting = np.concatenate([np.zeros((1 + late, 3)), forces])[: len(forces)]  # constant from each tick to the next
    generated = sum_with_decay(np.sum(acting * np.diff(places, axis=0, prepend=places[:1]), axis=1))
    first = int(np.argmax(records[:, AT.servo_guard].astype(int) & g.ENERGY_SPENT != 0))
    assert first > 0 and energy < generated[first] <= (2 * late + 1) * energy
    assert generated.max() <= 2.0 * (2 * late + 1) * energy
