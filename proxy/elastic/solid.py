"""Linear elastostatics of a volume mesh: quadratic tetrahedra of scikit-fem, and one sparse factorisation.

    K u = f,    u = 0 at the fixed nodes

K is that of Young's modulus 1 Pa: displacements are inversely proportional to it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from softfinger.config import schema
from softfinger.proxy.elastic.triangular import substitute_down, substitute_up
from softfinger.proxy.elastic.volume import Volume
from softfinger.proxy.kernels.jit.decorators import PLAIN

Doubles = NDArray[np.float64]

BLOCK: Final = 96
"""Right-hand sides of one substitution, so that a row of them stays in the first cache."""
LEAST_FIXED: Final = 3


class Solid:
    """Body of Young's modulus 1 Pa, fixed in regions.

    Parameters
    ----------
    volume
        Tetrahedra.
    poisson
        Poisson's ratio, below 0.5.
    held
        Function from positions (n, 3) m to the components (n, 3) that are fixed there, as booleans.

    Raises
    ------
    ValueError
        If scikit-fem or SciPy is not installed, or fewer than three nodes are fixed.
    """

    def __init__(self, volume: Volume, poisson: float, held: Callable[[Doubles], NDArray[np.bool_]]) -> None:
        try:
            import skfem
            from scipy.sparse.linalg import splu
            from skfem.models.elasticity import lame_parameters, linear_elasticity
        except ImportError as missing:
            raise ValueError(f"{missing.name} is not installed: pip install 'softfinger[elastic]'") from missing
        self.volume: Final = volume
        mesh = skfem.MeshTet(np.ascontiguousarray(volume.vertices.T), np.ascontiguousarray(volume.tetrahedra.T))
        # MeshTet may order the vertices of a tetrahedron, but not the vertices themselves.
        self.basis: Final[Any] = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementTetP2()), intorder=2)
        self._skfem: Final[Any] = skfem
        stiffness = linear_elasticity(*lame_parameters(1.0, poisson)).assemble(self.basis)
        places = self.basis.doflocs.T
        component = np.empty(self.basis.N, np.int64)
        for of in (self.basis.nodal_dofs, self.basis.edge_dofs):
            component[of] = np.arange(3)[:, None]
        fixed = held(places)[np.arange(self.basis.N), component]
        if (fixed & (component == 0)).sum() < LEAST_FIXED:
            raise ValueError(
                f"fixed: the regions contain {int((fixed & (component == 0)).sum())} nodes, at least 3 are needed"
            )
        self.free: Final = np.flatnonzero(~fixed)
        matrix = stiffness[self.free][:, self.free].tocsc()
        self.matrix: Final = matrix
        factors = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        # K is symmetric and positive definite, so its pivots are on the diagonal: K = L D L^T.
        self._factors: Final[Any] = factors if PLAIN else None
        lower = factors.L.tocsc()
        lower.sort_indices()
        self._lower: Final = (lower.indptr, lower.indices, lower.data)
        self._diagonal: Final = factors.U.diagonal()
        self._order: Final = factors.perm_c
        self._rows: Final = np.argsort(factors.perm_c)
        self.eliminated: Final = np.full(self.basis.N, self.basis.N)
        """Place of each unknown in the order of elimination."""
        self.eliminated[self.free[self._rows]] = np.arange(len(self.free))

    def solve(self, loads: Doubles) -> Doubles:
        """Return the displacements (N, k) times 1 Pa under nodal forces (N, k), N."""
        found = np.zeros(loads.shape)
        if PLAIN:
            found[self.free] = self._factors.solve(np.ascontiguousarray(loads[self.free]))
            return found
        for start in range(0, loads.shape[1], BLOCK):
            block = np.ascontiguousarray(loads[self.free, start : start + BLOCK][self._rows])
            substitute_down(*self._lower, block)
            substitute_up(*self._lower, self._diagonal, block)
            found[self.free, start : start + BLOCK] = block[self._order]
        return found

    def gravity(self, direction: Sequence[float]) -> Doubles:
        """Return the nodal forces (N,) of a body force of `direction` (3,) N/m^3."""
        skfem = self._skfem

        @skfem.LinearForm  # type: ignore[untyped-decorator]
        def weight(v: Any, w: Any) -> Any:
            return sum(component * v[axis] for axis, component in enumerate(direction))

        found: Doubles = weight.assemble(self.basis)
        return found

    def surface(self, order: int = 4) -> Any:
        """Return scikit-fem's basis of the boundary, with a quadrature of this order."""
        skfem = self._skfem
        return skfem.FacetBasis(self.basis.mesh, self.basis.elem, intorder=order)

    def traction(self, pressure: Callable[[Doubles], Doubles], direction: Sequence[float]) -> Doubles:
        """Return the nodal forces (N,) of a traction `pressure`, N/m^2, at positions (3, ...) along `direction`."""
        skfem = self._skfem

        @skfem.LinearForm  # type: ignore[untyped-decorator]
        def work(v: Any, w: Any) -> Any:
            return pressure(w.x) * sum(component * v[axis] for axis, component in enumerate(direction))

        found: Doubles = work.assemble(self.surface(8))
        return found


def region_holds(regions: Sequence[schema.FixedRegion], points: Doubles) -> NDArray[np.bool_]:
    """Return whether each of `points` (n, 3) m is in one of the regions."""
    found = np.zeros(len(points), bool)
    for region in regions:
        if isinstance(region, schema.Below):
            found |= points[:, 2] <= region.z_m
        elif isinstance(region, schema.InBox):
            found |= ((points >= region.low_m) & (points <= region.high_m)).all(axis=1)
        else:
            found |= (points - region.point_m) @ np.asarray(region.normal) <= 0.0
    return found
