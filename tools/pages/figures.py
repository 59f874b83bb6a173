"""The figure at the head of each model page, drawn from the equations or computed by the engine: `make figures`.

    python -m softfinger.tools.pages.figures docs/figures

With `NUMBA_DISABLE_JIT=1`, as the target has it, the engine compiles nothing.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np

from softfinger.config.load import build
from softfinger.config.materials import load_fingertips
from softfinger.config.schema import Scene
from softfinger.drivers.poses import load_poses
from softfinger.drivers.resample import resample
from softfinger.proxy.engine import Engine
from softfinger.server.offline import feel_figure, library_texts
from softfinger.server.offline.figures import draw_legends_below, make_figure, save
from softfinger.tools.measure import Array
from softfinger.tools.pages import sketches, states

RADIUS_M: Final = 0.01
STIFFNESS_N_PER_M: Final = 1000.0
GRIP: Final = {"stiffness_n_per_m": STIFFNESS_N_PER_M, "friction": {"static": 0.6, "kinetic": 0.5}}
"""Fingertip and material of the paper."""


def make_poses(*corners: tuple[float, float, float], ticks: int = 200) -> Array:
    """Return upright poses (n, 7) along straight lines from corner to corner, m."""
    lines = [np.linspace(a, b, ticks, endpoint=False) for a, b in pairwise(corners)]
    points = np.vstack([*lines, corners[-1]])
    return np.hstack([points, np.tile([1.0, 0.0, 0.0, 0.0], (len(points), 1))])


def run(objects: list[dict[str, Any]], path: Array, **tables: Any) -> Any:
    mapping = {"fingertip": {"radius_m": RADIUS_M}, "object": objects, **tables}
    return Engine(build(Scene, mapping, "a figure")).run(path)


def make_plane(**material: Any) -> dict[str, Any]:
    return {"name": "plane", "shape": "plane", "material": GRIP | material}


def draw_normal(axes: Any) -> None:
    """Draw laws of the normal force against the depth, and the loop of Hunt-Crossley damping."""
    axes = axes[0]
    depth = np.linspace(0.0, 2e-3, 81)
    for exponent, name in ((1.0, "linear, p = 1"), (1.5, "Hertz, p = 1.5"), (2.5, "soft, p = 2.5")):
        axes.plot(1e3 * depth, compute_depth_force(depth, exponent), label=name)
    phase = np.linspace(0.0, np.pi, 81)
    speed = 0.002 * np.pi * np.cos(phase) * 20.0
    loop = 2e-3 * np.sin(phase)
    axes.plot(
        1e3 * loop,
        np.maximum(compute_depth_force(loop, 1.5) * (1.0 + 2.0 * speed), 0.0),
        "--",
        label="p = 1.5 with Hunt-Crossley damping, a press of 50 ms",
    )
    axes.set(xlabel="depth [mm]", ylabel="normal force [N]")


def compute_depth_force(depth: Array, exponent: float) -> Array:
    """Return K d (depth / d)^p, N, with 1000 N/m at 1 mm."""
    force: Array = STIFFNESS_N_PER_M * 1e-3 * (depth / 1e-3) ** exponent
    return force


def draw_friction(axes: Any) -> None:
    """Draw a drag back and forth: tangential force against the position of the probe."""
    axes = axes[0]
    z = RADIUS_M - 1e-3
    path = make_poses((0.0, 0.0, z), (0.002, 0.0, z), (0.0, 0.0, z))
    records = run([make_plane()], path, rolling={"method": "midpoint"}, coupling={"damping_ns_per_m": 0.0})
    x, force, slides = 1e3 * path[:, 0], records["force"][:, 0], records["contact.mode"] == 2
    axes.plot(x, np.where(slides, np.nan, force), label="sticking (mode rolling)")
    axes.plot(x, np.where(slides, force, np.nan), label="sliding")
    for limit, name, above in ((0.6, "$\\mu_s f_N$", -10), (0.5, "$\\mu_d f_N$", 4)):
        axes.axhline(-limit, linewidth=0.6, linestyle=":", color="0.4")
        axes.annotate(name, (1.2, -limit), xytext=(0, above), textcoords="offset points", fontsize="small")
    axes.set(ylim=(-0.72, 0.72), xlabel="position of the probe [mm]", ylabel="tangential force [N]")


def draw_patch(axes: Any) -> None:
    """Draw radius and torsional limit of a patch against the load."""
    load = np.linspace(0.0, 4.0, 81)
    hertz = (3.0 * load * RADIUS_M / (16.0 * 45e3)) ** (1.0 / 3.0)
    for radius, name in ((hertz, "Hertz, G = 45 kPa"), (0.004 * load**0.25, "a = 4 mm at 1 N, $\\gamma$ = 0.25")):
        axes[0].plot(load, 1e3 * radius, label=name)
        axes[1].plot(load, 1e3 * 0.6 * 3.0 * np.pi / 16.0 * radius * load, label=name)
    axes[0].set(xlabel="normal force [N]", ylabel="patch radius [mm]")
    axes[1].set(xlabel="normal force [N]", ylabel="torsional limit [N mm]")


def draw_materials(axes: Any) -> None:
    """Draw the friction of the library with published coefficients, and a finger pad's patch growing by two laws."""
    feel_figure.draw_overview(axes[0])
    names = ("human-index", "human-index-plateau")
    feel_figure.draw_patch(
        axes[1],
        {name: (load_fingertips()[name], library_texts.make_library_table("fingertip", name)) for name in names},
    )
    axes[0].figure.set_figheight(3.6)
    draw_legends_below(axes[0].figure, axes, "small")


def draw_effects(axes: Any) -> None:
    """Draw a plane with a magnet, approached and pressed: the force of contact and effect."""
    axes = axes[0]
    path = make_poses((0.0, 0.0, 0.035), (0.0, 0.0, 0.007))
    magnet = {"kind": "magnet", "force_n": 1.5, "range_m": 0.02}
    for exponent in (1.0, 3.0):
        records = run([make_plane(friction=None) | {"effect": [magnet | {"exponent": exponent}]}], path)
        axes.plot(1e3 * (path[:, 2] - RADIUS_M), records["force"][:, 2], label=f"magnet, exponent {exponent:g}")
    axes.axhline(0.0, linewidth=0.6, color="0.4")
    axes.set(xlabel="height of the fingertip above the plane [mm]", ylabel="force on the hand [N]")


def draw_texture(axes: Any) -> None:
    """Draw a stroke over the shipped ribs: normal force and force along the stroke."""
    z = RADIUS_M - 5e-4
    path = make_poses((0.0, 0.0, z), (0.008, 0.0, z), ticks=160)
    records = Engine("ribbed-plane").run(path)
    x = 1e3 * path[:, 0]
    axes[0].plot(x, records["contact.normal_force"])
    axes[1].plot(x, records["force"][:, 0])
    axes[0].set(xlabel="position [mm]", ylabel="normal force [N]")
    axes[1].set(xlabel="position [mm]", ylabel="force along the stroke [N]")


def draw_passivity(axes: Any) -> None:
    """Draw the energy that the hand has put in, over presses of several lengths."""
    axes = axes[0]
    z, deep = RADIUS_M, RADIUS_M - 1e-3
    for ticks in (10, 20, 50):
        path = make_poses(*[(0.0, 0.0, height) for height in (z, deep) * 4 + (z,)], ticks=ticks)
        force = run([make_plane(friction=None)], path)["force"]
        work = -np.cumsum(np.sum(force[:-1] * np.diff(path[:, :3], axis=0), axis=1))
        axes.plot(np.linspace(0.0, 4.0, len(work)), 1e3 * work, label=f"press of {ticks} ticks")
    axes.axhline(0.0, linewidth=0.6, color="0.4")
    axes.set(xlabel="presses", ylabel="energy E [mJ]")


def draw_bodies(axes: Any) -> None:
    """Draw a box lifted by two fingertips 8 mm off its centre of mass: height, and turn about the line between them."""
    hands = {name: resample(load_poses(f"lift-{name}"), 1000.0)[800:2600] for name in ("thumb", "index")}
    block = 10
    for name, torsion in (("with torsion", True), ("without torsion", False)):
        engine = sketches.make_lift(torsion)
        states = []
        for first in range(0, len(hands["thumb"]), block):
            engine.run({finger: poses[first : first + block] for finger, poses in hands.items()})
            states.append(engine.data.qpos.copy())
        height, turn = np.array(states)[:, 2], np.array(states)[:, 3:5]
        time = 1e-3 * block * np.arange(len(states))
        axes[0].plot(time, 1e3 * height, label=name)
        axes[1].plot(time, np.degrees(np.unwrap(2.0 * np.arctan2(turn[:, 1], turn[:, 0]))))
    axes[0].set(xlabel="time [s]", ylabel="height of the box [mm]")
    axes[1].set(xlabel="time [s]", ylabel="turn of the box [deg]")


Drawing = tuple[Callable[[Any], None], tuple[str, ...]]
"""Function that draws a figure, and free place for a legend in each of its axes, empty without a legend."""
FIGURES: Final[dict[str, Drawing]] = {
    "contact": (sketches.draw_contact, ("",)),
    "conventions": (sketches.draw_conventions, ("", "")),
    "normal": (draw_normal, ("upper left",)),
    "rolling": (sketches.draw_rolling, ("",)),
    "friction": (draw_friction, ("upper right",)),
    "patch": (draw_patch, ("lower right", "upper left")),
    "ellipsoid": (sketches.draw_ellipsoid, ("",)),
    "effects": (draw_effects, ("upper right",)),
    "materials": (draw_materials, ("", "")),
    "texture": (draw_texture, ("", "")),
    "heightmap": (sketches.draw_heightmap, ("upper right",)),
    "mesh": (sketches.draw_mesh, ("upper right",)),
    "passivity": (draw_passivity, ("lower left",)),
    "bodies": (draw_bodies, ("upper left", "")),
}
"""Drawing of each model page; the page on several patches has a figure of the study."""


def draw(drawing: Drawing, path: Path) -> None:
    draw_axes, legends = drawing
    count = len(legends)
    page = make_figure(3.6 * count + 1.8 * (count == 1), 2.8)
    axes = np.atleast_1d(page.subplots(1, count))
    draw_axes(axes)
    for panel, place in zip(axes, legends, strict=True):
        if place:
            panel.legend(loc=place, frameon=False, fontsize="small")
    save(page, path)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="figures", description=__doc__)
    parser.add_argument("folder", type=Path, help="where the figures go")
    folder = parser.parse_args(argv).folder
    for name, drawing in FIGURES.items():
        draw(drawing, folder / f"model-{name}.svg")
    draw((states.draw, ("",)), folder / "states.svg")
    sketches.draw(folder / "lift-a-box.svg")
    return 0


if __name__ == "__main__":
    sys.exit(main())
