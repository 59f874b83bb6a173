"""The paper's experiment: errors of every method, for both interpretations of its motion, and the times of all.

A fingertip of 10 mm rolls on a plane: 100 steps of 0.01 s, each by 0.03, 0.02 and 0.05 rad about x, y and z. The paper
does not state the frame of these axes:

    contact_frame   a contact frame that spins with the finger: the path is an arc. Every step is the same in that
                    frame, and the frame turns by the spin that the method computes
    world           the world frame: the path is a line

Source: Salvietti, Malvezzi, Prattichizzo (2013), section 3.1.
"""

from __future__ import annotations

from itertools import product
from typing import Any, Final

import numpy as np

from softfinger.proxy.kernels import model
from softfinger.proxy.kernels.contact.rolling import roll
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.server.loop.clock import make_stopwatch
from softfinger.server.progress import map_with_progress, show_progress
from softfinger.tools.accuracy.cases import METHODS, RADIUS_M
from softfinger.tools.accuracy.classical import (
    ABSOLUTE_TOLERANCE,
    MAX_STEP_SHARE,
    RELATIVE_TOLERANCE,
    Steps,
    roll_classical,
)
from softfinger.tools.accuracy.measure import roll_path_timed
from softfinger.tools.accuracy.montana import Coordinates
from softfinger.tools.accuracy.reference import roll_path
from softfinger.tools.bench.step import measure_reference_ns
from softfinger.tools.measure import Array

STEPS: Final = 100
STEP_S: Final = 0.01
TURN_RAD: Final = (0.03, 0.02, 0.05)
"""Rotation per step about x, y, z: the paper's delta psi, delta theta, delta phi."""
PLANE: Final = model.Plane((0.0, 0.0, 1.0), 0.0)
NORMAL: Final = (0.0, 0.0, 1.0)
CENTER: Final = (0.0, 0.0, RADIUS_M)
START: Final = Coordinates(0.0, 0.0, 0.0, 0.0, 0.0)
"""Start on the equator of the fingertip's chart, so that the path does not come near its poles."""
ROUNDS: Final = 15
"""Rounds of timing. Each round times all methods, so that a slow period of the machine affects all of them."""
MOTIONS: Final = ("contact_frame", "world")


def run_experiment() -> list[dict[str, Any]]:
    """Return the largest differences (mm) along x, y and z from the reference path, of every method in both motions."""
    exact_by_motion = {motion: compute_exact_path(motion) for motion in MOTIONS}

    def compare(case: tuple[str, str]) -> dict[str, Any]:
        motion, name = case
        path = compute_classical_path(motion) if name == "classical" else compute_method_path(name, motion)
        largest = 1e3 * np.abs(path - exact_by_motion[motion]).max(axis=0)
        heading = "phi" if case == ("contact_frame", "euler_zxz") else "own"
        return {"motion": motion, "method": name, "heading": heading, "max_error_mm": largest.tolist()}

    cases = list(product(MOTIONS, (*METHODS, "classical")))
    return map_with_progress("the paper's experiment", compare, cases)


def compute_exact_path(motion: str) -> Array:
    """Return the contact points (STEPS + 1, 3) m of the reference."""
    w, spin_rate = np.array(TURN_RAD) / STEP_S, TURN_RAD[2] / STEP_S if motion == "contact_frame" else 0.0

    def rate(t: float) -> Array:
        c, s = np.cos(spin_rate * t), np.sin(spin_rate * t)
        return np.array([c * w[0] - s * w[1], s * w[0] + c * w[1], w[2]])

    points, _, _ = roll_path(PLANE, RADIUS_M, CENTER, NORMAL, rate, STEPS * STEP_S, 4 * STEPS).at(list_times())
    return points


def list_times() -> Array:
    return np.asarray(STEP_S * np.arange(STEPS + 1))


def list_steps() -> Array:
    return np.tile(rotations.exp(TURN_RAD), (STEPS, 1))


def compute_method_path(name: str, motion: str) -> Array:
    """Return the contact points (STEPS + 1, 3) m of a rolling method.

    In the contact frame, euler_zxz uses the heading phi, since the axes are the ones before the step; the published
    differences belong to this choice. In all other cases the heading is that of the method.
    """
    method = METHODS[name]
    if motion == "world":
        return np.vstack([np.zeros(3), roll_path_timed(method, PLANE, CENTER, NORMAL, list_steps()).points])
    out = roll(method, PLANE, RADIUS_M, CENTER, NORMAL, rotations.exp(TURN_RAD))
    angle = out.spin * (np.arange(STEPS) + (0.5 if name == "euler_zxz" else 0.0))
    moved = complex(out.motion[0], out.motion[1]) * np.exp(1j * angle)
    path = np.concatenate([[0.0], np.cumsum(moved)])
    return np.column_stack([path.real, path.imag, out.motion[2] * np.arange(STEPS + 1)])


def compute_classical_path(motion: str) -> Array:
    """Return the contact points (STEPS + 1, 3) m of Montana's equations with ODE45 at its defaults, one call a step."""
    spin_rate = TURN_RAD[2] / STEP_S if motion == "contact_frame" else 0.0
    path, _, _ = time_classical(list_steps(), STEP_S, MAX_STEP_SHARE, spin_rate)
    return np.vstack([np.zeros(3), path])


def time_classical(
    turns: Array, dt: float, share: float, spin_rate: float = 0.0, blocks: int = 1
) -> tuple[Array, float, int]:
    """Return the path (n, 3) m, the median time of the complete motion, ns, and its evaluations of the equations."""
    path, watch = np.zeros((len(turns), 3)), make_stopwatch(blocks)
    count = roll_classical(PLANE, RADIUS_M, START, Steps(turns, dt, spin_rate), share, path, watch)
    return path, float(np.median(watch.ns)), int(count)


def measure_speed(blocks: int = 50) -> dict[str, Any]:
    """Measure the time of a step of the paper's motion in world axes, ns, of every method and of the classical method.

    Each measurement is one compiled loop over the same 100 rotations. The classical method calls ODE45 once per step,
    at its defaults, since a haptic loop does not know the next pose. For comparison, the result also has the classical
    method without the bound on the step length, and with two calls for the complete second, which know its rate in
    advance.
    """
    # Two halves, since a rotation of 6.2 rad cannot be distinguished from one of 0.1.
    dq, halves = list_steps(), np.array([rotations.exp(vec3.scale(STEPS / 2, TURN_RAD))] * 2)
    times: dict[str, list[float]] = {name: [] for name in (*METHODS, "classical", "free", "ahead", "reference")}
    counts: dict[str, int] = {}
    with show_progress("timing the methods", ROUNDS) as update:
        for number in range(ROUNDS):
            for name, method in METHODS.items():
                times[name].append(roll_path_timed(method, PLANE, CENTER, NORMAL, dq, blocks).step_ns)
            for name, turns, dt, share in (
                ("classical", dq, STEP_S, MAX_STEP_SHARE),
                ("free", dq, STEP_S, 1.0),
                ("ahead", halves, STEPS * STEP_S / 2.0, 2.0 * MAX_STEP_SHARE),
            ):
                _, time, counts[name] = time_classical(turns, dt, share, 0.0, blocks)
                times[name].append(time / STEPS)
            times["reference"].append(measure_reference_ns())
            update(number + 1)
    ns = {name: float(np.median(values)) for name, values in times.items()}
    return {
        "classical_ns_per_step": ns["classical"],
        **{f"{name}_ns_per_step": ns[name] for name in METHODS},
        "ratio": ns["classical"] / ns["euler_zxz"],
        "rotation_vector_ratio": ns["rotation_vector"] / ns["euler_zxz"],
        "reference_ns": ns["reference"],
        "classical": {
            "relative_tolerance": RELATIVE_TOLERANCE,
            "absolute_tolerance": ABSOLUTE_TOLERANCE,
            "max_step_share": MAX_STEP_SHARE,
            "evaluations_per_step": counts["classical"] / STEPS,
            "without_step_bound": {"ns_per_step": ns["free"], "evaluations_per_step": counts["free"] / STEPS},
            "known_ahead": {"ns_per_step": ns["ahead"], "evaluations_per_step": counts["ahead"] / STEPS},
        },
    }
