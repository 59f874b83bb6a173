"""How the end of a rolled path depends on the tick: error and measured order of every rolling method.

    python -m softfinger.tools.convergence [--json] [--plot FILE.png]
    python -m softfinger.tools.convergence --paper [--json]

A fingertip of 10 mm rolls for a second, over about 1.7 rad, in ever more ticks. The motion is either a
constant angular velocity, for which a tick's rotation says all, or one that changes in size and direction,
of which the two poses of a tick do not tell everything: then no method has more than order 2.
"""

from __future__ import annotations

import argparse
import sys
from typing import Any, Final

import numpy as np

from softfinger.proxy.kernels import model, rotations, vec3
from softfinger.proxy.kernels.jit import entry
from softfinger.proxy.kernels.rolling import roll
from softfinger.proxy.kernels.surfaces import closest
from softfinger.server.progress import progress
from softfinger.tools.measure import Array, add_output_options, figure, show

RADIUS_M: Final = 0.01
TICKS: Final = (8, 16, 32, 64, 128, 256, 512)
REFERENCE_STEPS: Final = 8192
ROUNDING_M: Final = 1e-14
"""Errors below are rounding and say nothing about an order."""

METHODS: Final[dict[str, Any]] = {
    "euler_zxz": model.EulerZxz(1.0),
    "euler_zyx": model.EulerZyx(1.0),
    "rotation_vector": model.RotationVector(1.0),
    "midpoint": model.Midpoint(1.0),
    "montana_rk4": model.MontanaRk4(1.0),
    "montana_rk45": model.MontanaRk45(1.0, 1e-12),
}
SHAPES: Final[dict[str, Any]] = {
    "plane": model.Plane((0.0, 0.0, 1.0), 0.0),
    "sphere": model.Sphere(0.05, 1.0),
    "cylinder": model.Cylinder(0.03, 1.0),
    "ellipsoid": model.Ellipsoid((0.05, 0.03, 0.02), 1.0),
    "torus": model.Torus(0.05, 0.02, 1.0),
}
START: Final = (0.04, 0.02, 0.03)
"""The path begins over the point of the shape nearest to this one, m."""


@entry
def roll_through(method: Any, shape: Any, radius: float, start: Any, turns: Array) -> Any:
    """Centre (3,) m after the rotations `turns` (n, 4), beginning over the point nearest to `start`."""
    _, point, normal = closest(shape, start)
    center = vec3.add_scaled(point, radius, normal)
    for i in range(turns.shape[0]):
        out = roll(method, shape, radius, center, normal, (turns[i, 0], turns[i, 1], turns[i, 2], turns[i, 3]))
        center, normal = out.center, out.normal
    return center


@entry
def integrate_rates(shape: Any, radius: float, start: Any, rates: Array, h: float) -> Any:
    """The same for the angular velocities `rates` (2 n + 1, 3) rad/s at every half step h / 2, to the fourth order."""
    _, point, normal = closest(shape, start)
    center = vec3.add_scaled(point, radius, normal)
    for i in range(rates.shape[0] // 2):
        moved = (0.0, 0.0, 0.0)
        for stage in range(4):
            at = 2 * i + (0 if stage == 0 else (2 if stage == 3 else 1))
            w = (rates[at, 0], rates[at, 1], rates[at, 2])
            slope = vec3.scale(radius * h, vec3.cross(w, normal))
            moved = vec3.add_scaled(moved, 1.0 / 6.0 if stage == 0 or stage == 3 else 1.0 / 3.0, slope)
            ahead = moved if stage == 3 else vec3.scale(1.0 if stage == 2 else 0.5, slope)
            _, point, normal = closest(shape, vec3.add(center, ahead))
        center = vec3.add_scaled(point, radius, normal)
    return center


def motion(kind: str, times: Array) -> tuple[Array, Array]:
    """Orientations (n, 4) and angular velocities (n, 3) rad/s of the fingertip at `times` (n,) s.

    "constant" turns at one rate; "changing" is a turn about z after one about x, by different sines.
    """
    if kind == "constant":
        w = np.array([0.9, -1.0, 1.1])
        angle = np.linalg.norm(w) * times / 2
        axis = w / np.linalg.norm(w)
        return np.column_stack([np.cos(angle), np.sin(angle)[:, None] * axis]), np.tile(w, (len(times), 1))
    tilt, spin = 1.2 * np.sin(1.5 * times), 0.8 * np.sin(2.0 * times)
    d_tilt, d_spin = 1.8 * np.cos(1.5 * times), 1.6 * np.cos(2.0 * times)
    ct, st, cs, ss = np.cos(tilt / 2), np.sin(tilt / 2), np.cos(spin / 2), np.sin(spin / 2)
    rates = np.column_stack([d_tilt * np.cos(spin), d_tilt * np.sin(spin), d_spin])
    return np.column_stack([cs * ct, cs * st, ss * st, ss * ct]), rates


def turns(kind: str, ticks: int) -> Array:
    """Relative rotations (ticks, 4) of a second in so many ticks."""
    q, _ = motion(kind, np.linspace(0.0, 1.0, ticks + 1))
    steps = [rotations.relative(tuple(b), tuple(a)) for a, b in zip(q[:-1].tolist(), q[1:].tolist(), strict=True)]
    return np.array(steps)


def order(errors: list[float]) -> float | None:
    """Slope of error against tick, by its last two halvings above rounding; None where there are none."""
    clear = [error for error in errors if error > 10.0 * ROUNDING_M]
    return float(np.log2(clear[-3] / clear[-1]) / 2.0) if len(clear) >= 3 else None


def measure() -> list[dict[str, Any]]:
    """A row for each motion, shape and method: errors (m) at the end of the path for each of TICKS, and the order."""
    rows = []
    for kind in ("constant", "changing"):
        _, rates = motion(kind, np.linspace(0.0, 1.0, 2 * REFERENCE_STEPS + 1))
        for name, shape in SHAPES.items():
            exact = np.array(integrate_rates(shape, RADIUS_M, START, rates, 1.0 / REFERENCE_STEPS))
            for method, node in METHODS.items():
                if method == "rotation_vector" and name in ("ellipsoid", "torus"):
                    continue
                ends = [roll_through(node, shape, RADIUS_M, START, turns(kind, n)) for n in TICKS]
                errors = [float(np.linalg.norm(np.array(end) - exact)) for end in ends]
                rows.append(
                    {"motion": kind, "shape": name, "method": method, "error_m": errors, "order": order(errors)}
                )
    return rows


def paper() -> list[dict[str, Any]]:
    """The paper's experiment: largest differences (mm) along x and y from the exact path, for both readings of it.

    100 steps on a plane, each by 0.03, 0.02 and 0.05 rad about x, y, z. "line": axes fixed in the world.
    "arc": axes of a contact frame that spins with the finger, by what the method takes for the spin. The
    heading is where the roll axis lies: as the method has it, or for ZXZ at phi, as before the step.
    """
    w, steps = np.array([0.03, 0.02, 0.05]), np.arange(101)
    normal, start = (0.0, 0.0, 1.0), (0.0, 0.0, RADIUS_M)
    straight = RADIUS_M * complex(w[1], -w[0])
    rows = []
    for reading, method, at_phi in (
        ("arc", "euler_zxz", True), ("arc", "euler_zyx", False), ("arc", "rotation_vector", False),
        ("line", "euler_zxz", False), ("line", "euler_zyx", False), ("line", "rotation_vector", False),
    ):  # fmt: skip
        out = roll(METHODS[method], SHAPES["plane"], RADIUS_M, start, normal, rotations.exp(tuple(w.tolist())))
        step = complex(out.motion[0], out.motion[1]) * (np.exp(0.5j * out.spin) if at_phi else 1.0)
        if reading == "line":
            exact, found = straight * steps, step * steps
        else:
            exact = straight * (np.exp(1j * w[2] * steps) - 1.0) / (1j * w[2])
            found = np.concatenate([[0.0], np.cumsum(step * np.exp(1j * out.spin * steps[:-1]))])
        off = 1e3 * (found - exact)
        largest = [float(np.abs(off.real).max()), float(np.abs(off.imag).max())]
        rows.append({"motion": reading, "method": method, "heading": "phi" if at_phi else "own", "largest_mm": largest})
    return rows


def draw(rows: list[dict[str, Any]], path: Any) -> None:
    """Error against tick, a panel for each motion and shape."""
    drawing = figure(path, 3.2 * len(SHAPES), 6.4)
    panels = drawing.subplots(2, len(SHAPES), sharex=True, sharey=True, squeeze=False)
    lines: dict[str, Any] = {}
    for row in rows:
        axes = panels[int(row["motion"] == "changing")][list(SHAPES).index(row["shape"])]
        colour = f"C{list(METHODS).index(row['method'])}"
        line = axes.loglog([1.0 / n for n in TICKS], np.maximum(row["error_m"], 1e-18), color=colour, marker=".")
        lines[row["method"]] = line[0]
        axes.set_title(f"{row['shape']}, {row['motion']} rate")
    for axes in panels[1]:
        axes.set_xlabel("tick, s")
    for first, *_ in panels:
        first.set_ylabel("error after 1 s, m")
    drawing.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=len(lines))
    drawing.savefig(path)


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--paper", action="store_true", help="the paper's experiment instead, both readings of it")
    add_output_options(parser)


def run(args: argparse.Namespace) -> int:
    if args.paper:
        rows = paper()
        lines = ["largest difference from the exact path along x and y, mm"]
        for row in rows:
            x, y = row["largest_mm"]
            lines.append(f"  {row['motion']:<6} {row['method']:<16} heading {row['heading']:<5} {x:9.5f} {y:9.5f}")
        show({"rows": rows}, args.json, lines)
        return 0
    with progress("measuring the rolling methods"):
        rows = measure()
    lines = [f"error (m) after a second in {TICKS[0]} and in {TICKS[-1]} ticks, and measured order"]
    for row in rows:
        what = f"{row['motion']:<9} {row['shape']:<10} {row['method']:<16}"
        slope = "-" if row["order"] is None else f"{row['order']:.2f}"
        lines.append(f"  {what} {row['error_m'][0]:9.1e} {row['error_m'][-1]:9.1e}  {slope:>5}")
    show({"radius_m": RADIUS_M, "ticks": list(TICKS), "rows": rows}, args.json, lines)
    if args.plot:
        draw(rows, args.plot)
    return 0


if __name__ == "__main__":
    _parser = argparse.ArgumentParser(prog="softfinger.tools.convergence", description=__doc__)
    configure(_parser)
    sys.exit(run(_parser.parse_args()))
