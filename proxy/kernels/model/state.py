"""What the world and each finger's contact remember, what passes through a tick, and what comes out of it."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.model.vectors import Quaternion, Vec3


class World(NamedTuple):
    """What is there whoever touches it: the time, and where the bodies are.

    started  0 before the first tick, then 1
    time     s, the sum of all time steps
    poses    Pose of the only object now, None if it cannot move; of many objects memory of their poses (`query.world`)
    was      Pose of the only object at the last tick; None for many
    """

    started: float
    time: float
    poses: Any
    was: Any


class Probe(NamedTuple):
    """A fingertip's pose in a tick, fingertip to world, and its filtered velocity, m/s."""

    position: Vec3
    orientation: Quaternion
    velocity: Vec3


NONE = -1.0
"""The place of an object that is not there."""


class Constraint(NamedTuple):
    """A tangent plane of an object, a fingertip's radius away, in front of which the proxy is held.

    body    place of the object in the scene's tuple, -1 for none
    normal  (3,) 1
    depth   m, how far the probe lies behind the proxy along the normal: the normals, weighted by it, lead to the proxy
    """

    body: float
    normal: Vec3
    depth: float


ActiveSet = tuple[Constraint, Constraint, Constraint]
"""The constraints that hold the proxy, those of no object last; the first is of the object that is rolled on. While its
rest is searched a height map may have several of them, one for each foot."""


class ContactState(NamedTuple):
    """What one contact remembers from one tick to the next.

    body             place in the scene's tuple of the object that it is on, -1 for no contact
    normal           n: outward unit normal under it
    push             m, how far the object keeps the proxy from the probe along n
    share            of the load, 0 to 1: the contact has this share of the coupling and of the torsional spring
    mode             FREE, ROLLING or SLIDING
    deflection       e: tangential, from the probe to where the contact sticks
    rolled_part      p: the share of e that rolling has wound
    spin             phi: torsional wind-up, rad; under a contact patch in the unit of `contact_patch.winding_unit`
    slip_speed       low-passed plastic slip, m/s
    slip_deflection  |e| at the last tick that slipped, m
    spin_slip_speed  low-passed slip of the torsional anchor, rad/s; 0 while it sticks (soft-finger proxy only)
    spin_slip_angle  |phi| at the last tick whose anchor slipped, as `spin` (soft-finger proxy only)
    bend             wind-up against rolling, tangential: rad times the root of its stiffness per share
    """

    body: float
    normal: Vec3
    push: float
    share: float
    mode: float
    deflection: Vec3
    rolled_part: Vec3
    spin: float
    slip_speed: float
    slip_deflection: float
    spin_slip_speed: float
    spin_slip_angle: float
    bend: Vec3


NO_CONTACT = ContactState(
    body=-1.0,
    normal=(0.0, 0.0, 1.0),
    push=0.0,
    share=0.0,
    mode=0.0,
    deflection=(0.0, 0.0, 0.0),
    rolled_part=(0.0, 0.0, 0.0),
    spin=0.0,
    slip_speed=0.0,
    slip_deflection=0.0,
    spin_slip_speed=0.0,
    spin_slip_angle=0.0,
    bend=(0.0, 0.0, 0.0),
)
"""A place for a contact, with none in it."""


class FingerState(NamedTuple):
    """What the contact of one finger remembers from one tick to the next.

    started          0 before the finger's first pose, then 1
    probe            at the last tick
    mode             FREE, or the mode of its first contact
    center           the proxy; among several objects the one that friction has not displaced
    contacts         tuple of ContactState: one in a scene of one object, else three, the most loaded first
    rolled           roll angle since touch, rad
    stuck            ticks in a row in which the proxy found no rest and stood still
    effects          states of the effects of the workspace and of every object: what they remember is about this
                     visitor, a vibration's phase too, which waits at its beginning while the finger is out of reach
    """

    started: float
    probe: Probe
    mode: float
    center: Vec3
    contacts: Any
    rolled: float
    stuck: float
    effects: Any


class State(NamedTuple):
    """Everything a step leaves for the next: one world, and a FingerState for each of the scene's fingers."""

    world: World
    fingers: Any


class FrictionInput(NamedTuple):
    """What a contact brings to friction and torsion in a tick: see `ContactState` for the names.

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


class FrictionResult(NamedTuple):
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


class ContactOutcome(NamedTuple):
    """The outcome of one step for one contact; zeros, and -1 for the object, where there is none.

    object  its number in the scene
    point   m, where the contact is on it
    normal  of the object there
    force   N, on the hand
    spin    rad, torsional wind-up
    torque  N m, on the hand about the fingertip's centre
    """

    object: float
    point: Vec3
    normal: Vec3
    force: Vec3
    mode: float
    spin: float
    torque: Vec3


NO_OUTCOME = ContactOutcome(
    object=-1.0,
    point=(0.0, 0.0, 0.0),
    normal=(0.0, 0.0, 0.0),
    force=(0.0, 0.0, 0.0),
    mode=0.0,
    spin=0.0,
    torque=(0.0, 0.0, 0.0),
)


class Contact(NamedTuple):
    """The outcome of one step for one finger.

    force, torque    on the hand, world frame, torque about the fingertip centre
    finger_point     contact point in the fingertip frame
    cause            of the mode change in this tick, CAUSE_NONE if it did not change
    torsion          N m, moment about the normal on the hand
    patch_radius     m, 0 for a fingertip without a patch
    patch_normal     of the object, in the fingertip frame
    patch_stretch    m, of the skin against the fingertip along the surface, in the fingertip frame
    contacts         tuple of ContactOutcome, as many as FingerState has contacts, in their order
    budget           1 if a mesh or height map could not be searched to the end: the proxy stays where it was, or it is
                     not known whether a first pose touches
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
    torsion: float
    patch_radius: float
    patch_normal: Vec3
    patch_stretch: Vec3
    contacts: Any
    budget: float
