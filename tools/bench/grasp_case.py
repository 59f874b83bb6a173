"""Case of `bench grasp`: the box, the grip, the lift, and the recorded grasp."""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from typing import Any, Final, NamedTuple

import numpy as np

from softfinger.config.errors import ConfigError
from softfinger.tools.measure import Array

GRIP_N: Final = 3.0
BESIDE_M: Final = 0.008
RADIUS_M: Final = 0.01
HALF_M: Final = 0.02
MASS_KG: Final = 0.1
GRAVITY: Final = 9.81
FRICTION: Final = 0.8
STIFFNESS: Final = 1000.0
DAMPING: Final = 2.0
TORSION: Final = 0.05
SPIN_LENGTH_M: Final = 0.004
"""Torsional friction, N m, per N of grip."""
SETTLE_S: Final = 0.2
"""Time in which the box is gripped without weight; then it gets its weight."""
WEIGHT_S: Final = 0.3
"""The weight is applied at once. After this time the lift starts, and the forces are evaluated."""
LIFT_S: Final = 1.0
LIFT_M: Final = 0.1
LOADED_S: Final = 1.8
"""Time at which the swing after the lift has decayed; any later motion is creep."""
DT: Final = 1e-3
SIDES: Final = {"thumb": -1.0, "index": 1.0}
"""Side of the box along x."""
FINGER_KG: Final = 0.05
"""Mass of a sphere in a peer."""
APART_M: Final = 0.001
"""Initial distance of the spheres from the box."""


class Held(NamedTuple):
    """Grasp over time.

    height  (n,)    m    of the gripped point of the box above the fingers
    turn    (n,)    rad  of the box
    force   (n, 3)  N    on the thumb
    """

    height: Array
    turn: Array
    force: Array


def lift(seconds: float) -> Array:
    """Return the height of the hands (n,) m during LOADED_S + `seconds`: a minimum-jerk lift, then a hold."""
    u = np.clip((np.arange(round((LOADED_S + seconds) / DT)) * DT - WEIGHT_S) / LIFT_S, 0.0, 1.0)
    way: Array = LIFT_M * u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
    return way


def held_as(states: Array, way: Array, force: Array) -> Held:
    """Convert states (n, 7) of the box to a Held.

    The gripped point moves with the box; `way` (n,) is the height of the hands.
    """
    turn = np.unwrap(2.0 * np.arctan2(states[:, 4], states[:, 3]))
    return Held(states[:, 2] - way + BESIDE_M * np.sin(turn), -turn if turn[-1] < 0.0 else turn, force)


class Peer(ABC):
    """Simulator with its contact model, in which two position-controlled spheres of RADIUS_M hold the box."""

    @abstractmethod
    def lead(self, depth: float, height: float) -> None:
        """Move the spheres to a depth (m) in the sides of the box at its initial position, and to a height (m)."""

    @abstractmethod
    def weigh(self) -> None:
        """Apply the weight of the box from now on."""

    @abstractmethod
    def step(self) -> None:
        """Step by DT."""

    @abstractmethod
    def box(self) -> Array:
        """Return the pose (7,) of the box: x, y, z, qw, qx, qy, qz."""

    @abstractmethod
    def force(self) -> Array:
        """Return the sum of the contact forces on the thumb (3,) N, world."""


def x_of(side: float, depth: Any) -> Any:
    """Return the position along x (m) of a sphere at a depth (m) in a side of the box."""
    return side * (HALF_M + RADIUS_M - depth)


def peer_module(peer: str, module: str, wheel: str) -> Any:
    """Import a module of a peer's package; raises ConfigError with the package to install if it is missing."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise ConfigError(f"--peer {peer}: {package} cannot be imported ({error}): pip install {wheel}") from None


def take(peer: Peer, squeeze: float) -> Peer:
    """Grip the box, without weight, with a squeeze (m) beyond touch."""
    for tick in range(round(SETTLE_S / DT)):
        peer.lead(-APART_M + (APART_M + squeeze) * min(tick * DT / (0.5 * SETTLE_S), 1.0), 0.0)
        peer.step()
    return peer


def hold(peer: Peer, squeeze: float, seconds: float) -> Held:
    """Grip, lift and hold the box for `seconds`."""
    take(peer, squeeze).weigh()
    way, states, force = lift(seconds), list[Array](), list[Array]()
    for height in way:
        peer.lead(squeeze, height)
        peer.step()
        states.append(peer.box())
        force.append(peer.force())
    return held_as(np.array(states), way, np.array(force))
