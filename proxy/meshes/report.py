"""Report on a mesh: its properties, the repairs, and the remaining faults."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from softfinger.proxy.meshes.mending import MERGE_DISTANCE_SHARE, RepairedMesh

USUAL_SIZE_M: Final = (1e-3, 1.0)
"""Sizes of things that a hand explores; others may come from a file in another unit."""


@dataclass(frozen=True)
class MeshReport:
    """Properties of a mesh as it is rendered: counts, m, m^3.

    size_m      extent along its axes, scaled
    watertight  each edge has two triangles, consistent about which side is outside
    volume_m3   None if the mesh is not watertight
    bodies      pieces connected over edges of two triangles
    """

    triangles: int
    vertices: int
    size_m: tuple[float, float, float]
    watertight: bool
    volume_m3: float | None
    bodies: int
    open_edges: int
    non_manifold_edges: int
    merged_vertices: int
    unused_vertices: int
    degenerate_triangles: int
    duplicate_triangles: int
    turned_triangles: int
    mended: tuple[str, ...]
    noted: tuple[str, ...]

    def rows(self, inside: bool = False) -> list[tuple[str, str]]:
        """Return label and text of each property; `inside`: the object is touched from inside."""
        size = " x ".join(f"{edge:.4g}" for edge in self.size_m)
        bodies = "" if self.bodies == 1 else f", {self.bodies:,} bodies"
        table = [("triangles", f"{self.triangles:,} on {self.vertices:,} vertices{bodies}"), ("size", f"{size} m")]
        table.append(("surface", self._describe_surface()))
        table.append(("mended", "; ".join(self.mended) or "nothing"))
        table.append(("noted", "; ".join(self.noted)))
        if inside and not self.watertight:
            table.append(("inside", self._explain_no_inside()))
        return table

    def _explain_no_inside(self) -> str:
        why, remedy = "it is not watertight", "correct the faults in the notes"
        if self.open_edges:
            why, remedy = f"it has {self.open_edges:,} open edges", "close its holes"
        return f"inside = true has no effect: {why}, so the side on which the hand starts is touched: {remedy}"

    def _describe_surface(self) -> str:
        if self.watertight:
            return f"watertight, {self.volume_m3:.4g} m^3"
        if self.open_edges:
            return f"open, {self.open_edges:,} edges of one triangle: touched from both sides, as a sheet"
        return "closed, but not watertight: see the notes"


def ask_about_unit(size: float, scale: float | None) -> tuple[str, ...]:
    """Return a question about the unit of a mesh that no hand surrounds, or none can feel.

    size   m, scaled
    scale  of the object; None for a mesh of a MuJoCo model, scaled by its <mesh>
    """
    if USUAL_SIZE_M[0] <= size <= USUAL_SIZE_M[1]:
        return ()
    if size > USUAL_SIZE_M[1]:
        units = (
            [("millimetres", 1e-3), ("centimetres", 1e-2)] if scale in (1.0, None) else [("a thousandth of it", 1e-3)]
        )
    else:
        units = [("a thousand times larger", 1e3)]
    if scale is None:
        advice = "multiply the scale of its <mesh> by "
        advice += ", or ".join(f"{factor:g} ({unit}, {size * factor:.3g} m)" for unit, factor in units)
    else:
        advice = "give "
        advice += ", or ".join(f"scale = {scale * factor:g} ({unit}, {size * factor:.3g} m)" for unit, factor in units)
    return (f"it is {size:.3g} m in size: if that is not intended, {advice}",)


def make_report(mended: RepairedMesh, loose: bool, scale: float | None) -> MeshReport:
    """Return the report on a mesh that `mend` gave; `scale` as for `ask_about_unit`."""
    winding, (vertices, triangles) = mended.winding, mended.arrays
    x, y, z = (float(edge) for edge in np.ptp(vertices, axis=0))
    tolerance = f" within {MERGE_DISTANCE_SHARE:g} of its size" if loose else ""
    repairs = [
        (mended.merged, f"vertices merged that coincide{tolerance}"),
        (mended.unused, "unused vertices removed"),
        (mended.degenerate, "triangles without area removed"),
        (mended.duplicate, "duplicate triangles removed"),
        (winding.alike, "triangles flipped because they were wound opposite to their neighbours"),
        (winding.outward, "triangles flipped because their body was wound inward"),
    ]
    faults = [
        (mended.open_edges, "edges of one triangle, at holes or the border of a sheet"),
        (mended.crowded_edges, "edges of more than two triangles"),
        (winding.one_sided, "bodies with a single side, such as a Moebius strip, which have no consistent winding"),
        (winding.hollows, "bodies wound inward within another, treated as walls of hollows"),
    ]
    return MeshReport(
        triangles=len(triangles),
        vertices=len(vertices),
        size_m=(x, y, z),
        watertight=mended.watertight,
        volume_m3=winding.volume if mended.watertight else None,
        bodies=winding.bodies,
        open_edges=mended.open_edges,
        non_manifold_edges=mended.crowded_edges,
        merged_vertices=mended.merged,
        unused_vertices=mended.unused,
        degenerate_triangles=mended.degenerate,
        duplicate_triangles=mended.duplicate,
        turned_triangles=winding.alike + winding.outward,
        mended=tuple(f"{text}: {count:,}" for count, text in repairs if count),
        noted=(
            *ask_about_unit(max(x, y, z), scale),
            *(f"{text}: {count:,}" for count, text in faults if count),
            "not checked: triangles that intersect each other",
        ),
    )
