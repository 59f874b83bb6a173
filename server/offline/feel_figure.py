"""Figures of the library: the model of a material or fingertip next to published values."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from softfinger.config.arrays import Array
from softfinger.config.materials import LibraryEntry, Measurement
from softfinger.config.schema import Fingertip, Material
from softfinger.server.offline.figures import draw_legends_below, make_figure, save
from softfinger.server.offline.library_texts import find_entry, load_entries, make_library_table

LOAD_N: Final = (0.1, 20.0)
"""Range of loads in the figures: from a touch to a firm grip."""
SHEAR_PER_YOUNG: Final = 1.0 / 3.0
"""Shear modulus over Young's modulus of an incompressible solid."""


def draw(name: str, path: Path) -> None:
    """Draw an entry and save it as .png or .svg. Raises ConfigError if the name is unknown."""
    kind, entry = find_entry(name)
    drawing = make_figure(9.0, 3.6)
    axes = drawing.subplots(1, 2)
    if kind == "material":
        material = make_library_table(kind, name)
        draw_friction(axes[0], entry, material)
        draw_depth(axes[1], entry, material)
    else:
        tip = make_library_table(kind, name)
        draw_patch(axes[0], {name: (entry, tip)})
        draw_torsion(axes[1], {name: tip})
    drawing.suptitle(f"{name}: {entry.about}\nholds for {entry.holds}", fontsize="x-small")
    draw_legends_below(drawing, axes, "x-small")
    save(drawing, path)


# --- materials -----------------------------------------------------------------------------------------


def draw_friction(axes: Any, entry: LibraryEntry, material: Material) -> None:
    """Draw static and kinetic friction over the load, and the published coefficients at their loads."""
    law = material.friction
    assert law is not None  # every material of the library has friction
    axes.plot(LOAD_N, [law.static] * 2, color="C0", label="model, static")
    axes.plot(LOAD_N, [law.kinetic] * 2, "--", color="C0", label="model, kinetic")
    points = [study for study in entry.measured if study.friction is not None]
    free_loads = np.geomspace(0.3, 8.0, len(points) + 2)[1:-1]
    for index, study in enumerate(points):
        load = free_loads[index] if study.load_n is None else float(np.sqrt(study.load_n[0] * study.load_n[1]))
        load_note = "" if study.load_n else ", load unknown"
        draw_point(axes, load, study, f"C{index + 1}", f"{study.of}{load_note} ({study.paper})")
    axes.set(xscale="log", xlabel="load [N]", ylabel="coefficient of friction")
    axes.set_ylim(0.0, 1.1 * axes.get_ylim()[1])


def draw_point(axes: Any, x: float, study: Measurement, color: str, label: str) -> None:
    """Draw a published coefficient with its deviation and the range of loads that it averages."""
    load_range = None if study.load_n is None else [[x - study.load_n[0]], [study.load_n[1] - x]]
    axes.errorbar(x, study.friction, spread(study), load_range, fmt="o", ms=4, capsize=3, color=color, label=label)


def spread(study: Measurement) -> list[list[float]]:
    """Return the lower and upper error bar of a published coefficient: its deviation, or below to the lowest value."""
    deviation = study.sd or 0.0
    return [[deviation if study.low is None or study.friction is None else study.friction - study.low], [deviation]]


def draw_overview(axes: Any) -> None:
    """Draw the coefficients of all materials with a published coefficient on skin, and these coefficients."""
    measured_entries = [
        (name, entry) for name, (_, entry) in load_entries().items() if any(study.friction for study in entry.measured)
    ]
    rows = dict(zip((name for name, _ in measured_entries), range(len(measured_entries), 0, -1), strict=True))
    laws = np.array([[entry.values["friction"][key] for key in ("kinetic", "static")] for _, entry in measured_entries])
    axes.hlines(list(rows.values()), *laws.T, color="C0", lw=2.5, label="model, kinetic to static")
    axes.plot(laws[:, 1], list(rows.values()), "|", color="C0", ms=6)  # visible if both are equal
    points = [
        (rows[name], study)
        for name, entry in measured_entries
        for study in entry.measured
        if study.friction is not None
    ]
    axes.errorbar(
        [study.friction for _, study in points],
        [row - 0.25 for row, _ in points],
        xerr=np.hstack([spread(study) for _, study in points]),
        fmt="o", ms=2.5, capsize=1.5, lw=1, color="C1", label="published, of skin",
    )  # fmt: skip
    axes.set_yticks(list(rows.values()), list(rows), fontsize="x-small")
    axes.set(xlabel="coefficient of friction", xlim=(0.0, 1.8))


def draw_depth(axes: Any, entry: LibraryEntry, material: Material) -> None:
    """Draw the normal force over the depth, and that of an elastic sphere for the range of measured moduli.

    There are no published points of force over depth: no table of them was accessible.
    """
    force = np.linspace(0.0, 3.0, 61)
    origin = "chosen for rendering, not measured" if material.normal is None else "computed, by Hertz"
    line = [1e3 * material.depth_under(load) if load else 0.0 for load in force]
    axes.plot(line, force, color="C0", label=f"model: {origin}")
    for study in entry.measured:
        if study.youngs_modulus_pa is not None:
            low, high = (1e3 * compute_hertz_depth(force, young, RADIUS_M) for young in study.youngs_modulus_pa)
            axes.fill_betweenx(force, high, low, color="C1", alpha=0.25, lw=0, label=label_band(study))
    axes.set(xlabel="depth [mm]", ylabel="normal force [N]")


def label_band(study: Measurement) -> str:
    """Return the label of a band: a published range and a law."""
    quantity = "modulus, by Hertz" if study.youngs_modulus_pa is not None else "exponent"
    return f"range of the {quantity}: {study.of} ({study.paper})"


RADIUS_M: Final = 0.01
"""Radius of the finger pad for which the materials are computed."""


def compute_hertz_depth(force: Array, youngs_modulus_pa: float, radius_m: float) -> Array:
    """Return the depth, m, of an incompressible elastic sphere on a rigid plane under `force`, N.

    (3 F / (4 E* sqrt(r)))^(2/3), E* = E / (1 - 1/4)
    """
    reduced = youngs_modulus_pa / 0.75
    depth_m: Array = (3.0 * force / (4.0 * reduced * np.sqrt(radius_m))) ** (2.0 / 3.0)
    return depth_m


# --- fingertips ----------------------------------------------------------------------------------------


def draw_patch(axes: Any, tips: dict[str, tuple[LibraryEntry, Fingertip]]) -> None:
    """Draw the patch radius over the load, and the bands that follow from measured moduli and exponents."""
    load = np.linspace(0.0, 10.0, 31)
    drawn_labels: set[str] = set()
    for name, (entry, tip) in tips.items():
        axes.plot(load, 1e3 * compute_patch_radius(tip, load), label=f"{name}, computed")
        for study in entry.measured:
            band = compute_patch_band(study, tip)
            if band is not None and (text := label_band(study)) not in drawn_labels:
                drawn_labels.add(text)
                loads, low, high = band
                axes.fill_between(loads, 1e3 * low, 1e3 * high, alpha=0.2, lw=1.0, label=text)
    axes.set(xlabel="load [N]", ylabel="radius of the patch [mm]")
    axes.set_ylim(bottom=0.0)


def compute_patch_band(study: Measurement, tip: Fingertip) -> tuple[Array, Array, Array] | None:
    """Return loads (n,) N, and smallest and largest radius (n,) m for a published range; None for another quantity.

    A modulus gives the radius by Hertz's law on this fingertip; an exponent scales the radius of this fingertip at 1 N.
    """
    load = np.linspace(*(study.load_n or (0.0, 10.0)), 9)
    if study.youngs_modulus_pa is not None:
        moduli = (SHEAR_PER_YOUNG * young for young in study.youngs_modulus_pa)
        soft, stiff = (compute_hertz_radius(load, modulus, tip.radius_m or 0.0) for modulus in moduli)
        return load, stiff, soft
    if study.patch_exponent is not None:
        ends = [compute_patch_radius(tip, np.ones(1))[0] * load**exponent for exponent in study.patch_exponent]
        return load, np.minimum(*ends), np.maximum(*ends)
    return None


def compute_patch_radius(tip: Fingertip, load: Array) -> Array:
    """Return the patch radius (n,) m under `load` (n,) N on a rigid plane, according to the contact model."""
    radius, pad = tip.radius_m or 0.0, tip.patch
    assert pad is not None  # every fingertip of the library has a patch
    if pad.radius_m is None:
        return np.minimum(compute_hertz_radius(load, pad.shear_modulus_pa, radius), radius)
    exponent = 1.0 / 3.0 if pad.exponent is None else pad.exponent
    return np.minimum(pad.radius_m * load**exponent, radius)


def compute_hertz_radius(load: Array, shear_modulus_pa: float, radius_m: float) -> Array:
    """Return the patch radius, m, of an incompressible elastic sphere on a rigid plane: (3 F r / (16 G))^(1/3)."""
    radius: Array = (3.0 * load * radius_m / (16.0 * shear_modulus_pa)) ** (1.0 / 3.0)
    return radius


def draw_torsion(axes: Any, tips: dict[str, Fingertip]) -> None:
    """Draw the torsional limit divided by the coefficient of friction, over the load."""
    load = np.linspace(0.0, 4.0, 61)[1:]
    for name, tip in tips.items():
        assert tip.patch is not None
        arm = compute_mean_distance(tip.patch.pressure_exponent or 2.0) * compute_patch_radius(tip, load)
        axes.plot(load, 1e3 * arm * load, label=f"{name}, computed")
    axes.set(xlabel="load [N]", ylabel="torsional limit over friction [N mm]")


def compute_mean_distance(exponent: float, steps: int = 4000) -> float:
    """Return the mean distance from the centre of a patch of radius 1 under the pressure (1 - s^k)^(1/k)."""
    s = (np.arange(steps) + 0.5) / steps
    pressure = (1.0 - s**exponent) ** (1.0 / exponent)
    return float((pressure * s * s).sum() / (pressure * s).sum())
