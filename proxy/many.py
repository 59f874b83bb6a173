"""Construction of `Many`: the objects of a scene with several objects, or with simulated bodies, as arrays."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from softfinger.config.errors import ConfigError
from softfinger.proxy.kernels import model
from softfinger.proxy.kernels.contact import rolling as _rolling  # noqa: F401  # registers kernels of shapes
from softfinger.proxy.kernels.contact.rest import one_object as _one_object  # noqa: F401
from softfinger.proxy.kernels.jit.arrays import ReadOnly
from softfinger.proxy.kernels.jit.rows import Rows
from softfinger.proxy.kernels.query.container import MAX_ENTRIES
from softfinger.proxy.kernels.shapes import kernel_table as kinds
from softfinger.proxy.kernels.shapes.any_shape import make_any_shape

NO_VALUES: Final = ReadOnly(np.zeros(1))


def make_many(
    objects: list[model.Object], effects: tuple[model.Carrier, ...], fingers: tuple[model.Finger, ...], rolling: Any
) -> model.Many:
    """Return the objects as arrays; `effects` are the carriers of effects.

    Raises ConfigError for more than MAX_ENTRIES objects.
    """
    if len(objects) > MAX_ENTRIES:
        raise ConfigError(f"{len(objects)} walls and objects: at most {MAX_ENTRIES} are possible; remove some")
    needs = _list_needed_kernels(objects, fingers, rolling)
    entries = [_make_entry(obj, needs) for obj in objects]
    movable_rows = [row for row, obj in enumerate(entries) if obj.motion.kind != model.STILL]
    return model.Many(
        entries=Rows(entries),
        size=float(len(entries)),
        movable_rows=ReadOnly(np.array(movable_rows or [0], np.int64)),
        movable_count=float(len(movable_rows)),
        search=search_for(objects),
        materials=Rows([obj.material._replace(normal=None) for obj in objects]),
        textures=_make_textures([obj.texture for obj in objects]),
        effects=effects,
    )


def search_for(objects: list[model.Object]) -> model.SmoothSearch | model.FacetedSearch | model.CreasedSearch:
    """Return the type of the search, and the number of meshes."""
    meshes = float(sum(isinstance(obj.shape, model.Mesh) for obj in objects))
    if any(isinstance(obj.shape, model.Heightmap) for obj in objects):
        return model.CreasedSearch(meshes)
    return model.FacetedSearch(meshes) if meshes else model.SmoothSearch(meshes)


def _list_needed_kernels(
    objects: list[model.Object], fingers: tuple[model.Finger, ...], rolling: Any
) -> frozenset[int]:
    """Return the kernels of shapes that only some scenes call."""
    return frozenset(
        kernel
        for kernel, is_needed in (
            (kinds.UNROLL, isinstance(rolling, model.RotationVector)),
            (kinds.AHEAD, isinstance(rolling, model.EulerZxz | model.EulerZyx)),
            (kinds.CHART, any(obj.texture is not None for obj in objects)),
            (kinds.MINKOWSKI, any(finger.form is not None for finger in fingers)),
        )
        if is_needed
    )


def _make_entry(obj: model.Object, needs: frozenset[int]) -> model.Entry:
    shape = make_any_shape(obj.shape, obj.pose, needs)
    return model.Entry(shape, _make_pose(obj.pose), obj.motion or model.NO_MOTION, obj.material.normal, obj.scene_index)


def _make_pose(pose: Any) -> model.Pose:
    match pose:
        case None:
            return model.Pose(model.ZERO, (1.0, 0.0, 0.0, 0.0))
        case model.Place(position):
            return model.Pose(position, (1.0, 0.0, 0.0, 0.0))
    return model.Pose(*pose)


def _make_textures(textures: list[model.Texture | None]) -> Rows | None:
    """Return a texture for each object, all with the same parts; a missing texture has 0 columns."""
    present = [texture for texture in textures if texture is not None]
    if not present:
        return None
    relief = model.Relief(0.0) if any(texture.relief is not None for texture in present) else None
    grip = model.Grip(1.0, 1.0) if any(texture.grip is not None for texture in present) else None
    none = model.Texture(NO_VALUES, 0.0, 1.0, 1.0, 1.0, 0.0, 0.0, 1.0, relief, grip)
    return Rows([
        none if texture is None else texture._replace(relief=texture.relief or relief, grip=texture.grip or grip)
        for texture in textures
    ])  # fmt: skip
