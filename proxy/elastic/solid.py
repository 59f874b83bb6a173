"""Linear elastostatics of a volume mesh: quadratic tetrahedra of scikit-fem, and one sparse factorisation.

    K u = f,    u = 0 at the fixed nodes

K is that of Young's modulus 1 Pa: displacements are inversely proportional to it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from softfinger.config import schema
from softfinger.proxy.elastic.factors import Factors
from softfinger.proxy.elastic.volume import Volume

Doubles = NDArray[np.float64]

MIN_FIXED_NODES: Final = 3
ASSEMBLY_BLOCK: Final = 1024
"""Tetrahedra that are assembled together."""


class Solid:
    """Body of Young's modulus 1 Pa, fixed in regions.

    Parameters
    ----------
    volume
        Tetrahedra.
    poisson
        Poisson's ratio, below 0.5.
    is_fixed
        Function from positions (n, 3) m to the components (n, 3) that are fixed there, as booleans.

    Raises
    ------
    ValueError
        If scikit-fem or SciPy is not installed, or fewer than three nodes are fixed.
    """

    def __init__(self, volume: Volume, poisson: float, is_fixed: Callable[[Doubles], NDArray[np.bool_]]) -> None:
        try:
            import skfem
            from skfem.models.elasticity import lame_parameters, linear_elasticity
        except ImportError as missing:
            raise ValueError(f"{missing.name} is not installed: pip install 'softfinger[elastic]'") from missing
        logging.getLogger("skfem").setLevel(logging.WARNING)  # it reports each of its steps
        self.volume: Final = volume
        mesh = skfem.MeshTet(np.ascontiguousarray(volume.vertices.T), np.ascontiguousarray(volume.tetrahedra.T))
        # MeshTet may order the vertices of a tetrahedron, but not the vertices themselves.
        # Of one tetrahedron, since all would have 1 kB of quadrature for each unknown.
        self.basis: Final[Any] = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementTetP2()), intorder=2, elements=[0])
        self._skfem: Final[Any] = skfem
        places = self.basis.doflocs.T
        component = np.empty(self.basis.N, np.int64)
        for of in (self.basis.nodal_dofs, self.basis.edge_dofs):
            component[of] = np.arange(3)[:, None]
        fixed = is_fixed(places)[np.arange(self.basis.N), component]
        if (fixed & (component == 0)).sum() < MIN_FIXED_NODES:
            raise ValueError(
                f"fixed: the regions contain {int((fixed & (component == 0)).sum())} nodes, at least 3 are needed"
            )
        self.free: Final = np.flatnonzero(~fixed)
        stiffness = self._assemble(linear_elasticity(*lame_parameters(1.0, poisson)))
        stiffness = stiffness[self.free]  # in two steps, so that at most two copies are in memory
        stiffness = stiffness[:, self.free]
        self.factors: Final = Factors(stiffness, places[self.free])
        """Factors of the matrix of the free unknowns, in their order."""

    def solve(self, loads: Doubles) -> Doubles:
        """Return the displacements (N, k) times 1 Pa under nodal forces (N, k), N."""
        displacements = np.zeros(loads.shape)
        free = loads[self.free]
        self.factors.solve(free)
        displacements[self.free] = free
        return displacements

    def _assemble(self, form: Any) -> Any:
        """Return a form over all tetrahedra."""
        count = len(self.volume.tetrahedra)
        parts = (np.arange(first, min(first + ASSEMBLY_BLOCK, count)) for first in range(0, count, ASSEMBLY_BLOCK))
        return sum(form.assemble(self.basis.with_elements(part)) for part in parts)

    def gravity(self, direction: Sequence[float]) -> Doubles:
        """Return the nodal forces (N,) of a body force of `direction` (3,) N/m^3."""
        skfem = self._skfem

        @skfem.LinearForm  # type: ignore[untyped-decorator]
        def weight(v: Any, w: Any) -> Any:
            return sum(component * v[axis] for axis, component in enumerate(direction))

        forces: Doubles = self._assemble(weight)
        return forces


def is_in_region(regions: Sequence[schema.FixedRegion], points: Doubles) -> NDArray[np.bool_]:
    """Return whether each of `points` (n, 3) m is in one of the regions."""
    inside = np.zeros(len(points), bool)
    for region in regions:
        if isinstance(region, schema.Below):
            inside |= points[:, 2] <= region.z_m
        elif isinstance(region, schema.InBox):
            inside |= ((points >= region.low_m) & (points <= region.high_m)).all(axis=1)
        else:
            inside |= (points - region.point_m) @ np.asarray(region.normal) <= 0.0
    return inside
