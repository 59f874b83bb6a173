"""The case of `bench grasp`: the box, the grip, the lift, and what is kept of a grasp over time."""

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
"""Torsional friction, N m, of each N of grip."""
SETTLE_S: Final = 0.2
"""The box is taken without weight for so long, and then has it."""
WEIGHT_S: Final = 0.3
"""The weight comes at once; so long after it the lift begins, and the forces are looked at."""
LIFT_S: Final = 1.0
LIFT_M: Final = 0.1
LOADED_S: Final = 1.8
"""After it was lifted the swing has died away; what moves then is creep."""
DT: Final = 1e-3
SIDES: Final = {"thumb": -1.0, "index": 1.0}
"""Of the box along x."""
FINGER_KG: Final = 0.05
"""Of a sphere of a peer's."""
APART_M: Final = 0.001
"""They begin so far off the box."""


class Held(NamedTuple):
    """A grasp over time: height of the box's taken point above the fingers (n,) m, its turn (n,) rad, the thumb's force
    (n, 3)."""

    height: Array
    turn: Array
    force: Array


def lift(seconds: float) -> Array:
    """Height of the hands (n,) m, a lift by a minimum-jerk move and a hold: LOADED_S and `seconds`."""
    u = np.clip((np.arange(round((LOADED_S + seconds) / DT)) * DT - WEIGHT_S) / LIFT_S, 0.0, 1.0)
    way: Array = LIFT_M * u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
    return way


def held_as(states: Array, way: Array, force: Array) -> Held:
    """States (n, 7) of the box as a Held: the point that is taken goes with the box; `way` (n,) is the hands'."""
    turn = np.unwrap(2.0 * np.arctan2(states[:, 4], states[:, 3]))
    return Held(states[:, 2] - way + BESIDE_M * np.sin(turn), -turn if turn[-1] < 0.0 else turn, force)


class Peer(ABC):
    """A simulator whose own contact holds the box between two spheres of RADIUS_M that are led to places."""

    @abstractmethod
    def lead(self, depth: float, height: float) -> None:
        """Lead the spheres so deep into the sides of the box where it began (m), and so high (m)."""

    @abstractmethod
    def weigh(self) -> None:
        """Give the box its weight, from now on."""

    @abstractmethod
    def step(self) -> None:
        """Go on by DT."""

    @abstractmethod
    def box(self) -> Array:
        """Its pose (7,): x, y, z, qw, qx, qy, qz."""

    @abstractmethod
    def force(self) -> Array:
        """Sum of the contacts' forces on the thumb (3,) N, world."""


def x_of(side: float, depth: Any) -> Any:
    """Place along x (m) of a sphere so deep (m) in a side of the box."""
    return side * (HALF_M + RADIUS_M - depth)


def peer_module(peer: str, module: str, wheel: str) -> Any:
    """A module of a peer's package; ConfigError where it is not installed, with what to install."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise ConfigError(f"--peer {peer}: {package} cannot be imported ({error}): pip install {wheel}") from None


def take(peer: Peer, squeeze: float) -> Peer:
    """The box taken, without weight, with a squeeze (m) beyond touch."""
    for tick in range(round(SETTLE_S / DT)):
        peer.lead(-APART_M + (APART_M + squeeze) * min(tick * DT / (0.5 * SETTLE_S), 1.0), 0.0)
        peer.step()
    return peer


def hold(peer: Peer, squeeze: float, seconds: float) -> Held:
    """The box taken, lifted and held for so many seconds."""
    take(peer, squeeze).weigh()
    way, states, force = lift(seconds), list[Array](), list[Array]()
    for height in way:
        peer.lead(squeeze, height)
        peer.step()
        states.append(peer.box())
        force.append(peer.force())
    return held_as(np.array(states), way, np.array(force))
