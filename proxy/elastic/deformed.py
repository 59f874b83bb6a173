"""Deformed elastic body: its vertices under the loads of a message of the topic `deformation`.

The compliance is the servo's, from the file `solution` or the cache.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from softfinger.config import schema
from softfinger.config.errors import ConfigError
from softfinger.config.load import SceneSource, load_scene
from softfinger.proxy.elastic.prepared import prepare_body
from softfinger.proxy.elastic.solid import is_in_region
from softfinger.proxy.elastic.solution import ElasticBody

Doubles = NDArray[np.float64]


class Load(Protocol):
    """Load on an elastic object, as `ContactLoad` or in a decoded message."""

    @property
    def force(self) -> tuple[float, float, float]:
        """Force (3,) N on the object, object frame."""

    @property
    def point(self) -> tuple[float, float, float]:
        """Centre (3,) m of the loaded patch on the undeformed surface, object frame."""


class Deformed:
    """Vertices of an elastic body under loads.

    Parameters
    ----------
    obj
        Object of the scene.
    body
        Its solution.
    vertices
        (n, 3) m, vertices to displace, object frame; None for the vertices of the body's surface.

    Attributes
    ----------
    vertices
        (n, 3) m, undeformed vertices, object frame.
    triangles
        (m, 3), indices of the vertices of the body's surface.
    """

    def __init__(self, obj: schema.Mesh, body: ElasticBody, vertices: Doubles | None = None) -> None:
        assert obj.elastic is not None
        self._body, self._object = body, obj
        self.vertices: Final = body.surface.vertices if vertices is None else vertices
        self.triangles: Final = body.surface.triangles
        self._softness: Final = 1.0 / obj.elastic.youngs_pa
        count = len(body.nodes)
        self._compliance: Final = body.compliance.array.reshape(count, count, 3, 3)
        self._numbers: Final = np.full(len(body.surface.vertices), -1)
        self._numbers[body.nodes] = np.arange(count)
        self._drawn, self._shares = self._find_followed_nodes(self.vertices)

    @classmethod
    def of_scene(cls, scene: SceneSource) -> Self:
        """Return the surface of the elastic object of a scene, which is solved if it was not before.

        Parameters
        ----------
        scene
            Name, file, or mapping, such as the `scene` that `describe` returns.

        Raises
        ------
        ConfigError
            If the scene has no elastic object, or it cannot be solved.
        """
        obj = load_scene(scene).elastic_object
        if obj is None:
            raise ConfigError("the scene has no object with [object.elastic]")
        return cls(obj, prepare_body(obj))

    def at(self, loads: Iterable[Load]) -> Doubles:
        """Return the displaced vertices (n, 3) m, object frame."""
        moved = np.zeros((len(self._body.nodes), 3))
        for load in loads:
            nodes, weights = self._find_spot(np.asarray(load.point))
            for node, weight in zip(nodes, weights, strict=True):
                if node >= 0:
                    moved += self._softness * weight * (self._compliance[:, node] @ np.asarray(load.force))
        displaced: Doubles = self.vertices + self._shares[:, None] * moved[self._drawn]
        return displaced

    def _find_followed_nodes(self, vertices: Doubles) -> tuple[NDArray[np.int64], Doubles]:
        """Return the node that each of `vertices` (n, 3) follows, and its share of that node's displacement.

        A vertex outside of `reach` has no compliance. Its share grows from 0 at the fixed regions to 1 at the node.
        """
        assert self._object.elastic is not None
        places = self._body.surface.vertices
        fixed = places[is_in_region(self._object.elastic.fixed, places)]
        nodes, shares = np.empty(len(vertices), np.int64), np.empty(len(vertices))
        for index, vertex in enumerate(vertices):
            distances = np.linalg.norm(places[self._body.nodes] - vertex, axis=1)
            nodes[index] = distances.argmin()
            far, near = np.linalg.norm(fixed - vertex, axis=1).min(initial=1e9), distances[nodes[index]]
            shares[index] = far / max(far + near, 1e-12)
        return nodes, shares

    def _find_spot(self, point: Doubles) -> tuple[Doubles, Doubles]:
        """Return nodes (3,), -1 at rigid vertices, and weights of a point on the surface."""
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
