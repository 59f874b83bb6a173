"""Elastic surface of a scene's mesh, in the form that the kernels take."""

from __future__ import annotations

from typing import Final

import numpy as np

import softfinger.proxy.kernels.elastic.step  # noqa: F401  registers its step
from softfinger.config import schema
from softfinger.proxy.elastic.prepared import body_of
from softfinger.proxy.kernels import model
from softfinger.proxy.kernels.jit.arrays import ReadOnly

LARGE: Final = 0.1
"""Displacement over the diagonal of the body from which `contact.nonlinear` is set."""


def kernel_elastic(thing: schema.Mesh, elastic: schema.Elastic, mesh: model.Triangles) -> model.Elastic:
    """Return the compliance at the vertices of an object's mesh. Raises ConfigError as `body_of` does."""
    body = body_of(thing)
    numbers = np.full(len(body.surface.vertices), -1, np.int64)
    numbers[body.nodes] = np.arange(len(body.nodes))
    place = {each.tobytes(): number for each, number in zip(body.surface.vertices, numbers, strict=True)}
    nodes = [place[each.tobytes()] for each in mesh.vertices.array.reshape(-1, 3)]  # a copy of these, in another order
    return model.Elastic(
        compliance=body.compliance,
        nodes=ReadOnly(np.array(nodes, np.int64)),
        number=float(len(body.nodes)),
        softness=1.0 / elastic.youngs_pa,
        damping=elastic.damping_s,
        bending=body.bending,
        large=LARGE * float(np.linalg.norm(np.ptp(body.surface.vertices, axis=0))),
    )
