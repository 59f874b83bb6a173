"""Geoms of one kind stand in rows, which compile once: what is felt of them is what is felt of each by itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from softfinger.proxy import scene as scenes
from softfinger.proxy.engine import Engine
from softfinger.proxy.kernels.jit.decorators import PLAIN
from softfinger.proxy.kernels.jit.rows import Rows

pytestmark = [
    pytest.mark.plain,
    pytest.mark.skipif(not PLAIN, reason="asked in plain Python: compiled, each of two scenes takes a minute"),
]

R, HALF, APART = 0.008, 0.02, 0.041
MODEL = """
<mujoco>
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1"/>
    <geom name="left" type="box" size="0.02 0.02 0.02" pos="0 -0.06 0.02"/>
    <geom name="right" type="box" size="0.02 0.02 0.02" pos="0 0.06 0.02"/>
    {bodies}
  </worldbody>
</mujoco>
"""
BODY = """
    <body pos="{x} 0 {z}" euler="0 0 {turn}"><freejoint/>
      <geom name="{kind}-{x}" type="{kind}" size="0.02 0.02 0.02" mass="0.1"/></body>"""
MATERIAL = {
    "stiffness_n_per_m": 1000.0,
    "damping_ns_per_m": 2.0,
    "friction": {"static": 0.8, "kinetic": 0.7},
    "torsion": {"stiffness_nm_per_rad": 0.05, "friction_length_m": 0.004},
}


def engine(folder: Path) -> Engine:
    """Two balls and three boxes in a row along x, two more boxes that stand, and two fingers."""
    bodies = [
        BODY.format(x=APART * n, z=HALF, turn=5 * n, kind="sphere" if n % 2 else "box") for n in (-2, -1, 0, 1, 2)
    ]
    path = folder / "many.xml"
    path.write_text(MODEL.format(bodies="".join(bodies)), encoding="utf-8")
    fingers = [{"name": name, "radius_m": R} for name in ("thumb", "index")]
    coupling = {"stiffness_n_per_m": 1000.0, "damping_ns_per_m": 1.0, "torsional_damping_nms_per_rad": 1.5e-3}
    world = {"model": str(path), "material": MATERIAL, "substeps": 1}
    return Engine({"finger": fingers, "coupling": coupling, "rolling": {"method": "midpoint"}, "world": world})


def over_all_of_them() -> dict[str, NDArray[np.float64]]:
    """Poses: one finger presses on the box in the middle and goes along the row, turning; one pushes against its end,
    and then jumps back through it."""
    share = np.arange(400) / 400.0
    over, push = np.zeros((400, 7)), np.zeros((400, 7))
    over[:, 0], over[:, 2] = 0.06 * share, 2.0 * HALF + R - 0.003 * np.sin(np.pi * share)
    over[:, 3], over[:, 6] = np.cos(0.2 * share), np.sin(0.2 * share)
    push[:, 0], push[:, 2], push[:, 3] = -2.0 * APART - HALF - R - 0.002 + 0.012 * share, HALF, 1.0
    push[350:, 0] = 0.5 * APART
    return {"thumb": over, "index": push}


def test_in_rows_and_apart_the_same_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Forces of both fingers and where the bodies end, over contacts that move, turn and are handed over."""
    rows = engine(tmp_path)
    assert sum(isinstance(entry, Rows) for entry in rows.scene.objects) == 3
    monkeypatch.setattr(scenes, "ROWS_OF_WORLD_FROM", 100)
    apart = engine(tmp_path)
    assert not any(isinstance(entry, Rows) for entry in apart.scene.objects)
    ours, theirs = rows.run(over_all_of_them()), apart.run(over_all_of_them())
    for name, records in ours.items():
        np.testing.assert_array_equal(records, theirs[name])
        assert records["contact.normal_force"].max() > 1.0
    assert len({number for records in ours.values() for number in records["contact.object"].tolist()}) > 3
    np.testing.assert_array_equal(rows.data.qpos, apart.data.qpos)
    rows.reset()
    np.testing.assert_array_equal(rows.run(over_all_of_them())["thumb"], theirs["thumb"])
