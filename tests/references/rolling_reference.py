"""The paper's Euler decomposition (eqs. 5-7) on matrices, and the rolling equation it approximates. The angles are the
z-x-z angles of the step's rotation in the contact frame: R = Rz(phi) Rx(theta) Rz(psi)."""

import math
from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp

from references.rotation import Array, tangent_frame


def zxz_angles(rotation: Array) -> tuple[float, float, float]:
    """(phi, theta, psi) rad of a rotation (3, 3) in the contact frame; theta in [0, pi]."""
    theta = math.atan2(math.hypot(rotation[0, 2], rotation[1, 2]), rotation[2, 2])
    if theta == 0.0:
        return math.atan2(rotation[1, 0], rotation[0, 0]), 0.0, 0.0
    return math.atan2(rotation[0, 2], -rotation[1, 2]), theta, math.atan2(rotation[2, 0], rotation[2, 1])


def zxz_roll(
    rotation: Array, normal: ArrayLike, heading: Literal["half_way", "phi"] = "half_way"
) -> tuple[Array, float, float]:
    """Return the roll vector theta e (3,) rad in the tangent plane, theta, and the spin about the normal, of a world
    rotation.

    Spin is phi + psi, computed as one angle: at small theta, phi and psi are noise, and so is their sum, but the matrix
    contains (1 + cos theta) e^(i (phi + psi)).
    """
    frame = tangent_frame(normal)
    local = frame.T @ rotation @ frame
    phi, theta, _ = zxz_angles(local)
    spin = math.atan2(local[1, 0] - local[0, 1], local[0, 0] + local[1, 1])
    angle = phi - spin / 2 if heading == "half_way" else phi
    return theta * (frame @ np.array([math.cos(angle), math.sin(angle), 0.0])), theta, spin


def zyx_roll(rotation: Array, normal: ArrayLike) -> tuple[Array, float, float]:
    """The same from roll, pitch and yaw in the contact frame: R = Rz(yaw) Ry(pitch) Rx(roll)."""
    frame = np.eye(3) if np.array_equal(normal, (0.0, 0.0, 1.0)) else tangent_frame(normal)
    local = frame.T @ rotation @ frame
    angles = [math.atan2(local[2, 1], local[2, 2]), math.atan2(-local[2, 0], math.hypot(local[0, 0], local[1, 0])), 0.0]
    return frame @ np.array(angles), math.hypot(angles[0], angles[1]), math.atan2(local[1, 0], local[0, 0])


def rolled_path(rotations: list[Array], radius: float) -> Array:
    """Contact path (n + 1, 3) m on the plane z = 0, from n world rotations (3, 3), one a step."""
    normal = np.array([0.0, 0.0, 1.0])
    steps = [radius * np.cross(zxz_roll(rotation, normal)[0], normal) for rotation in rotations]
    return np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])


def rolling_equation(
    rate: Callable[[float], ArrayLike], radius: float, times: ArrayLike, normal: ArrayLike = (0.0, 0.0, 1.0)
) -> tuple[Array, Array]:
    """Contact path (n, 3) m on a plane and rotations (n, 3, 3), under the world angular velocity rate(t) (3,) rad/s.

    Integrates R' = [w] R and u = (W_o + W_f)^-1 (w x n), with W_o = 0 and W_f = I / r: the classical
    equation without coordinates on the sphere. Steps are at most a tenth of the span, because the
    controller would jump over a rate that is zero at its first samples.
    """
    n, t = np.asarray(normal, float), np.asarray(times, float)
    curvature = np.zeros((3, 3)) + np.eye(3) / radius

    def derivative(time: float, state: Array) -> Array:
        w = np.asarray(rate(time), float)
        turning = np.cross(w, state[3:].reshape(3, 3).T).T
        return np.concatenate([np.linalg.solve(curvature, np.cross(w, n)), turning.ravel()])

    start = np.concatenate([np.zeros(3), np.eye(3).ravel()])
    span, longest = (t[0], t[-1]), (t[-1] - t[0]) / 10
    solution = solve_ivp(derivative, span, start, method="DOP853", t_eval=t, rtol=1e-13, atol=1e-16, max_step=longest)
    return np.asarray(solution.y[:3].T), np.asarray(solution.y[3:].T.reshape(-1, 3, 3))
