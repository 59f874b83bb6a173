"""Friction and torsion laws to test, random handling of a plane, and the account of energy over it."""

from collections.abc import Callable
from typing import Any

import numpy as np
from helpers.examples import examples
from hypothesis import given
from hypothesis import strategies as st

from references.hand import Hand
from references.rotation import Array
from softfinger.proxy.engine import Engine

R, K_Z = 0.01, 0.05

SPEED = {"stribeck_speed_m_per_s": 0.05, "viscous_s_per_m": 0.5}
ANISOTROPIC = {"direction_x": [1.0, 0.0, 0.0], "static_scale": [1.0, 0.5], "kinetic_scale": [0.9, 0.4]}

LAWS: dict[str, dict[str, Any]] = {
    "coulomb": {},
    "frictionless, wound": {"friction": None},
    "coulomb, limit surface": {"torsion": {"model": "limit_surface"}},
    "with speed, power law": {"friction": SPEED, "torsion": {"exponent": 0.3}},
    "anisotropic, soft-finger proxy": {
        "friction": ANISOTROPIC,
        "torsion": {"model": "soft_finger_proxy", "kinetic_friction_length_m": 0.003},
    },
    "anisotropic with speed, limit surface, power law": {
        "friction": {**ANISOTROPIC, **SPEED},
        "torsion": {"model": "limit_surface", "exponent": 0.3},
    },
}
"""Changes of the material of conftest.paper_mapping: every law and every model of torsion at least once."""


def rolling(law: str) -> dict[str, Any] | None:
    """The scene's rolling table for a law: without friction there is nothing to roll on."""
    return None if law.startswith("frictionless") else {"method": "euler_zxz"}


@st.composite
def handling(draw: st.DrawFn, pieces: int = 8) -> Array:
    """Poses (n, 7) of a hand above the plane z = 0 that presses, drags, rolls, spins, lifts and rests, in any order.

    A tick has a roll or a spin, not both: otherwise the rotation of a tick is not the sum of the two, and the work of
    the torque is known to second order only.
    """
    hand = Hand([0.0, 0.0, R + 0.0005])
    small = st.floats(-1.5e-3, 1.5e-3)
    for _ in range(pieces):
        depth = draw(st.one_of(st.floats(-0.0003, 0.003), st.just(None)))
        lift = 0.0 if depth is None else (R - depth) - hand.x[2]
        move = [draw(small), draw(small), lift]
        angle = draw(st.floats(-0.3, 0.3))
        heading = draw(st.floats(0.0, 2 * np.pi))
        roll = draw(st.sampled_from([0.0, 1.0]))
        turn = [angle * roll * np.cos(heading), angle * roll * np.sin(heading), angle * (1.0 - roll)]
        rest = draw(st.sampled_from([0.0, 1.0, 1.0]))
        hand.go(draw(st.integers(1, 30)), rest * np.asarray(move), rest * np.asarray(turn))
    return np.array(hand.poses)


def check_random_handling(engine: Engine, few: int, many: int, check: Callable[[Array], None]) -> None:
    """Call `check` with the records (n, RECORD_SIZE) of random handlings, each a new contact."""

    @examples(few, many)
    @given(handling())
    def run(poses: Array) -> None:
        engine.reset()
        check(engine.run(poses))

    run()


def axis_angles(orientations: Array) -> Array:
    """Rotation vectors (n - 1, 3) rad, world, from each quaternion (n, 4) to the next."""
    a, b = orientations[:-1], orientations[1:]
    w = np.sum(a * b, axis=1)
    v = a[:, :1] * b[:, 1:] - b[:, :1] * a[:, 1:] + np.cross(a[:, 1:], b[:, 1:])
    v, w = v * np.sign(w)[:, None], np.abs(w)
    size = np.linalg.norm(v, axis=1)
    scale = np.where(size > 0, 2 * np.arctan2(size, w) / np.where(size > 0, size, 1), 2.0)
    return scale[:, None] * v


def work_of_the_hand(records: Array) -> Array:
    """Return the work (n,) J of the hand up to each tick: each tick's motion times the wrench at its end.

    For springs with convex energy, this is never less than their stored energy, so a contact that returns more
    energy than it received is detected at once, at any time step.
    """
    moved = np.diff(records["probe.position"], axis=0)
    turned = axis_angles(records["probe.orientation"])
    force, torque = records["force"][1:], records["torque"][1:]
    return np.concatenate([[0.0], -np.cumsum(np.sum(force * moved, axis=1) + np.sum(torque * turned, axis=1))])


def stored_energy(records: Array, stiffness: float = 1000.0, torsion: float = K_Z) -> Array:
    """Energy (n,) J in the springs: normal and tangential of `stiffness` N/m, torsional of `torsion` N m/rad."""
    stretch = records["proxy.position"] - records["probe.position"]
    spin = records["contact.spin"]
    touching = records["contact.mode"] != 0
    return touching * 0.5 * (stiffness * np.sum(stretch**2, axis=1) + torsion * spin**2)
