"""Bullet's own contact holds the box: spheres that fixed constraints lead.

Their contact has Bullet's spinning friction, and the stiffness of the fingertips here; the rest is as Bullet has it.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from typing import Any, Final

import numpy as np

from softfinger.config.errors import ConfigError
from softfinger.tools.bench.grasp_case import (
    BESIDE_M,
    DAMPING,
    DT,
    FRICTION,
    GRAVITY,
    GRIP_N,
    HALF_M,
    MASS_KG,
    RADIUS_M,
    SPIN_LENGTH_M,
    STIFFNESS,
    Held,
    Peer,
    hold,
)
from softfinger.tools.measure import Array

SIDES: Final = {"thumb": -1.0, "index": 1.0}
FINGER_KG: Final = 0.05
SERVO_N: Final = 1e3
"""The most that a constraint pulls with: far above the grip."""


def imported() -> Any:
    """The package pybullet; ConfigError where it is not installed."""
    try:
        return importlib.import_module("pybullet")
    except ImportError as error:
        raise ConfigError(f"--peer bullet: pybullet cannot be imported ({error}): pip install pybullet") from None


class Bullet(Peer):
    """A world of pybullet."""

    def __init__(self) -> None:
        self._bullet: Final = imported()
        self._world: Final = self._bullet.connect(self._bullet.DIRECT)
        self._bullet.setTimeStep(DT, self._world)
        self._box: Final = self._body(MASS_KG, [0.0, 0.0, 0.0], self._bullet.GEOM_BOX, halfExtents=[HALF_M] * 3)
        self._fingers: Final = {name: self._finger(side) for name, side in SIDES.items()}
        self._weight = 0.0

    def _body(self, mass: float, place: list[float], kind: int, **size: Any) -> int:
        shape = self._bullet.createCollisionShape(kind, **size, physicsClientId=self._world)
        body: int = self._bullet.createMultiBody(mass, shape, basePosition=place, physicsClientId=self._world)
        self._bullet.changeDynamics(
            body, -1, lateralFriction=FRICTION, spinningFriction=SPIN_LENGTH_M, linearDamping=0.0, angularDamping=0.0,
            physicsClientId=self._world,
        )  # fmt: skip
        return body

    def _finger(self, side: float) -> tuple[int, int]:
        """A sphere, and the constraint that leads it."""
        bullet, place = self._bullet, [side * (HALF_M + RADIUS_M + 0.001), BESIDE_M, 0.0]
        body = self._body(FINGER_KG, place, bullet.GEOM_SPHERE, radius=RADIUS_M)
        bullet.changeDynamics(body, -1, contactStiffness=STIFFNESS, contactDamping=DAMPING, physicsClientId=self._world)
        led = bullet.createConstraint(
            body, -1, -1, -1, bullet.JOINT_FIXED, [0.0] * 3, [0.0] * 3, place, physicsClientId=self._world
        )
        return body, led

    def lead(self, depth: float, height: float) -> None:
        for name, side in SIDES.items():
            place = [side * (HALF_M + RADIUS_M - depth), BESIDE_M, height]
            led = self._fingers[name][1]
            self._bullet.changeConstraint(led, place, maxForce=SERVO_N, physicsClientId=self._world)

    def weigh(self) -> None:
        self._weight = MASS_KG * GRAVITY

    def step(self) -> None:
        place = self._bullet.getBasePositionAndOrientation(self._box, self._world)[0]
        weight, frame = [0.0, 0.0, -self._weight], self._bullet.WORLD_FRAME
        self._bullet.applyExternalForce(self._box, -1, weight, place, frame, self._world)  # for this step alone
        self._bullet.stepSimulation(self._world)

    def box(self) -> Array:
        place, (x, y, z, w) = self._bullet.getBasePositionAndOrientation(self._box, self._world)
        return np.array([*place, w, x, y, z])

    def force(self) -> Array:
        total = np.zeros(3)
        for point in self._bullet.getContactPoints(self._fingers["thumb"][0], self._box, physicsClientId=self._world):
            total += point[9] * np.array(point[7]) + point[10] * np.array(point[11]) + point[12] * np.array(point[13])
        return total

    def close(self) -> None:
        self._bullet.disconnect(self._world)


def contacts(seconds: float) -> Iterator[tuple[str, Held]]:
    """How it held the box."""
    peer = Bullet()
    try:
        yield "Bullet", hold(peer, GRIP_N / STIFFNESS, seconds)
    finally:
        peer.close()
