"""Loads of the fingers on an elastic object, from the records of a tick; published as the topic `deformation`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import sqrt
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.config import schema
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.numerics.rotations import rotate
from softfinger.proxy.record import AT, FREE, PATCHES

Doubles = NDArray[np.float64]

CHANGE_N: Final = 1e-4
"""Smallest change of a force that is published: below 1 um on the softest shipped object."""
CHANGE_M: Final = 1e-6
"""Smallest change of a point that is published."""
_WIDTH: Final = AT.contacts1_object - AT.contacts0_object
"""Columns of a contact in a record."""


class ContactLoad(NamedTuple):
    """Load of a finger on an elastic object.

    finger        name, empty for a single one
    object        index of the object in the scene
    force         (3,) N  on the object, object frame
    point         (3,) m  centre of the loaded patch on the undeformed surface, object frame
    patch_radius  m       radius of the patch
    """

    finger: str
    object: int
    force: Vec3
    point: Vec3
    patch_radius: float


def compute_contact_loads(obj: schema.Mesh, rows: Mapping[str, Doubles]) -> list[ContactLoad]:
    """Return the loads on an elastic object, from the record (RECORD_SIZE,) of each finger in a tick."""
    assert obj.elastic is not None
    loads = []
    for finger, row in rows.items():
        if int(row[AT.contact_mode]) == FREE:
            continue
        point = _read_vector(row, AT.contacts0_point) - _read_vector(row, AT.contact_displacement) - obj.position_m
        force = -_sum_forces(row, obj.material.friction is not None)
        turned = _to_object_frame(obj, force), _to_object_frame(obj, point)
        loads.append(ContactLoad(finger, int(row[AT.contact_object]), *turned, obj.elastic.radius_m))
    return loads


def has_changed(before: Sequence[ContactLoad], now: Sequence[ContactLoad]) -> bool:
    """Return whether the loads differ by more than CHANGE_N or CHANGE_M, or are of other fingers or patches."""
    if [(load.finger, load.object, load.patch_radius) for load in before] != [
        (load.finger, load.object, load.patch_radius) for load in now
    ]:
        return True
    return any(
        np.abs(np.subtract(old.force, new.force)).max() > CHANGE_N
        or np.abs(np.subtract(old.point, new.point)).max() > CHANGE_M
        for old, new in zip(before, now, strict=True)
    )


def _sum_forces(row: Doubles, has_friction: bool) -> Doubles:
    """Return the force (3,) N of all contacts, world frame.

    Without friction, the recorded force of the first contact includes that of the slope of the deformed surface, which
    does not load the body. It is replaced by the force along the normal that gives the recorded normal force.
    """
    forces = np.array([_read_vector(row, AT.contacts0_force + contact * _WIDTH) for contact in range(PATCHES)])
    if has_friction:
        total: Doubles = forces.sum(axis=0)
        return total
    normal, tangential = _read_vector(row, AT.contacts0_normal), forces[1:].sum(axis=0)
    tangential = tangential - (tangential @ normal) * normal
    along = sqrt(max(float(row[AT.contact_normal_force]) ** 2 - float(tangential @ tangential), 0.0))
    force: Doubles = tangential + along * normal
    return force


def _read_vector(row: Doubles, at: int) -> Doubles:
    return row[at : at + 3]


def _to_object_frame(obj: schema.Mesh, vector: Doubles) -> Vec3:
    """Return a vector (3,) of the world frame in the object frame."""
    w, x, y, z = obj.orientation_wxyz
    a, b, c = vector.tolist()
    return rotate((w, -x, -y, -z), (a, b, c))
