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


class Friction(NamedTuple):
    """Coulomb friction; 0 <= kinetic <= static."""

    static: float
    kinetic: float


class Torsion(NamedTuple):
    """Torsional spring about the normal, N m/rad, and the length whose product with f_N is its limit, m."""

    stiffness: float
    friction_length: float


class Object(NamedTuple):
    """A shape and its material: normal stiffness N/m and damping N s/m, Friction or None, Torsion or None."""

    shape: Any
    stiffness: float
    damping: float
    friction: Any
    torsion: Any


class EulerZxz(NamedTuple):
    """Rolling by the ZXZ Euler angles of each tick's rotation; `torque_stiffness` is k_tau, N/m."""

    torque_stiffness: float


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
    """

    radius: float
    objects: Any
    rolling: Any
    coupling: Coupling
    velocity_time_constant: float
    position_resolution: float


class State(NamedTuple):
    """What a contact remembers from one tick to the next.

    started          0 before the first pose, then 1
    position, orientation, velocity    of the probe at the last tick
    mode             FREE, ROLLING or SLIDING
    center, normal   c and n: the proxy and the outward unit normal under it
    deflection       e: tangential part of c minus the probe position
    rolled_part      p: the share of e that rolling has wound
    spin             phi: torsional wind-up, rad
    slip_speed       low-passed plastic slip, m/s
    slip_deflection  |e| at the last tick that slipped, m
    rolled           roll angle since touch, rad
    """

    started: float
    position: Vec3
    orientation: Quaternion
    velocity: Vec3
    mode: float
    center: Vec3
    normal: Vec3
    deflection: Vec3
    rolled_part: Vec3
    spin: float
    slip_speed: float
    slip_deflection: float
    rolled: float


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

START = State(
    0.0, ZERO, (1.0, 0.0, 0.0, 0.0), ZERO, 0.0, ZERO, (0.0, 0.0, 1.0), ZERO, ZERO, 0.0, 0.0, 0.0, 0.0
)  # fmt: skip
"""State before the first pose."""
