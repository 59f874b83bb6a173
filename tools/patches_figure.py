"""Figure of the force through a seam, a groove and a pinch, and table of friction errors in drags.

python -m softfinger.tools.patches_figure docs/figures/patches.svg
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from rich.console import Console

from softfinger.proxy.record import AT, SLIDING
from softfinger.server.offline.figures import make_figure, save
from softfinger.tools.accuracy.report import WIDTH, format_table
from softfinger.tools.measure import Array
from softfinger.tools.pages.figures import GRIP, RADIUS_M, make_poses, run

PRESS_M: Final = 0.001
NO_FRICTION: Final = {"kinetic": 0.0}
"""Friction table that stands for no friction."""
EIGHTH: Final = float(np.pi / 8.0)


class TouchCase(NamedTuple):
    """Touched objects, and poses (n, 7)."""

    objects: list[dict[str, Any]]
    poses: Array


class Drag(NamedTuple):
    """Friction errors of a drag, in the ticks after a sliding tick; the first sliding tick carries mu_s f_N.

    bias     N  tangential force less mu_d f_N, of all patches together, mean
    ripple   N  the largest change of the tangential force from one such tick to the next
    highest  1  tangential over normal force of a patch, the largest of all ticks
    """

    bias: float
    ripple: float
    highest: float


def make_path(*corners: tuple[float, float, float], ticks: int = 400) -> Array:
    """Return upright poses (n, 7) from corner to corner, with `ticks` ticks each."""
    return make_poses(*corners, ticks=ticks)[:-1]


def record_case(case: TouchCase) -> Array:
    records: Array = run(case.objects, case.poses, rolling={"method": "rotation_vector"})
    return records


def make_case(objects: list[dict[str, Any]]) -> TouchCase:
    """Return a case that presses onto z = 0 and drags by 20 mm along x, at 50 mm/s."""
    z = RADIUS_M - PRESS_M
    return TouchCase(objects, make_path((-0.01, 0.0, z + 0.002), (-0.01, 0.0, z), (0.01, 0.0, z)))


def make_plane() -> TouchCase:
    return make_case([{"name": "floor", "shape": "plane", "material": GRIP}])


def make_seam() -> TouchCase:
    """Return two flush boxes, with a drag from one to the other."""
    box = {"shape": "box", "size_m": [0.1, 0.1, 0.1], "material": GRIP}
    boxes = [box | {"name": f"box {i}", "position_m": [x, 0.0, -0.05]} for i, x in enumerate((-0.05, 0.05))]
    return make_case(boxes)


def make_groove() -> TouchCase:
    """Return two walls at right angles, one of them without friction, with a press and a drag along them."""
    walls = [
        {
            "name": f"wall {i}",
            "shape": "plane",
            "orientation_wxyz": [np.cos(EIGHTH), 0.0, side * np.sin(EIGHTH), 0.0],
            "material": material,
        }
        for i, (side, material) in enumerate(((1.0, GRIP), (-1.0, {"stiffness_n_per_m": 1000.0})))
    ]
    z = 2.0**0.5 * RADIUS_M - PRESS_M
    return TouchCase(walls, make_path((0.0, 0.0, z + 0.002), (0.0, 0.0, z), (0.0, 0.02, z)))


def make_pinch() -> TouchCase:
    """Return a finger at rest 1 mm deep in the floor, and a ceiling that descends onto it."""
    down = {"kind": "sinusoid", "translation_m": [0.0, 0.0, 0.008], "frequency_hz": 0.3}
    floor = {"name": "floor", "shape": "plane", "material": GRIP}
    ceiling = floor | {
        "name": "ceiling",
        "position_m": [0.0, 0.0, 2.0 * RADIUS_M + 0.003],
        "orientation_wxyz": [0.0, 1.0, 0.0, 0.0],
        "motion": down,
    }
    at = (0.0, 0.0, RADIUS_M - PRESS_M)
    return TouchCase([floor, ceiling], make_path(at, at, ticks=800))


def drag(case: TouchCase) -> Drag:
    """Return the friction errors of a case that is pressed and dragged."""
    records = record_case(case)
    kinetic = np.array([obj["material"].get("friction", NO_FRICTION)["kinetic"] for obj in case.objects])
    size, kinetic_load, highest = np.zeros(len(records)), np.zeros(len(records)), 0.0
    slides = records[:, AT.contacts0_object] >= 0.0
    for i in range(3):
        columns = {name: getattr(AT, f"contacts{i}_{name}") for name in ("object", "mode", "normal", "force")}
        number, mode = (records[:, columns[name]].astype(int) for name in ("object", "mode"))
        normal, force = (records[:, columns[name] : columns[name] + 3] for name in ("normal", "force"))
        mu = np.where(number >= 0, kinetic[number], 0.0)
        load = np.sum(force * normal, axis=1)
        rubs = np.linalg.norm(force - load[:, None] * normal, axis=1)
        size += rubs
        kinetic_load += mu * load
        slides &= (mode == SLIDING) | (mu == 0.0)
        highest = max(highest, float(np.max(rubs[load > 0.0] / load[load > 0.0], initial=0.0)))
    steady = slides[1:] & slides[:-1]
    change = np.abs(np.diff(size))[1:][steady[1:] & steady[:-1]]
    return Drag(float((size - kinetic_load)[1:][steady].mean()), float(change.max()), highest)


def format_drags_table() -> Any:
    """Return the table for plane, seam, groove and CHAI3D's plane."""
    drags = {"plane": drag(make_plane()), "seam": drag(make_seam()), "groove": drag(make_groove())}
    rows = [
        (name, f"{1e3 * abs(result.bias):.6f}", f"{1e3 * result.ripple:.6f}", f"{result.highest:.6f}")
        for name, result in drags.items()
    ]
    rows.append(("CHAI3D 3.3.0, plane of two triangles", "30", "52", "0.655"))
    columns = ("drag", "bias, mN", "ripple, mN a tick", "largest tangential / normal force")
    return format_table("friction of drags", columns, rows, 1)


def draw_patches(path: Path) -> None:
    drawing = make_figure(8.0, 6.5)
    for axes, (name, case) in zip(
        drawing.subplots(3, 1),
        {"seam": make_seam(), "groove": make_groove(), "pinch": make_pinch()}.items(),
        strict=True,
    ):
        records = record_case(case)
        milliseconds = 1e3 * records[:, AT.timestamp]
        for i, axis in enumerate("xyz"):
            axes.plot(milliseconds, records[:, AT.force + i], linewidth=1.2, label=f"${axis}$")
        for number in (0, 1):
            size = np.zeros(len(records))
            for on, at in ((AT.contacts0_object, AT.contacts0_force), (AT.contacts1_object, AT.contacts1_force)):
                size += (records[:, on] == number) * np.linalg.norm(records[:, at : at + 3], axis=1)
            axes.plot(milliseconds, size, linewidth=0.8, linestyle=":", label=f"on object {number}")
        axes.set_ylabel(f"{name}\nforce [N]")
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize="small")
        axes.margins(x=0.0)
    axes.set_xlabel("time [ms]")
    save(drawing, path)


if __name__ == "__main__":
    draw_patches(Path(sys.argv[1]))
    Console(width=WIDTH).print(format_drags_table())
