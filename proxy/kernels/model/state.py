"""State of the world and of each finger's contact, intermediate values of a tick, and the result of a step."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.model.vectors import Quaternion, Vec3


class World(NamedTuple):
    """State of the world, independent of the fingers.

    started    0 before the first tick, then 1
    time       s, the sum of all time steps
    poses      current pose of the only object, None if it cannot move; of several objects the memory of their poses
               (`query.world`)
    last_pose  pose of the only object at the last tick, None for several
    surfaces   tuple of a Surface for each finger on an elastic object, None in other scenes
    """

    started: float
    time: float
    poses: Any
    last_pose: Any
    surfaces: Any = None


class Probe(NamedTuple):
    """Fingertip's pose in a tick, fingertip to world, and its filtered velocity, m/s."""

    position: Vec3
    orientation: Quaternion
    velocity: Vec3


class ProbeMotion(NamedTuple):
    """Probe in this tick and in the last one, and the time between them, s."""

    probe: Probe
    last: Probe
    dt: float


NONE = -1.0
"""Flat object index of no object, see `Constraint`."""


class Constraint(NamedTuple):
    """Tangent plane of an object, offset by the fingertip's radius, that the proxy may not cross.

    object_index      flat index of the object, -1 for none: its row, and the triangle of a mesh (`query.container`)
    normal        (3,)
    depth         m   of the probe behind the proxy along the normal: the sum of the normals, weighted by it, points
                      from the probe to the proxy
    """

    object_index: float
    normal: Vec3
    depth: float


ActiveSet = tuple[Constraint, Constraint, Constraint]
"""Constraints that support the proxy, unused ones last; the first belongs to the object on which the finger rolls.
During the search for the rest position, a height map may have several of them, one for each support point."""


class ContactState(NamedTuple):
    """State of one contact between ticks.

    object_index     flat index of the touched object as in `Constraint`, -1 for no contact
    normal           n: outward unit normal of the object at the contact point
    push             m, distance along n by which the object separates the proxy from the probe
    share            of the load, 0 to 1: the contact has this share of the coupling and of the torsional spring
    mode             FREE, ROLLING or SLIDING
    deflection       e: tangential, from the probe to the point where the contact sticks
    rolled_part      p: the part of e wound up by rolling
    spin             phi: torsional wind-up, rad; with a contact patch in the unit of `compute_winding_unit`
    slip_speed       low-passed plastic slip, m/s
    slip_deflection  |e| at the last tick that slipped, m
    spin_slip_speed  low-passed slip of the torsional anchor, rad/s; 0 while it sticks (soft-finger proxy only)
    spin_slip_angle  |phi| at the last tick in which the anchor slipped, as `spin` (soft-finger proxy only)
    bend             wind-up against rolling, tangential: rad times the root of its stiffness per share
    """

    object_index: float
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
    object_index=-1.0,
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
"""State of an unused contact."""


class FingerState(NamedTuple):
    """State of one finger between ticks.

    started          0 before the finger's first pose, then 1
    probe            at the last tick
    mode             FREE, or the mode of its first contact
    center           the proxy; with several objects the one not displaced by friction
    contacts         tuple of ContactState: one in a scene of one object, otherwise three, the most loaded first
    rolled           roll angle since touch, rad
    stuck_ticks      count of consecutive ticks without a rest position, see `approach.count_stuck_ticks`
    effects          states of the effects of the workspace and of every object. They are separate for each finger,
                     including the phase of a vibration, which remains at its start while the finger is out of reach
    """

    started: float
    probe: Probe
    mode: float
    center: Vec3
    contacts: Any
    rolled: float
    stuck_ticks: float
    effects: Any


class State(NamedTuple):
    """Complete state between steps: one world, and a FingerState for each finger of the scene."""

    world: World
    fingers: Any


class FrictionInput(NamedTuple):
    """Input of friction and torsion from one contact in a tick: see `ContactState` for the names.

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
    """Result of friction and torsion in a tick: new mode with its cause, new state, and reaction on the hand.

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
    """Result of a step for one contact; zeros, and -1 for the object, if there is none.

    object  its index in the scene file
    point   m, contact point on the object
    normal  of the object at that point
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
    """Result of a step for one finger.

    force, torque    on the hand, world frame, torque about the fingertip's centre
    finger_point     contact point in the fingertip frame
    cause            of the mode change in this tick, CAUSE_NONE if the mode did not change
    torsion          N m, moment about the normal on the hand
    patch_radius     m, 0 for a fingertip without a patch
    patch_normal     of the object, in the fingertip frame
    patch_stretch    m, displacement of the skin relative to the fingertip along the surface, in the fingertip frame
    contacts         tuple of ContactOutcome, as many as FingerState has contacts, in the same order
    budget           1 if the search of a mesh or height map was not completed: the proxy did not move, or it is unknown
                     whether a first pose touches; 2 if the proxy has not yet come to rest (contact.budget of a record)
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
