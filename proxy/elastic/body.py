"""Solved elastic body: its surface, the compliance of the surface, and the figures that `softfinger check` prints."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.kernels.jit.arrays import ReadOnly
from softfinger.proxy.meshes.reading import Arrays


class Report(NamedTuple):
    """Figures of a body, of Young's modulus 1 Pa.

    points       (k, 3) m  of the surface, spread over it
    compliances  (k,)      displacement there along the normal under 1 N, m/N times 1 Pa
    error        1         their largest error, estimated with a coarser mesh, over their largest value; None without
                           such a mesh
    """

    vertices: int
    tetrahedra: int
    nodes: int
    worst_quality: float
    mean_quality: float
    points: list[list[float]]
    compliances: list[float]
    error: float | None


class Body(NamedTuple):
    """Surface (vertices, m, and triangles), its compliant vertices, their compliance, and figures.

    nodes       (n,)       indices of the compliant vertices
    compliance  (n n 9,)   see `compliance.Solution`
    bending     (n 3 2,)   see `compliance.Solution`
    """

    surface: Arrays
    nodes: NDArray[np.int32]
    compliance: ReadOnly
    bending: ReadOnly
    report: Report
