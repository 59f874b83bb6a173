"""Grasp by Bullet's contact: spheres that are moved by fixed constraints.

The contact has Bullet's spinning friction and the stiffness of the fingertips here. All other settings are Bullet's
defaults.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import numpy as np

from softfinger.tools.bench import grasp_case as case
from softfinger.tools.bench.grasp_case import Held, Peer
from softfinger.tools.measure import Array

SERVO_N: Final = 1e3
"""Largest force of a constraint, far above the grip."""


def imported() -> Any:
    """Return the package pybullet; raises ConfigError if it is not installed."""
    return case.peer_module("bullet", "pybullet", "pybullet")


class Bullet(Peer):
    """World of pybullet."""

    def __init__(self) -> None:
        self._bullet: Final = imported()
        self._world: Final = self._bullet.connect(self._bullet.DIRECT)
        self._bullet.setTimeStep(case.DT, self._world)
        self._box: Final = self._body(
            case.MASS_KG, [0.0, 0.0, 0.0], self._bullet.GEOM_BOX, halfExtents=[case.HALF_M] * 3
        )
        self._fingers: Final = {name: self._finger(side) for name, side in case.SIDES.items()}
        self._weight = 0.0

    def _body(self, mass: float, place: list[float], kind: int, **size: Any) -> int:
        shape = self._bullet.createCollisionShape(kind, **size, physicsClientId=self._world)
        body: int = self._bullet.createMultiBody(mass, shape, basePosition=place, physicsClientId=self._world)
        self._bullet.changeDynamics(
            body, -1, lateralFriction=case.FRICTION, spinningFriction=case.SPIN_LENGTH_M,
            linearDamping=0.0, angularDamping=0.0, physicsClientId=self._world,
        )  # fmt: skip
        return body

    def _finger(self, side: float) -> tuple[int, int]:
        """Return a sphere and the constraint that moves it."""
        bullet, place = self._bullet, [case.x_of(side, -case.APART_M), case.BESIDE_M, 0.0]
        body = self._body(case.FINGER_KG, place, bullet.GEOM_SPHERE, radius=case.RADIUS_M)
        bullet.changeDynamics(
            body, -1, contactStiffness=case.STIFFNESS, contactDamping=case.DAMPING, physicsClientId=self._world
        )
        led = bullet.createConstraint(
            body, -1, -1, -1, bullet.JOINT_FIXED, [0.0] * 3, [0.0] * 3, place, physicsClientId=self._world
        )
        return body, led

    def lead(self, depth: float, height: float) -> None:
        for name, side in case.SIDES.items():
            place = [case.x_of(side, depth), case.BESIDE_M, height]
            led = self._fingers[name][1]
            self._bullet.changeConstraint(led, place, maxForce=SERVO_N, physicsClientId=self._world)

    def weigh(self) -> None:
        self._weight = case.MASS_KG * case.GRAVITY

    def step(self) -> None:
        place = self._bullet.getBasePositionAndOrientation(self._box, self._world)[0]
        weight, frame = [0.0, 0.0, -self._weight], self._bullet.WORLD_FRAME
        self._bullet.applyExternalForce(self._box, -1, weight, place, frame, self._world)  # for this step only
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
    """Yield the name of the contact and the grasp."""
    peer = Bullet()
    try:
        yield "Bullet", case.hold(peer, case.GRIP_N / case.STIFFNESS, seconds)
    finally:
        peer.close()
