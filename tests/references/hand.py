"""Hand that moves tick by tick, and the trace of the engine's results."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from conftest import paper_scene
from numpy.typing import ArrayLike, NDArray

from references.rotation import Array, multiply, quaternion
from softfinger.proxy.engine import Engine
from softfinger.proxy.step_result import Step


class Hand:
    """Collects poses (n, 7) of the fingertip centre, one a tick, and the last index of each motion, from `start` on."""

    def __init__(self, start: ArrayLike) -> None:
        self.ends: list[int] = []
        self.x = np.asarray(start, float)
        self.q = np.array([1.0, 0.0, 0.0, 0.0])
        self.poses = [np.concatenate([self.x, self.q])]

    def go(self, ticks: int, move: ArrayLike = (0.0, 0.0, 0.0), turn: ArrayLike = (0.0, 0.0, 0.0)) -> Hand:
        """Move by `move` (3,) m and turn by the world rotation vector `turn` (3,) rad, evenly over `ticks`."""
        x, q = self.x, self.q
        for i in range(1, ticks + 1):
            part = i / ticks
            self.x = x + part * np.asarray(move, float)
            self.q = multiply(quaternion(part * np.asarray(turn, float)), q)
            self.poses.append(np.concatenate([self.x, self.q]))
        self.ends.append(self.at)
        return self

    def go_to(self, ticks: int, goal: ArrayLike) -> Hand:
        """Move to `goal` (3,) m, evenly over `ticks`."""
        return self.go(ticks, np.asarray(goal, float) - self.x)

    @property
    def at(self) -> int:
        """Index of the last pose."""
        return len(self.poses) - 1


def pressed(depth: float = 0.001) -> Hand:
    """Hand of 10 mm that is free on its first tick and pressed into the plane z = 0 by `depth` m from the second on."""
    return Hand([0.0, 0.0, 0.011]).go_to(1, [0.0, 0.0, 0.01 - depth])


@dataclass(frozen=True)
class Trace:
    """The engine's answers over n ticks: vectors (n, 3), scalars (n,)."""

    poses: Array
    steps: list[Step]
    ends: list[int]
    """Last tick of each motion of the hand."""

    @property
    def force(self) -> Array:
        return np.array([s.force for s in self.steps])

    @property
    def torque(self) -> Array:
        return np.array([s.torque for s in self.steps])

    @property
    def proxy(self) -> Array:
        return np.array([s.proxy_position for s in self.steps])

    @property
    def mode(self) -> NDArray[np.int64]:
        return np.array([s.mode for s in self.steps])

    @property
    def normal_force(self) -> Array:
        return np.array([s.normal_force for s in self.steps])

    @property
    def tangential(self) -> Array:
        """Magnitude of the tangential force, N."""
        return np.array([s.tangential_force for s in self.steps])

    @property
    def events(self) -> list[tuple[int, str]]:
        """(tick, cause) of every transition."""
        return [(i, s.cause) for i, s in enumerate(self.steps) if s.cause != "none"]

    @property
    def causes(self) -> list[str]:
        """Return only the causes, in order."""
        return [cause for _, cause in self.events]


def drive(engine: Engine, hand: Hand, dt: float | None = None) -> Trace:
    """Step the engine through all of the hand's poses."""
    poses = np.array(hand.poses)
    return Trace(poses, [engine.step(pose[:3], pose[3:], dt) for pose in poses], hand.ends)


def plane_engine(**changes: Any) -> Engine:
    """Return an engine of the paper's plane, changed as in `conftest.paper_mapping`."""
    return Engine(paper_scene(**changes))


def on_plane(hand: Hand, **changes: Any) -> Trace:
    """Return the trace of a hand on that plane."""
    return drive(plane_engine(**changes), hand)
