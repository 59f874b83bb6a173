"""One tick of contact: probe pose in, force and torque out, in the order of the equations."""

from softfinger.proxy.kernels import rotations, vec3
from softfinger.proxy.kernels.friction import Tick, hold
from softfinger.proxy.kernels.jit import jit
from softfinger.proxy.kernels.model import Contact, Quaternion, Scene, State, Vec3
from softfinger.proxy.kernels.rolling import roll, torque_stiffness
from softfinger.proxy.kernels.surfaces import closest, transport
from softfinger.proxy.kernels.torsion import wind
from softfinger.proxy.state import CAUSE_NONE, CAUSE_RELEASE, CAUSE_TOUCH, FREE, ROLLING


@jit
def filter_velocity(state: State, position: Vec3, dt: float, time_constant: float) -> Vec3:
    """Probe velocity (3,) m/s: backward difference through a first-order low-pass."""
    if state.started == 0.0 or dt <= 0.0:
        return state.velocity
    gain = 1.0 / (time_constant + dt)
    moved = vec3.sub(position, state.position)
    return vec3.add_scaled(vec3.scale(time_constant * gain, state.velocity), gain, moved)


@jit
def out_of_contact(state: State, position: Vec3, orientation: Quaternion, velocity: Vec3) -> tuple[State, Contact]:
    """State and outcome in free space; leaving a contact is a release."""
    zero, cause = (0.0, 0.0, 0.0), float(CAUSE_NONE)
    if state.mode != FREE:
        cause = float(CAUSE_RELEASE)
    up = (0.0, 0.0, 1.0)
    free = float(FREE)
    after = State(1.0, position, orientation, velocity, free, position, up, zero, zero, 0.0, 0.0, 0.0, 0.0)
    contact = Contact(
        free, -1.0, cause, velocity, position, 0.0, zero, zero, zero, 0.0, 0.0, 0.0, 0.0, zero, zero
    )  # fmt: skip
    return after, contact


@jit
def step(scene: Scene, state: State, position: Vec3, orientation: Quaternion, dt: float) -> tuple[State, Contact]:
    """Advance the contact by one tick.

    scene        Scene   what is modelled, with its parameters
    state        State   what the last tick left
    position     (3,)    m  probe position, world
    orientation  (4,)    1  probe orientation, unit quaternion, fingertip to world
    dt           s          time since the last tick; 0 freezes velocity and damping
    returns      State, Contact
    """
    radius = scene.radius
    thing = scene.objects[0]
    velocity = filter_velocity(state, position, dt, scene.velocity_time_constant)
    gap, foot, normal = closest(thing.shape, position)

    held = state.mode != FREE and vec3.dot(vec3.sub(state.center, position), state.normal) > 0.0
    if gap >= radius and not held:
        return out_of_contact(state, position, orientation, velocity)

    mode, cause, touched = state.mode, float(CAUSE_NONE), 0.0
    rolled_part, motion, theta, twist = state.rolled_part, (0.0, 0.0, 0.0), 0.0, 0.0
    if mode == FREE:
        mode, cause, touched = float(ROLLING), float(CAUSE_TOUCH), 1.0
        center = vec3.add_scaled(foot, radius, normal)
    else:
        turn = rotations.relative(orientation, state.orientation)
        twist = rotations.twist(turn, state.normal)
        center, normal, motion, theta = roll(scene.rolling, thing.shape, radius, state.center, state.normal, turn)
        rolled_part = vec3.add(transport(thing.shape, rolled_part, state.normal, normal), motion)

    behind = vec3.sub(center, position)
    penetration = vec3.dot(behind, normal)
    deflection = vec3.add_scaled(behind, -penetration, normal)
    elastic = thing.stiffness * penetration
    damped = elastic - thing.damping * vec3.dot(velocity, normal)
    normal_force = min(max(damped, 0.0), max(2.0 * elastic, 0.0))

    before = transport(thing.shape, state.deflection, state.normal, normal)
    held_by = hold(
        thing.friction,
        scene.coupling,
        torque_stiffness(scene.rolling, scene.coupling),
        Tick(
            radius, scene.position_resolution, dt, touched, mode, deflection, before, rolled_part,
            state.slip_speed, state.slip_deflection, normal_force,
        ),
    )  # fmt: skip
    if held_by.cause != CAUSE_NONE:
        cause = held_by.cause
    center = vec3.add(position, vec3.add_scaled(held_by.deflection, penetration, normal))
    spin, moment = wind(thing.torsion, state.spin, twist, normal_force)

    # A contact force f at -r n from the centre turns the hand by -r n x f; the normal part does not.
    force = vec3.add_scaled(held_by.force, normal_force, normal)
    torque = vec3.add_scaled(vec3.scale(moment, normal), -radius, vec3.cross(normal, held_by.force))
    rolled = state.rolled + theta
    after = State(
        1.0, position, orientation, velocity, held_by.mode, center, normal, held_by.deflection,
        held_by.rolled_part, spin, held_by.slip_speed, held_by.slip_deflection, rolled,
    )  # fmt: skip
    inward = rotations.rotate(rotations.conjugate(orientation), normal)
    contact = Contact(
        held_by.mode, 0.0, cause, velocity, center, penetration, vec3.add_scaled(center, -radius, normal), normal,
        vec3.scale(-radius, inward), rolled, spin, normal_force, vec3.norm(held_by.force), force, torque,
    )  # fmt: skip
    return after, contact
