"""Picture of a deformed elastic body: its vertices under the loads in the records of a tick.

The loads follow from `contact.point`, `contact.displacement` and `contacts[].force`. The compliance is the servo's.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from softfinger.config import schema
from softfinger.proxy.elastic.body import Body
from softfinger.proxy.elastic.solid import region_holds
from softfinger.proxy.kernels.numerics.rotations import rotate
from softfinger.proxy.record import AT, FREE, PATCHES

Doubles = NDArray[np.float64]


class Deformed:
    """Deformed vertices of a body.

    Parameters
    ----------
    thing
        Object with a solved `body`.
    vertices
        (n, 3) m, drawn vertices in the object frame, each at a vertex of the body.
    """

    def __init__(self, thing: schema.Mesh, body: Body, vertices: Doubles) -> None:
        assert thing.elastic is not None
        self._body, self._thing, self._vertices = body, thing, vertices
        self._softness: Final = 1.0 / thing.elastic.youngs_pa
        count = len(body.nodes)
        self._compliance: Final = body.compliance.array.reshape(count, count, 3, 3)
        self._numbers: Final = np.full(len(body.surface.vertices), -1)
        self._numbers[body.nodes] = np.arange(count)
        self._drawn, self._shares = self._followed(vertices)

    def at(self, rows: Iterable[Doubles]) -> Doubles:
        """Return the vertices (n, 3) m, object frame, under the contacts in a record (RECORD_SIZE,) of each finger."""
        moved = np.zeros((len(self._body.nodes), 3))
        for row in rows:
            if int(row[AT.contact_mode]) == FREE:
                continue
            point = row[AT.contact_point : AT.contact_point + 3] - row[AT.contact_displacement :][:3]
            width = AT.contacts1_object - AT.contacts0_object
            forces = [row[AT.contacts0_force + each * width :][:3] for each in range(PATCHES)]
            load = self._into(-np.sum(forces, axis=0))
            nodes, weights = self._spot(self._into(point - self._thing.position_m))
            for node, weight in zip(nodes, weights, strict=True):
                if node >= 0:
                    moved += self._softness * weight * (self._compliance[:, node] @ load)
        found: Doubles = self._vertices + self._shares[:, None] * moved[self._drawn]
        return found

    def _followed(self, vertices: Doubles) -> tuple[NDArray[np.int64], Doubles]:
        """Return the node that each of `vertices` (n, 3) follows, and its share of that node's displacement.

        A vertex outside of `reach` has no compliance. Its share grows from 0 at the fixed regions to 1 at the node.
        """
        assert self._thing.elastic is not None
        places = self._body.surface.vertices
        held = places[region_holds(self._thing.elastic.fixed, places)]
        nodes, shares = np.empty(len(vertices), np.int64), np.empty(len(vertices))
        for index, vertex in enumerate(vertices):
            distances = np.linalg.norm(places[self._body.nodes] - vertex, axis=1)
            nodes[index] = distances.argmin()
            far, near = np.linalg.norm(held - vertex, axis=1).min(initial=1e9), distances[nodes[index]]
            shares[index] = far / max(far + near, 1e-12)
        return nodes, shares

    def _into(self, vector: Doubles) -> Doubles:
        """Return a vector (3,) of the world frame in the object frame."""
        w, x, y, z = self._thing.orientation_wxyz
        a, b, c = vector.tolist()
        return np.array(rotate((w, -x, -y, -z), (a, b, c)))

    def _spot(self, point: Doubles) -> tuple[Doubles, Doubles]:
        """Return nodes (3,), -1 where they do not give, and weights of a point on the surface."""
        triangles = self._body.surface.triangles
        a, b, c = (self._body.surface.vertices[triangles[:, corner]] for corner in range(3))
        ab, ac = b - a, c - a
        up = np.cross(ab, ac)
        square = 1.0 / (up**2).sum(axis=1)
        of_b = np.clip(((point - a) * np.cross(ac, up)).sum(axis=1) * square, 0.0, 1.0)
        of_c = np.clip(((point - a) * np.cross(up, ab)).sum(axis=1) * square, 0.0, 1.0 - of_b)
        distance = ((a + of_b[:, None] * ab + of_c[:, None] * ac - point) ** 2).sum(axis=1)
        facet = int(distance.argmin())
        weights = np.array([1.0 - of_b[facet] - of_c[facet], of_b[facet], of_c[facet]])
        return self._numbers[triangles[facet]], weights
