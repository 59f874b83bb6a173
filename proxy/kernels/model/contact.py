"""What a contact remembers, what passes through a tick, and what comes out of it."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.model.motions import Pose
from softfinger.proxy.kernels.model.vectors import Quaternion, Vec3


class State(NamedTuple):
    """What a contact remembers from one tick to the next.

    started          0 before the first pose, then 1
    time             s, the sum of all time steps
    position, orientation, velocity    of the probe at the last tick
    mode             FREE, ROLLING or SLIDING
    first, second, third    places in the scene's tuple of the objects that hold the proxy, -1 for none
    object           pose of the first of them at the last tick
    center, normal   c and n: the proxy and the outward unit normal under it
    deflection       e: tangential part of c minus the probe position
    rolled_part      p: the share of e that rolling has wound
    spin             phi: torsional wind-up, rad
    slip_speed       low-passed plastic slip, m/s
    slip_deflection  |e| at the last tick that slipped, m
    spin_slip_speed  low-passed slip of the torsional anchor, rad/s; 0 while it sticks (soft-finger proxy only)
    spin_slip_angle  |phi| at the last tick whose anchor slipped, rad (soft-finger proxy only)
    rolled           roll angle since touch, rad
    effects          states of the effects of the workspace and of every object
    """

    started: float
    time: float
    position: Vec3
    orientation: Quaternion
    velocity: Vec3
    mode: float
    first: float
    second: float
    third: float
    object: Pose
    center: Vec3
    normal: Vec3
    deflection: Vec3
    rolled_part: Vec3
    spin: float
    slip_speed: float
    slip_deflection: float
    spin_slip_speed: float
    spin_slip_angle: float
    rolled: float
    effects: Any


class Tick(NamedTuple):
    """What a contact brings to friction and torsion in a tick: see `State` for the names.

    deflection         e after this tick's motion and roll; with deflection_before and rolled_part in the
                       tangent plane of `normal`
    spin, twist        phi before this tick, and this tick's rotation about `normal`, rad
    """

    radius: float
    resolution: float
    dt: float
    mode: float
    normal: Vec3
    deflection: Vec3
    deflection_before: Vec3
    rolled_part: Vec3
    slip_speed: float
    slip_deflection: float
    spin: float
    twist: float
    spin_slip_speed: float
    spin_slip_angle: float
    normal_force: float


class Hold(NamedTuple):
    """What friction and torsion make of a tick: the new mode and why, what is kept, and the reaction on the hand.

    force   (3,) N    tangential force
    moment  N m       about the normal
    """

    mode: float
    cause: float
    deflection: Vec3
    rolled_part: Vec3
    slip_speed: float
    slip_deflection: float
    spin: float
    spin_slip_speed: float
    spin_slip_angle: float
    force: Vec3
    moment: float


class Contact(NamedTuple):
    """The outcome of one step.

    force, torque    on the hand, world frame, torque about the fingertip centre
    finger_point     contact point in the fingertip frame
    cause            of the mode change in this tick, CAUSE_NONE if it did not change
    """

    mode: float
    object: float
    cause: float
    velocity: Vec3
    center: Vec3
    penetration: float
    point: Vec3
    normal: Vec3
    finger_point: Vec3
    rolled: float
    spin: float
    normal_force: float
    tangential_force: float
    force: Vec3
    torque: Vec3
