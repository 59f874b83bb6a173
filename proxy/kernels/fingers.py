"""Operations on several fingers in turn: rows, poses and records as tuples. With one finger they compile to nothing."""

from typing import Any

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import map_each
from softfinger.proxy.kernels.model import Pose
from softfinger.proxy.kernels.numerics.rotations import as_unit
from softfinger.proxy.kernels.record_writer import write_contact
from softfinger.proxy.record import AT


@jit
def pose_in(row: Any) -> Pose:
    """Return the Pose of a row x, y, z, qw, qx, qy, qz."""
    return Pose((row[0], row[1], row[2]), as_unit((row[3], row[4], row[5], row[6])))


@jit
def poses_in(rows: Any) -> Any:
    """Return the Pose of each row of a tuple."""
    return map_each(pose_in, (rows,))


@jit
def write_contacts(contacts: Any, rows: Any, probes: Any, tick: int, dt: float) -> None:
    """Fill a record for each finger for tick number `tick`; its timestamp is that number times dt (s)."""
    map_each(write_one_contact, (contacts, rows, probes), tick, dt)


@jit
def write_one_contact(contact: Any, row: Any, probe: Pose, tick: int, dt: float) -> None:
    row[AT.timestamp] = tick * dt
    write_contact(row, tick, dt, probe.position, probe.orientation, contact, contact.force, contact.torque)
