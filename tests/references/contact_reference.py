"""One tick of the contact on a plane by the equations of the model only: numpy vectors and matrices, no kernels."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from references.rolling_reference import zxz_roll
from references.rotation import Array, matrix

FREE, ROLLING, SLIDING = 0, 1, 2


@dataclass
class Parameters:
    """SI; the plane passes through `origin` with the outward unit `normal`."""

    radius: float = 0.01
    k_n: float = 1000.0
    k_t: float = 1000.0
    k_tau: float = 1000.0
    damping: float = 0.0
    b_t: float = 0.0
    mu_s: float = 0.6
    mu_d: float = 0.5
    k_z: float = 0.05
    mu_t: float = 0.004
    resolution: float = 0.0
    origin: Array = field(default_factory=lambda: np.zeros(3))
    normal: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))


@dataclass
class Outcome:
    """Result of one tick; vectors (3,) in the world."""

    mode: int
    cause: str
    center: Array
    force: Array
    torque: Array
    rolled: float
    spin: float


class ReferenceContact:
    """The state between ticks: proxy centre, dragged and rolled deflection, spin, slip speed."""

    def __init__(self, parameters: Parameters) -> None:
        self.q = parameters
        self.last_x: Array | None = None
        self.last_rotation = np.eye(3)
        self.clear()

    def clear(self) -> None:
        self.mode = FREE
        self.c = self.l = self.p = self.last_e = np.zeros(3)
        self.phi = self.rolled = self.slip_speed = self.e_pl = 0.0

    def tick(self, position: ArrayLike, orientation: ArrayLike, dt: float) -> Outcome:
        """Advance by one pose: position (3,) m, quaternion (4,)."""
        x, rotation, q = np.asarray(position, float), matrix(orientation), self.q
        previous_x = x if self.last_x is None else self.last_x
        previous_rotation = rotation if self.last_x is None else self.last_rotation
        self.last_x, self.last_rotation = x, rotation
        n = q.normal
        gap = float(n @ (x - q.origin))
        if gap >= q.radius:
            cause = "none" if self.mode == FREE else "release"
            self.clear()
            return Outcome(FREE, cause, x, np.zeros(3), np.zeros(3), 0.0, 0.0)
        delta = q.radius - gap
        # Plain difference: the comparison switches the velocity filter off.
        v_n = float(n @ (x - previous_x)) / dt
        f_n = min(max(q.k_n * delta - q.damping * v_n, 0.0), 2 * q.k_n * delta)
        if self.mode == FREE:
            self.mode, self.c = ROLLING, x + delta * n
            cause, spin = "touch", 0.0
        else:
            cause, spin = "none", self._roll(rotation @ previous_rotation.T)
        self._load(x, delta)
        cause = self._friction(x, delta, f_n, spin, dt, cause)
        e = self.l + self.p
        f_t = q.k_t * e
        if self.mode == ROLLING and cause != "touch":
            f_t = f_t + q.b_t * (e - self.last_e) / dt
        self.last_e = e
        limit = q.mu_s * f_n
        if np.linalg.norm(f_t) > limit:
            f_t = f_t * (limit / np.linalg.norm(f_t))
        torque = -q.k_z * self.phi * n - q.radius * np.cross(n, f_t)
        return Outcome(self.mode, cause, self.c, f_n * n + f_t, torque, self.rolled, self.phi)

    def _roll(self, rotation: Array) -> float:
        roll, theta, spin = zxz_roll(rotation, self.q.normal)
        u = self.q.radius * np.cross(roll, self.q.normal)
        self.c = self.c + u
        self.p = self.p + u
        self.rolled += theta
        return spin

    def _load(self, x: Array, delta: float) -> None:
        self.c = self.c + (delta - (self.c - x) @ self.q.normal) * self.q.normal
        e = self.c - x - delta * self.q.normal
        self.l = e - self.p
        square = float(self.p @ self.p)
        a = min(max(-float(self.l @ self.p) / square, 0.0), 1.0) if square > 0.0 else 0.0
        self.l = self.l + a * self.p
        self.p = self.p * (1 - a)

    def _friction(self, x: Array, delta: float, f_n: float, spin: float, dt: float, cause: str) -> str:
        q = self.q
        was_sliding = self.mode == SLIDING
        e = self.l + self.p
        size = float(np.linalg.norm(e))
        bound = q.mu_d * f_n if was_sliding else None
        load = float(np.linalg.norm(q.k_t * self.l + q.k_tau * self.p))
        # A load that is rounding does not leave a cone that damping has closed (f_N = 0).
        if not was_sliding and load >= q.mu_s * f_n and load > 1e-9 * q.k_t * q.radius:
            dragged = q.k_t * np.linalg.norm(self.l) >= q.k_tau * np.linalg.norm(self.p)
            cause = "drag" if dragged else "theta_max"
            self.mode, bound = SLIDING, q.mu_s * f_n
        slip = 0.0
        if bound is not None:
            factor = min(1.0, bound / (q.k_t * size)) if size > 0.0 else 1.0
            slip = size * (1 - factor)
            e = factor * e
            self.l, self.p = e, np.zeros(3)
            self.c = x + delta * q.normal + e
        limit = q.mu_t * f_n / q.k_z
        self.phi = min(max(self.phi + spin, -limit), limit)
        if was_sliding:
            return self._restick(size, slip, dt, cause)
        # The low-pass starts with the slip of the tick in which sliding begins.
        self.slip_speed, self.e_pl = slip / dt, size - slip
        return cause

    def _restick(self, size: float, slip: float, dt: float, cause: str) -> str:
        # First-order low-pass of 10 ms, backward Euler.
        self.slip_speed += dt / (0.010 + dt) * (slip / dt - self.slip_speed)
        after = size - slip
        if slip > 1e-9 * size:
            self.e_pl = after
            return cause
        if self.slip_speed < 0.5e-3:
            self.mode = ROLLING
            return "stop"
        if self.e_pl - after > max(0.1 * self.e_pl, 3 * self.q.resolution):
            self.mode = ROLLING
            return "reverse"
        return cause
