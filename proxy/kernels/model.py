"""What a scene is made of, as named tuples of float64: the parts, the state of a contact, the outcome of a step.

A part that a scene does not have is None, and the kernel for None does nothing: it is not compiled.
Lengths m, forces N, angles rad; vectors (3,) in the world frame unless said; quaternions w, x, y, z.
"""

from typing import Any, NamedTuple

Vec3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class Plane(NamedTuple):
    """Half space {x : normal . x <= offset}, touched from outside."""

    normal: Vec3
    offset: float


class Sphere(NamedTuple):
    """Sphere about the origin of its frame; `side` is +1 touched from outside, -1 from inside."""

    radius: float
    side: float


class Cylinder(NamedTuple):
    """Endless cylinder about the z axis; `side` as for Sphere."""

    radius: float
    side: float


class CappedCylinder(NamedTuple):
    """Solid cylinder about the z axis with flat ends at z = +-half_length, sharp rims, touched from outside."""

    radius: float
    half_length: float


class Capsule(NamedTuple):
    """Cylinder about the z axis with round ends, whose centres are at z = +-half_length; `side` as for Sphere."""

    radius: float
    half_length: float
    side: float


class Box(NamedTuple):
    """Solid box |x_i| <= half_extents_i with sharp edges and corners, touched from outside."""

    half_extents: Vec3


class Ellipsoid(NamedTuple):
    """Ellipsoid sum (x_i / semi_axes_i)^2 = 1; `side` as for Sphere."""

    semi_axes: Vec3
    side: float


class Torus(NamedTuple):
    """Ring of tube radius `minor` about the circle of radius `major` > `minor` in z = 0; `side` as for Sphere."""

    major: float
    minor: float
    side: float


class Friction(NamedTuple):
    """Coulomb friction; 0 <= kinetic <= static."""

    static: float
    kinetic: float


class Stribeck(NamedTuple):
    """Slip speed, m/s, over which friction falls from its static to its kinetic value; 0: at once."""

    speed: float


class SpeedFriction(NamedTuple):
    """Friction that changes with the slip speed: Stribeck or None, and a viscous coefficient, s/m."""

    static: float
    kinetic: float
    stribeck: Any
    viscous: float


class Anisotropic(NamedTuple):
    """A friction law whose coefficients are scaled along a direction of the surface and across it.

    law        Friction or SpeedFriction
    direction  (3,)  in the frame of the object's pose, where that turns it, else in the world; its part tangent
                     to the surface counts
    """

    law: Any
    direction: Vec3
    static_along: float
    static_across: float
    kinetic_along: float
    kinetic_across: float


class PaperFriction(NamedTuple):
    """Coulomb friction under the paper's switching rule read to the letter, for study."""

    static: float
    kinetic: float


class Torsion(NamedTuple):
    """Torsional spring about the normal, N m/rad, and the length whose product with f_N is its limit, m."""

    stiffness: float
    friction_length: float


class PowerTorsion(NamedTuple):
    """As Torsion, with the limit friction_length f_N (f_N / 1 N)^exponent; exponent 0 to 1/3."""

    stiffness: float
    friction_length: float
    exponent: float


class LimitSurface(NamedTuple):
    """Tangential force and moment share one limit; `law` (Torsion or PowerTorsion) is its torsional axis."""

    law: Any


class SoftFingerProxy(NamedTuple):
    """A proxy that also turns, with a torsional cone of its own: it sticks below the limit of `law` (Torsion
    or PowerTorsion), and slips at `kinetic_share` (0 to 1) of it."""

    law: Any
    kinetic_share: float


class Material(NamedTuple):
    """Normal stiffness N/m and damping N s/m, a friction law or None, a torsion law or None."""

    stiffness: float
    damping: float
    friction: Any
    torsion: Any


class Object(NamedTuple):
    """One shape to touch.

    shape     in the frame of `pose`
    pose      None (in the world), Place or Pose; Pose if it moves
    motion    None, or how it moves
    material  Material, of the same parts for all objects of a scene
    number    of the object in the scene file; several shapes may make one object
    effects   tuple of effects
    """

    shape: Any
    pose: Any
    motion: Any
    material: Material
    number: float
    effects: Any


class EulerZxz(NamedTuple):
    """Rolling by the ZXZ Euler angles of each tick's rotation; `torque_stiffness` is k_tau, N/m."""

    torque_stiffness: float


class EulerZyx(NamedTuple):
    """Rolling by the roll, pitch and yaw of each tick's rotation; `torque_stiffness` is k_tau, N/m."""

    torque_stiffness: float


class RotationVector(NamedTuple):
    """Rolling in closed form, for a constant rate within a tick; `torque_stiffness` is k_tau, N/m."""

    torque_stiffness: float


class Midpoint(NamedTuple):
    """Rolling by the midpoint rule; `torque_stiffness` is k_tau, N/m."""

    torque_stiffness: float


class MontanaRk4(NamedTuple):
    """Rolling integrated by one step of the classical Runge-Kutta rule; `torque_stiffness` is k_tau, N/m."""

    torque_stiffness: float


class MontanaRk45(NamedTuple):
    """Rolling integrated with step control.

    torque_stiffness  N/m  k_tau
    tolerance         1    error allowed for each part of the step, relative to the fingertip's radius
    """

    torque_stiffness: float
    tolerance: float


class Place(NamedTuple):
    """Where a body is that is not turned: its origin, m."""

    position: Vec3


class Pose(NamedTuple):
    """Where a body is: its origin, m, and its rotation, body to world."""

    position: Vec3
    orientation: Quaternion


class Sinusoid(NamedTuple):
    """Motion to and fro, in the object's frame at rest: amplitude (3,) m, and rad about a unit axis; Hz, rad."""

    translation: Vec3
    axis: Vec3
    angle: float
    frequency: float
    phase: float


class Turntable(NamedTuple):
    """Steady rotation, in the object's frame at rest: rad/s about a unit axis through the pivot, m."""

    axis: Vec3
    rate: float
    pivot: Vec3


class Driven(NamedTuple):
    """Moved from outside: its pose is changed while running, by a command or a script."""


class BoxRegion(NamedTuple):
    """Where an effect acts: a box along the axes of the world; `edge` is the depth at which it is whole, m."""

    center: Vec3
    half_extents: Vec3
    edge: float


class SphereRegion(NamedTuple):
    """Where an effect acts: a ball; `edge` as in BoxRegion."""

    center: Vec3
    radius: float
    edge: float


class Touching(NamedTuple):
    """When an effect acts: while the object is touched, and by how much of itself."""

    share: float


class Viscosity(NamedTuple):
    """Force -damping * velocity, N s/m, in a region (None: everywhere)."""

    damping: float
    region: Any


class ConstantForce(NamedTuple):
    """The same force everywhere in a region, N, world frame."""

    force: Vec3
    region: Any


class Spring(NamedTuple):
    """Spring to a point of the world: m, N/m, m, and the largest force, N."""

    anchor: Vec3
    stiffness: float
    rest_length: float
    force_max: float
    region: Any


class BoxBoundary(NamedTuple):
    """Spring-damper towards the inside of a box along the axes of the world, at most `force_max`, N."""

    center: Vec3
    half_extents: Vec3
    stiffness: float
    damping: float
    force_max: float


class SphereBoundary(NamedTuple):
    """Spring-damper towards the inside of a ball, at most `force_max`, N."""

    center: Vec3
    radius: float
    stiffness: float
    damping: float
    force_max: float


class Vibration(NamedTuple):
    """Sine of an amplitude, N, and a frequency, Hz, along a unit vector."""

    amplitude: float
    frequency: float
    direction: Vec3
    region: Any


class NormalVibration(NamedTuple):
    """Sine along the normal of the touched surface."""

    amplitude: float
    frequency: float


class Magnet(NamedTuple):
    """Attraction to an object: N at its surface, none beyond `range`, m; exponent of the fall between."""

    force: float
    range: float
    exponent: float


class StickSlip(NamedTuple):
    """Texture of points that hold, N/m, up to a force, N."""

    stiffness: float
    force_max: float


class Anchor(NamedTuple):
    """Memory of StickSlip: the point that holds, in the object's frame, and 1 if there is one."""

    point: Vec3
    held: float


class Phase(NamedTuple):
    """Memory of a vibration: turns since its start, in [0, 1)."""

    turns: float


class Coupling(NamedTuple):
    """Tangential spring (N/m) and damper (N s/m) between computed and measured position."""

    stiffness: float
    damping: float


class Scene(NamedTuple):
    """Everything the contact step is compiled for.

    radius                  m    fingertip
    objects                      tuple of Object
    rolling                      a rolling method or None
    coupling                     Coupling
    velocity_time_constant  s    low-pass of the probe velocity, 0 for the plain difference
    position_resolution     m    encoder step of the probe
    effects                      tuple of effects of the workspace
    """

    radius: float
    objects: Any
    rolling: Any
    coupling: Coupling
    velocity_time_constant: float
    position_resolution: float
    effects: Any


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


ZERO: Vec3 = (0.0, 0.0, 0.0)
