"""Maps of the stiffest stable wall: against its damping (Z-width), the servo rate and the delay.

Each map has the limit found on the real step, the exact limit of the linear loop and the passivity bound.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np

from softfinger.server.offline.figures import make_figure, save
from softfinger.tools.measure import Array
from softfinger.tools.options import POINTS
from softfinger.tools.stability.limit import WallCase
from softfinger.tools.stability.predicted import compute_passive_limit, find_linear_limit

LINE_POINTS: Final = 80


class Map(NamedTuple):
    """Key of the case that is varied, label of the axis, and whether it is logarithmic."""

    key: str
    label: str
    log: bool


MAPS: Final[Mapping[str, Map]] = {
    "zwidth": Map("wall_damping_ns_per_m", "wall damping B, N s/m", True),
    "rate": Map("rate_hz", "servo rate, Hz", True),
    "delay": Map("delay_ticks", "delay, ticks", False),
}

VARIANTS: Final[Mapping[str, Mapping[str, float]]] = {
    "device alone": {},
    "with a hand": {"hand_mass_kg": 0.1, "hand_damping_ns_per_m": 4.0, "hand_stiffness_n_per_m": 300.0},
    "with Coulomb friction": {"friction_n": 0.05},
    "with encoder steps": {"resolution_m": 20e-6},
    "with a velocity filter": {"velocity_time_constant_s": 0.002},
    "with passivity control": {"passivity_damping_ns_per_m": 20.0},
}
"""Additions to the case by `--compare`, one at a time.

The hand has the order of magnitude of a relaxed grip. The friction is the least of desktop devices, and the encoder
step twice that of a desktop device. The filter is that of the shipped scenes. The passivity controller has the default
of a scene.
"""


def find_damping_limit(case: WallCase) -> float:
    """Return the wall damping, N s/m, above which no wall of the linear loop is stable, to a percent."""
    low, high = 0.0, 1.0
    while find_linear_limit(vary(case, "wall_damping_ns_per_m", high).linear()) > 0.0:
        low, high = high, 2.0 * high
    while high - low > 0.01 * high:
        middle = 0.5 * (low + high)
        if find_linear_limit(vary(case, "wall_damping_ns_per_m", middle).linear()) > 0.0:
            low = middle
        else:
            high = middle
    return high


def vary(case: WallCase, key: str, value: float) -> WallCase:
    return msgspec.structs.replace(case, **{key: value})


def list_axis_values(name: str, case: WallCase, points: int) -> Array:
    """Return the values along the axis of a map."""
    if name == "zwidth":
        # Start far below the damping of the device, above which no damped wall is passive.
        top = find_damping_limit(case)
        return np.geomspace(min(0.1 * case.damping_ns_per_m or 1.0, 1e-3 * top), top, points)
    if name == "rate":
        return np.geomspace(250.0, 16_000.0, points)
    return np.arange(9.0)


def list_cases(name: str, case: WallCase, points: int = POINTS) -> list[WallCase]:
    key = MAPS[name].key
    is_integer = key == "delay_ticks"
    return [
        vary(case, key, int(value) if is_integer else value) for value in list_axis_values(name, case, points).tolist()
    ]


def draw_maps(path: Path, rows: Sequence[Mapping[str, Any]], case: WallCase) -> None:
    """Draw a panel for each map: limits of each variant as marks, theory of the first one as lines."""
    names = list(dict.fromkeys(row["map"] for row in rows))
    variants = list(dict.fromkeys(row["variant"] for row in rows))
    drawing = make_figure(3.0 + 5.0 * len(names), 5.0)
    lines: dict[str, Any] = {}
    for name, axes in zip(names, drawing.subplots(1, len(names), squeeze=False)[0], strict=True):
        key, label, log = MAPS[name]
        scale = 1e-3  # N/m to N/mm
        axes.set(xscale="log" if log else "linear", yscale="log")
        for number, variant in enumerate(variants):
            panel = [row for row in rows if row["map"] == name and row["variant"] == variant]
            x = [row[key] for row in panel]
            limits = [row["limit_n_per_m"] for row in panel]
            y = [np.nan if limit is None else scale * limit for limit in limits]
            (lines[f"{variant}: found"],) = axes.plot(x, y, "o" if number == 0 else ".-", color=f"C{number}")
        line = list_cases(name, case, LINE_POINTS)
        x, fine = [getattr(point, key) for point in line], [point.linear() for point in line]
        exact = [scale * find_linear_limit(loop) for loop in fine]
        passive = [scale * compute_passive_limit(loop) for loop in fine]
        (lines[f"{variants[0]}: exact linear limit"],) = axes.plot(x, exact, "-", color="C0", linewidth=1.0)
        (lines["passive below"],) = axes.plot(x, passive, "--", color="0.4", linewidth=1.0)
        axes.fill_between(x, passive, color="0.9")
        # A very soft wall is of no interest, and a logarithmic axis has no 0.
        axes.set_ylim(bottom=max(axes.get_ylim()[0], 1e-3 * axes.get_ylim()[1]))
        axes.set_xlabel(label)
        axes.grid(True, alpha=0.3)
    drawing.axes[0].set_ylabel("stiffest stable wall, N/mm")
    drawing.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=2 + len(names))
    save(drawing, path)
