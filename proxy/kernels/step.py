"""One tick of contact: probe pose in, force and torque out, in the order of the equations."""

from typing import Any

from softfinger.proxy.kernels import rotations, vec3
from softfinger.proxy.kernels.approach import has_ended, stay, touch
from softfinger.proxy.kernels.bodies import material_of, number_of, place_all, pose_of
from softfinger.proxy.kernels.cones import turned
from softfinger.proxy.kernels.contacts import NONE, Held, displacement_by, hold_by, load_of, settle, tangent_to_all
from softfinger.proxy.kernels.effects import Moment, apply_effects
from softfinger.proxy.kernels.friction import hold
from softfinger.proxy.kernels.jit import jit
from softfinger.proxy.kernels.model import Contact, Pose, Quaternion, Scene, State, Tick, Vec3
from softfinger.proxy.kernels.object_effects import Touched, apply_objects_effects
from softfinger.proxy.kernels.rolling import torque_stiffness
from softfinger.proxy.state import CAUSE_NONE, CAUSE_RELEASE, FREE, SLIDING


@jit
def filter_velocity(state: State, position: Vec3, dt: float, time_constant: float) -> Vec3:
    """Probe velocity (3,) m/s: backward difference through a first-order low-pass."""
    if state.started == 0.0 or dt <= 0.0:
        return state.velocity
    gain = 1.0 / (time_constant + dt)
    moved = vec3.sub(position, state.position)
    return vec3.add_scaled(vec3.scale(time_constant * gain, state.velocity), gain, moved)


@jit
def out_of_contact(
    scene: Scene,
    objects: Any,
    state: State,
    position: Vec3,
    orientation: Quaternion,
    velocity: Vec3,
    dt: float,
) -> tuple[State, Contact]:
    """State and outcome in free space; leaving a contact is a release."""
    zero, cause = (0.0, 0.0, 0.0), float(CAUSE_NONE)
    if state.mode != FREE:
        cause = float(CAUSE_RELEASE)
    time = state.time + dt
    up, free, still = (0.0, 0.0, 1.0), float(FREE), (1.0, 0.0, 0.0, 0.0)
    force, states = all_effects(scene, objects, state, hold_by(NONE, up), position, velocity, velocity, dt)
    after = State(
        1.0, time, position, orientation, velocity, free, NONE, NONE, NONE, Pose(zero, still), position, up, zero, zero,
        0.0, 0.0, 0.0, 0.0, 0.0, 0.0, states,
    )  # fmt: skip
    contact = Contact(
        free, -1.0, cause, velocity, position, 0.0, zero, zero, zero, 0.0, 0.0, 0.0, 0.0, force, zero
    )  # fmt: skip
    return after, contact


@jit
def all_effects(
    scene: Scene,
    objects: Any,
    state: State,
    held: Held,
    position: Vec3,
    velocity: Vec3,
    against: Vec3,
    dt: float,
) -> tuple[Vec3, Any]:
    """Force of the workspace's and the objects' effects, and their states."""
    up, in_contact = (0.0, 0.0, 1.0), 0.0 if held.first < 0.0 else 1.0
    around = Moment(position, velocity, dt, in_contact, 0.0, up, None)
    force, states = apply_effects(scene.effects, state.effects[0], around)
    contact = Moment(position, against, dt, 0.0, 0.0, up, None)
    touched = Touched(
        number_of(objects, held.first), number_of(objects, held.second), number_of(objects, held.third),
        held.n1, held.n2, held.n3,
    )  # fmt: skip
    more, states_of_objects = apply_objects_effects(objects, state.effects[1], scene.radius, touched, contact)
    return vec3.add(force, more), (states, states_of_objects)


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
    velocity = filter_velocity(state, position, dt, scene.velocity_time_constant)
    objects = place_all(scene.objects, state.time + dt)
    if state.mode == FREE:
        comes = touch(scene, objects, state, position, velocity)
    else:
        comes = stay(scene, objects, state, position, orientation, velocity, dt)
    if has_ended(objects, scene.radius, position, comes.held):
        return out_of_contact(scene, objects, state, position, orientation, velocity, dt)

    load = load_of(objects, comes.held, comes.against)
    material = material_of(objects, comes.held.first)
    kept = hold(
        turned(material.friction, pose_of(objects, comes.held.first).orientation),
        material.torsion,
        scene.coupling,
        torque_stiffness(scene.rolling, scene.coupling),
        Tick(
            scene.radius, scene.position_resolution, dt, comes.mode, comes.held.n1, comes.deflection, comes.before,
            comes.rolled_part, state.slip_speed, state.slip_deflection, state.spin, comes.twist,
            state.spin_slip_speed, state.spin_slip_angle, load.friction,
        ),
    )  # fmt: skip

    # Where friction lets go the proxy follows, and the forces are those at its new place.
    slips = kept.mode == SLIDING or kept.deflection != comes.deflection
    center, rests, _ = settle(objects, scene.radius, position, comes.center, kept.deflection, comes.held, slips)
    loads = load_of(objects, rests, comes.against)
    tangential = tangent_to_all(rests, kept.force)
    spin, moment, slip_speed, slip_angle = kept.spin, kept.moment, kept.spin_slip_speed, kept.spin_slip_angle
    if load.friction > loads.friction:
        # Less normal force there: both stay within their limits, the torsional one growing by up to f_N^(4/3).
        ease = loads.friction / load.friction
        tangential, moment = vec3.scale(ease, tangential), ease * ease * moment
    if rests.first != comes.held.first:  # another normal now: what was wound up about the old one is gone
        spin, moment, slip_speed, slip_angle = 0.0, 0.0, 0.0, 0.0

    # A contact force f at -r n from the centre turns the hand by -r n x f; the normal part does not.
    normal, rolled = rests.n1, state.rolled + comes.theta
    torque = vec3.add_scaled(vec3.scale(moment, normal), -scene.radius, vec3.cross(normal, tangential))
    extra, states = all_effects(scene, objects, state, rests, position, velocity, comes.against, dt)
    behind = vec3.sub(center, position)
    after = State(
        1.0, state.time + dt, position, orientation, velocity, kept.mode, rests.first, rests.second, rests.third,
        pose_of(objects, rests.first), center, normal,
        vec3.sub(behind, displacement_by(objects, rests)),
        tangent_to_all(rests, kept.rolled_part), spin, kept.slip_speed, kept.slip_deflection, slip_speed, slip_angle,
        rolled, states,
    )  # fmt: skip
    inward = rotations.rotate(rotations.conjugate(orientation), normal)
    contact = Contact(
        kept.mode, number_of(objects, rests.first), kept.cause if kept.cause != CAUSE_NONE else comes.cause, velocity,
        center, vec3.dot(behind, normal), vec3.add_scaled(center, -scene.radius, normal), normal,
        vec3.scale(-scene.radius, inward), rolled, spin, loads.total, vec3.norm(tangential),
        vec3.add(vec3.add(loads.force, tangential), extra), torque,
    )  # fmt: skip
    return after, contact
