"""Scene of many bodies for a benchmark: two fingers press and drag one of them, the others lie around it."""

from __future__ import annotations

from itertools import islice, product
from pathlib import Path
from typing import Any, Final

GEOMS_MAX: Final = 24
"""Largest number of geoms in a scene that fingers touch."""
HALF_M: Final = 0.02
SPACING_M: Final = 0.06
"""Distance between the centres, so that the bodies do not touch."""
KINDS: Final = {
    "box": f"{HALF_M} {HALF_M} {HALF_M}",
    "sphere": f"{HALF_M}",
    "capsule": f"{HALF_M} {HALF_M}",
    "cylinder": f"{HALF_M} {HALF_M}",
}
"""Size of each kind of geom; capsules and cylinders lie, so that all have the same height."""
GEOM: Final = """
    <body name="{name}" pos="{x} {y} -{half}"><freejoint/>
      <geom name="{name}" type="{kind}" size="{size}" zaxis="1 0 0" mass="0.1"/>
    </body>"""
MODEL: Final = """
<mujoco model="geoms">
  <option timestep="{timestep!r}" integrator="implicitfast"/>
  <worldbody>
    <geom name="floor" type="plane" group="1" size="1 1 0.1" pos="0 0 -{height}"/>{bodies}
  </worldbody>
</mujoco>
"""


def make_scene(count: int, rate_hz: float, folder: Path) -> dict[str, Any]:
    """Return a scene of `count` bodies of 100 g on a floor, touched by two fingers, with its model in `folder`.

    The bodies are of four kinds. Their tops are at z = 0, at which the shipped recording presses and drags.
    """
    places = sorted(product(range(-2, 3), repeat=2), key=lambda at: at[0] ** 2 + at[1] ** 2)
    bodies = []
    for number, (x, y) in enumerate(islice(places, count)):
        kind = list(KINDS)[number % len(KINDS)]
        placement = {"x": round(x * SPACING_M, 6), "y": round(y * SPACING_M, 6), "half": HALF_M}
        bodies.append(GEOM.format(name=f"{kind}-{number}", kind=kind, size=KINDS[kind], **placement))
    model = folder / "geoms.xml"
    text = MODEL.format(timestep=1.0 / rate_hz, height=2.0 * HALF_M, bodies="".join(bodies))
    model.write_text(text, encoding="utf-8")
    material = {
        "stiffness_n_per_m": 1000.0,
        "damping_ns_per_m": 2.0,
        "friction": {"static": 0.8, "kinetic": 0.7},
        "torsion": {"stiffness_nm_per_rad": 0.05, "friction_length_m": 0.004},
    }
    return {
        "finger": [{"name": name, "radius_m": 0.01} for name in ("thumb", "index")],
        "rolling": {"method": "midpoint"},
        "coupling": {"stiffness_n_per_m": 1000.0, "damping_ns_per_m": 1.0, "torsional_damping_nms_per_rad": 0.0015},
        "world": {"model": str(model), "geom": [{"group": 0, "material": material}]},
    }
