"""Operations on several fingers in turn: rows, poses and records as tuples. With one finger they compile to nothing."""

from typing import Any

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.dispatch import by_count
from softfinger.proxy.kernels.model import Pose
from softfinger.proxy.kernels.numerics.rotations import as_unit
from softfinger.proxy.kernels.record_writer import write_contact
from softfinger.proxy.record import AT


@by_count
def rows_of(fingers: Any, table: Any, first: int) -> Any:
    """Return rows of `table` from index `first` on, one for each finger, as a tuple."""


@rows_of.of(1)
def row_of_one(fingers: Any, table: Any, first: int) -> Any:
    return (table[first],)


@rows_of.of(2)
def rows_of_several(fingers: Any, table: Any, first: int) -> Any:
    # numba concatenates tuples of known types, but does not support unpacking in a tuple.
    return (table[first],) + rows_of(fingers[1:], table, first + 1)  # noqa: RUF005


@jit
def pose_in(row: Any) -> Pose:
    """Return the Pose of a row x, y, z, qw, qx, qy, qz."""
    return Pose((row[0], row[1], row[2]), as_unit((row[3], row[4], row[5], row[6])))


@by_count
def poses_in(rows: Any) -> Any:
    """Return the Pose of each row of a tuple."""


@poses_in.of(1)
def pose_of_one(rows: Any) -> Any:
    return (pose_in(rows[0]),)


@poses_in.of(2)
def poses_of_several(rows: Any) -> Any:
    return (pose_in(rows[0]),) + poses_in(rows[1:])  # noqa: RUF005  # see above


@by_count
def write_contacts(contacts: Any, rows: Any, probes: Any, tick: int, dt: float) -> None:
    """Fill a record for each finger for tick number `tick`; its timestamp is that number times dt (s)."""


@write_contacts.of(1)
def write_one_contact(contacts: Any, rows: Any, probes: Any, tick: int, dt: float) -> None:
    contact, row = contacts[0], rows[0]
    row[AT.timestamp] = tick * dt
    write_contact(row, tick, dt, probes[0].position, probes[0].orientation, contact, contact.force, contact.torque)


@write_contacts.of(2)
def write_several_contacts(contacts: Any, rows: Any, probes: Any, tick: int, dt: float) -> None:
    write_contacts(contacts[:1], rows[:1], probes[:1], tick, dt)
    write_contacts(contacts[1:], rows[1:], probes[1:], tick, dt)
