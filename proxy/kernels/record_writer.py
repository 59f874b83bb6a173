"""Rows of poses, read for every finger, and records, written for every finger by the table `softfinger.proxy.record`.

With one finger, the operations on tuples of fingers compile to nothing.
"""

from typing import Any

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import map_each, pad
from softfinger.proxy.kernels.model import NO_OUTCOME, ZERO, Contact, ContactOutcome, Pose, Quaternion, Surface, Vec3
from softfinger.proxy.kernels.numerics.rotations import as_unit
from softfinger.proxy.record import AT


@jit
def write_vector(row: Any, at: int, v: Vec3) -> None:
    row[at] = v[0]
    row[at + 1] = v[1]
    row[at + 2] = v[2]


@jit
def write_contact(
    row: Any,
    tick: int,
    dt: float,
    position: Vec3,
    orientation: Quaternion,
    contact: Contact,
    force: Vec3,
    torque: Vec3,
) -> None:
    """Fill a record (RECORD_SIZE,) with one tick; the fields of servo and device do not change."""
    row[AT.tick] = tick
    row[AT.dt] = dt
    write_vector(row, AT.probe_position, position)
    row[AT.probe_orientation] = orientation[0]
    row[AT.probe_orientation + 1] = orientation[1]
    row[AT.probe_orientation + 2] = orientation[2]
    row[AT.probe_orientation + 3] = orientation[3]
    write_vector(row, AT.probe_velocity, contact.velocity)
    write_vector(row, AT.proxy_position, contact.center)
    row[AT.contact_mode] = contact.mode
    row[AT.contact_object] = contact.object
    row[AT.contact_penetration] = contact.penetration
    write_vector(row, AT.contact_point, contact.point)
    write_vector(row, AT.contact_normal, contact.normal)
    write_vector(row, AT.contact_finger_point, contact.finger_point)
    row[AT.contact_rolled] = contact.rolled
    row[AT.contact_spin] = contact.spin
    write_vector(row, AT.force, force)
    write_vector(row, AT.torque, torque)
    row[AT.contact_cause] = contact.cause
    row[AT.contact_normal_force] = contact.normal_force
    row[AT.contact_tangential_force] = contact.tangential_force
    row[AT.contact_torsion] = contact.torsion
    row[AT.contact_patch_radius] = contact.patch_radius
    write_vector(row, AT.contact_patch_normal, contact.patch_normal)
    write_vector(row, AT.contact_patch_stretch, contact.patch_stretch)
    row[AT.contact_budget] = contact.budget
    write_vector(row, AT.contact_displacement, ZERO)
    row[AT.contact_nonlinear] = 0.0
    one, two, three = pad(contact.contacts, NO_OUTCOME, 3)
    write_outcome(row, AT.contacts0_object, one)
    write_outcome(row, AT.contacts1_object, two)
    write_outcome(row, AT.contacts2_object, three)


@jit
def write_surfaces(surfaces: Any, rows: Any) -> None:
    """Fill the fields of an elastic surface in the records of all fingers, after `write_contact`."""
    if surfaces is not None:
        map_each(write_surface, (rows, surfaces))


@jit
def write_surface(row: Any, surface: Surface) -> None:
    write_vector(row, AT.contact_displacement, surface.world_displacement)
    row[AT.contact_nonlinear] = surface.nonlinear


@jit
def write_outcome(row: Any, at: int, outcome: ContactOutcome) -> None:
    """Write the fields of one contact, from column `at` on."""
    row[at] = outcome.object
    write_vector(row, at + AT.contacts0_point - AT.contacts0_object, outcome.point)
    write_vector(row, at + AT.contacts0_normal - AT.contacts0_object, outcome.normal)
    write_vector(row, at + AT.contacts0_force - AT.contacts0_object, outcome.force)
    row[at + AT.contacts0_mode - AT.contacts0_object] = outcome.mode
    row[at + AT.contacts0_spin - AT.contacts0_object] = outcome.spin


@jit
def unpack_pose(row: Any) -> Pose:
    """Return the Pose of a row x, y, z, qw, qx, qy, qz."""
    return Pose((row[0], row[1], row[2]), as_unit((row[3], row[4], row[5], row[6])))


@jit
def unpack_poses(rows: Any) -> Any:
    """Return the Pose of each row of a tuple."""
    return map_each(unpack_pose, (rows,))


@jit
def write_timed_contact(contact: Any, row: Any, probe: Pose, tick: int, dt: float) -> None:
    """Fill a record with tick number `tick`; its timestamp is that number times dt (s)."""
    row[AT.timestamp] = tick * dt
    write_contact(row, tick, dt, probe.position, probe.orientation, contact, contact.force, contact.torque)
