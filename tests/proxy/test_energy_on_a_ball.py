"""Energy gained on closed paths over a sphere, compared with the closed forms of docs/model/passivity.md."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from helpers.touching import visit
from references.hand import Array

from softfinger.proxy.engine import Engine

pytestmark = pytest.mark.plain

R, BALL, K_N = 0.01, 0.02, 1000.0
MIDDLE = R + BALL


def scene(ball: dict[str, Any], **tables: Any) -> dict[str, Any]:
    base = {"name": "ball", "shape": "sphere", "radius_m": BALL}
    return {"fingertip": {"radius_m": R}, "object": [{**base, **ball}], **tables}


def along(corners: list[tuple[float, ...]], ticks: int) -> Array:
    legs = [np.linspace(a, b, ticks, endpoint=False) for a, b in pairwise(corners)]
    return np.concatenate([*legs, [corners[-1]]])


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("coupling", "aside"), [(K_N, 1e-3), (3000.0, 1e-3), (300.0, -1e-3)])
def test_a_roll_gains_energy_if_coupling_and_wall_differ(coupling: float, aside: float) -> None:
    """Pressed, dragged, rolled over the sphere, released and rolled back, the hand gains (K depth - f_N) e psi.
    Sampling adds an error that halves with the step."""
    depth, turn = 1e-3, 0.3
    psi = turn * R / MIDDLE
    material = {"stiffness_n_per_m": K_N, "friction": {"static": 10.0, "kinetic": 10.0}}
    coupled = {"coupling": {"stiffness_n_per_m": coupling, "damping_ns_per_m": 0.0}}
    running = Engine(scene({"material": material}, rolling={"method": "midpoint"}, **coupled))

    def gained(ticks: int) -> float:
        corners = [(-1e-3, 0, 0), (depth, 0, 0), (depth, aside, 0), (depth, aside, 1), (depth, 0, 1), (depth, 0, 0)]
        deep, sideways, rolled = along([*corners, (-1e-3, 0, 0)], ticks).T
        angle = rolled * psi
        out = np.stack([np.sin(angle), 0.0 * angle, np.cos(angle)], axis=1)
        aslant = np.stack([np.cos(angle), 0.0 * angle, -np.sin(angle)], axis=1)
        half = 0.5 * rolled * turn
        turned = np.stack([np.cos(half), 0.0 * half, np.sin(half), 0.0 * half], axis=1)
        places = (MIDDLE - deep)[:, None] * out + sideways[:, None] * aslant
        running.reset()
        records = running.run(np.hstack([places, turned]))
        work = np.sum(records["force"][1:] * np.diff(places, axis=0))
        return float(work + np.sum(records["torque"][1:, 1] * np.diff(rolled * turn)))

    coarse, fine = gained(100), gained(200)
    wanted = (coupling - K_N) * depth * aside * psi
    # Of second order in the step, 0.5 % of a leg: 3e-5 of the energies exchanged, 0.5 to 1.5 mJ.
    assert 2.0 * fine - coarse == pytest.approx(wanted, abs=1e-7)


@pytest.mark.parametrize("sense", [1, -1])
def test_stick_slip_gains_energy_between_two_depths(sense: int) -> None:
    """There and back at two depths: K a (1 - cos theta) times their difference, with the sign of the direction."""
    stiffness, shallow, deep, angle = 300.0, 0.0005, 0.004, 0.45
    effect = {"kind": "stick_slip", "stiffness_n_per_m": stiffness, "force_max_n": 5.0}
    running = Engine(scene({"material": {"stiffness_n_per_m": K_N}, "effect": [effect]}))
    round_trip = [(0.0, shallow), (angle, shallow), (angle, deep), (0.0, deep), (0.0, shallow)][::sense]
    path = np.concatenate([along([(0.0, -0.0005), (0.0, shallow)], 100)[:-1], along(round_trip, 100)])
    out = np.stack([np.sin(path[:, 0]), 0.0 * path[:, 0], np.cos(path[:, 0])], axis=1)
    places = (MIDDLE - path[:, 1])[:, None] * out
    force = visit(running, places)["force"]
    work = np.sum((0.5 * (force[1:] + force[:-1]) * np.diff(places, axis=0))[100:])
    wanted = -sense * stiffness * MIDDLE * (deep - shallow) * (1.0 - np.cos(angle))
    assert work == pytest.approx(wanted, rel=1e-3)  # the trapezoidal rule at a hundred steps per leg: 2e-4
