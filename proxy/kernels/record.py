"""Writing the contact's part of a record: the layout of `softfinger.proxy.state`, compiled."""

from typing import Any

from softfinger.proxy.kernels.jit import jit
from softfinger.proxy.kernels.model import Contact, Quaternion, Vec3
from softfinger.proxy.state import OFFSET

DT = OFFSET["dt"]
TICK = OFFSET["tick"]
TIMESTAMP = OFFSET["timestamp"]
POSITION = OFFSET["probe.position"]
ORIENTATION = OFFSET["probe.orientation"]
VELOCITY = OFFSET["probe.velocity"]
PROXY = OFFSET["proxy.position"]
MODE = OFFSET["contact.mode"]
OBJECT = OFFSET["contact.object"]
PENETRATION = OFFSET["contact.penetration"]
POINT = OFFSET["contact.point"]
NORMAL = OFFSET["contact.normal"]
FINGER_POINT = OFFSET["contact.finger_point"]
ROLLED = OFFSET["contact.rolled"]
SPIN = OFFSET["contact.spin"]
FORCE = OFFSET["force"]
TORQUE = OFFSET["torque"]
CAUSE = OFFSET["contact.cause"]
NORMAL_FORCE = OFFSET["contact.normal_force"]
TANGENTIAL_FORCE = OFFSET["contact.tangential_force"]


@jit
def put3(row: Any, at: int, v: Vec3) -> None:
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
    """Fill a record (RECORD_SIZE,) with one tick; the servo's and the device's fields are left as they are."""
    row[TICK] = tick
    row[DT] = dt
    put3(row, POSITION, position)
    row[ORIENTATION] = orientation[0]
    row[ORIENTATION + 1] = orientation[1]
    row[ORIENTATION + 2] = orientation[2]
    row[ORIENTATION + 3] = orientation[3]
    put3(row, VELOCITY, contact.velocity)
    put3(row, PROXY, contact.center)
    row[MODE] = contact.mode
    row[OBJECT] = contact.object
    row[PENETRATION] = contact.penetration
    put3(row, POINT, contact.point)
    put3(row, NORMAL, contact.normal)
    put3(row, FINGER_POINT, contact.finger_point)
    row[ROLLED] = contact.rolled
    row[SPIN] = contact.spin
    put3(row, FORCE, force)
    put3(row, TORQUE, torque)
    row[CAUSE] = contact.cause
    row[NORMAL_FORCE] = contact.normal_force
    row[TANGENTIAL_FORCE] = contact.tangential_force
