"""One tick of contact: probe poses in, forces and torques out, in the order of the equations."""

from typing import Any

from softfinger.proxy.kernels.contact.approach import (
    STUCK_TICKS,
    has_ended,
    is_clear,
    meet,
    parted,
    stay,
    touch,
)
from softfinger.proxy.kernels.contact.carry import carried_direction, carry, velocity_against
from softfinger.proxy.kernels.contact.fingertip import point_on, point_under, roundness, seen_by, torque_of, velocity_at
from softfinger.proxy.kernels.contact.normal import press
from softfinger.proxy.kernels.contact.patches import Motion, again, aside, carried_patches, farther_than_probe, hand_on
from softfinger.proxy.kernels.contact.rest.constraints import (
    INSIDE,
    NONE,
    Constraints,
    held_by,
    one_constraint,
    tangent_to_all,
)
from softfinger.proxy.kernels.contact.rest.several import drawn_after, settle_among_several
from softfinger.proxy.kernels.contact.rest.single import settle_on_one
from softfinger.proxy.kernels.contact.rolling_resistance import Bent, resist
from softfinger.proxy.kernels.contact.texture import embossed, roughened
from softfinger.proxy.kernels.contact.wrench import outcome_of, wrench_of
from softfinger.proxy.kernels.effects.forces import Situation, apply_effects
from softfinger.proxy.kernels.effects.objects import Touched, apply_objects_effects
from softfinger.proxy.kernels.friction.footprint import footprint, torsion_under, winding_unit
from softfinger.proxy.kernels.friction.laws import turned
from softfinger.proxy.kernels.friction.machine import react
from softfinger.proxy.kernels.geometry import rotations, vec3
from softfinger.proxy.kernels.geometry.bodies import closest_to_within, deepest, number_of, pose_of
from softfinger.proxy.kernels.geometry.kinds import any_wide
from softfinger.proxy.kernels.geometry.mesh.query import BUDGET
from softfinger.proxy.kernels.geometry.world import advance, all_bare, place_all
from softfinger.proxy.kernels.model import (
    NO_PATCH,
    NO_PATCH_CONTACT,
    Contact,
    Finger,
    FingerState,
    Patch,
    PatchContact,
    PatchState,
    Pose,
    Probe,
    Scene,
    State,
    Vec3,
)
from softfinger.proxy.kernels.native.dispatch import by_count
from softfinger.proxy.kernels.native.jit import jit
from softfinger.proxy.kernels.tuples import same_for
from softfinger.proxy.record import (
    CAUSE_NONE,
    CAUSE_RELEASE,
    CAUSE_RESTART,
    CAUSE_TOUCH,
    FREE,
    ON_ITS_WAY,
    SLIDING,
    UNSEARCHED,
)


@jit
def step(scene: Scene, state: State, poses: Any, dt: float) -> tuple[State, Any]:
    """Advance the world by one tick, and every finger over it.

    scene     Scene   what is modelled, with its parameters
    state     State   what the last tick left
    poses             a Pose for each finger: probe position, m, and orientation, unit quaternion, fingertip to world
    dt        s       time since the last tick; 0 freezes velocity and damping
    returns   State, and a Contact for each finger
    """
    world = advance(scene.objects, state.world, dt)
    objects = place_all(scene.objects, world.poses, world.was)
    fingers, contacts = step_fingers(scene.fingers, scene, objects, state.fingers, poses, dt)
    return State(world=world, fingers=fingers), contacts


@by_count
def step_fingers(fingers: Any, scene: Scene, objects: Any, states: Any, poses: Any, dt: float) -> Any:
    """`step_finger` for each finger; states and Contacts, a tuple each."""


@step_fingers.of(1)
def step_the_only_finger(fingers: Any, scene: Scene, objects: Any, states: Any, poses: Any, dt: float) -> Any:
    state, contact = step_finger(scene, fingers[0], objects, states[0], poses[0], dt)
    return (state,), (contact,)


@step_fingers.of(2)
def step_several_fingers(fingers: Any, scene: Scene, objects: Any, states: Any, poses: Any, dt: float) -> Any:
    state, contact = step_finger(scene, fingers[0], objects, states[0], poses[0], dt)
    others, contacts = step_fingers(fingers[1:], scene, objects, states[1:], poses[1:], dt)
    # numba joins tuples of known types, and does not unpack one inside another.
    return (state,) + others, (contact,) + contacts  # noqa: RUF005


@jit
def step_finger(
    scene: Scene, finger: Finger, objects: Any, state: FingerState, pose: Pose, dt: float
) -> tuple[FingerState, Contact]:
    """One finger's contact in a world that has been advanced: `objects` are where `place_all` has put them."""
    velocity = filter_velocity(state, pose.position, dt, finger.velocity_time_constant)
    probe = Probe(pose.position, pose.orientation, velocity)
    seen = seen_by(finger.form, finger.radius, objects, pose.orientation)
    return touch_or_stay(state.patches, seen, scene, finger, state, probe, dt)


@by_count
def touch_or_stay(
    patches: Any, objects: Any, scene: Scene, finger: Finger, state: FingerState, probe: Probe, dt: float
) -> Any:
    """The finger's state and Contact: with one object there is one patch, and the proxy follows it where it slips."""


@touch_or_stay.of(1)
def on_the_only_object(
    patches: Any, objects: Any, scene: Scene, finger: Finger, state: FingerState, probe: Probe, dt: float
) -> tuple[FingerState, Contact]:
    position, form, shapes = probe.position, finger.form, all_bare(objects)
    touches = state.mode == FREE
    if not touches:
        comes = stay(scene, finger, shapes, state, probe, dt)
        touches = has_ended(comes.active)
    if touches:  # what is met in the tick in which the last contact ended is another one
        state = parted(state)
        comes = touch(finger, shapes, state, probe, dt)
    if comes.active.first < 0.0:
        return out_of_contact(scene, finger, objects, state, probe, dt, BUDGET)

    rough = roughened(objects, comes.active, comes.center)
    material, last = rough[0].material, state.patches[0]
    felt = embossed(objects, comes.active, position)
    moves, since = carry(shapes, 0.0), 0.0 if touches else dt
    against = velocity_at(form, comes.against, moves, probe, state.probe, comes.active.n1, since)
    normal_force = press(material.normal, felt.push.first, vec3.dot(against, felt.n1))
    round_by = roundness(form, finger.radius, probe.orientation, comes.active.n1)
    area = footprint(finger.patch, round_by, material.compliance, normal_force)
    torsion, unit = torsion_under(material.torsion, area), winding_unit(material.torsion, area, 1.0)
    kept = react(
        turned(material.friction, pose_of(shapes, 0.0).orientation),
        torsion,
        finger.coupling,
        finger.torque_stiffness,
        Patch(
            radius=finger.radius,
            resolution=finger.position_resolution,
            dt=dt,
            mode=comes.mode,
            normal=comes.active.n1,
            deflection=comes.deflection,
            deflection_before=comes.before,
            rolled_part=comes.rolled_part,
            slip_speed=last.slip_speed,
            slip_deflection=last.slip_deflection,
            spin=last.spin / unit,
            twist=comes.twist,
            spin_slip_speed=last.spin_slip_speed,
            spin_slip_angle=last.spin_slip_angle / unit,
            normal_force=normal_force,
        ),
    )

    # Where friction lets go the proxy follows, and the forces are those at its new place.
    slips = kept.mode == SLIDING or kept.deflection != comes.deflection or comes.strays
    center, rests, bounded = settle_on_one(
        shapes, finger.radius, position, comes.center, kept.deflection, comes.active, slips
    )
    normal = rests.n1
    felt = embossed(objects, rests, position)
    against = velocity_at(form, comes.against, moves, probe, state.probe, normal, since)
    load = press(material.normal, felt.push.first, vec3.dot(against, felt.n1))
    tangential, moment = vec3.reject(kept.force, normal), kept.moment
    bent = Bent(0.0, comes.active.n1, 1.0, carried_direction(moves, last.bend), touches)
    bend, bending = resist(finger.patch, shapes, bent, probe, state.probe, area)
    if normal_force > load:
        # Less normal force there: both stay within their limits, the torsional one growing by up to f_N^(4/3).
        ease = load / normal_force
        tangential, moment = vec3.scale(ease, tangential), ease * ease * moment
        bending = vec3.scale(ease * ease, bending)

    rolled, pressing = state.rolled + comes.theta, vec3.scale(load, felt.n1)
    torque = torque_of(form, finger.radius, probe.orientation, normal, moment, pressing, tangential)
    torque = vec3.add(torque, bending)
    extra, states, unknown = all_effects(scene, finger.radius, objects, state, rests, probe, comes.against, dt)
    behind = vec3.sub(center, position)
    point = point_under(form, finger.radius, probe.orientation, center, normal)
    force = vec3.add(pressing, tangential)
    deflection = vec3.sub(behind, vec3.scale(rests.push.first, normal))
    patch = PatchState(
        body=0.0,
        normal=normal,
        push=rests.push.first,
        share=1.0,
        mode=kept.mode,
        deflection=deflection,
        rolled_part=vec3.reject(kept.rolled_part, normal),
        spin=kept.spin * unit,
        slip_speed=kept.slip_speed,
        slip_deflection=kept.slip_deflection,
        spin_slip_speed=kept.spin_slip_speed,
        spin_slip_angle=kept.spin_slip_angle * unit,
        bend=bend,
    )
    after = FingerState(
        started=1.0,
        probe=probe,
        mode=kept.mode,
        center=center,
        patches=(patch,),
        rolled=rolled,
        stuck=0.0,
        effects=states,
    )
    cause = kept.cause if kept.cause != CAUSE_NONE else comes.cause
    to_fingertip = rotations.conjugate(probe.orientation)
    inward, number = rotations.rotate(to_fingertip, normal), number_of(shapes, 0.0)
    touched = PatchContact(object=number, point=point, normal=normal, force=force, mode=kept.mode, spin=kept.spin)
    contact = Contact(
        mode=kept.mode,
        object=number,
        cause=cause,
        velocity=probe.velocity,
        center=center,
        penetration=vec3.dot(behind, normal),
        point=point,
        normal=normal,
        finger_point=point_on(form, finger.radius, inward),
        rolled=rolled,
        spin=kept.spin,
        normal_force=load,
        tangential_force=vec3.norm(tangential),
        force=vec3.add(force, extra),
        torque=torque,
        torsion=moment,
        patch_radius=area.radius,
        patch_normal=inward,
        patch_stretch=rotations.rotate(to_fingertip, vec3.reject(deflection, normal)),
        patches=(touched,),
        budget=max(bounded, comes.bounded, unknown),
    )
    return after, contact


@jit
def beside(objects: Any, radius: float, center: Vec3, way: Vec3, known: Vec3, left: int) -> Vec3:
    """The proxy (3,) m that friction keeps `way` (3,) m beside `center`: on what is nearest there, outside of all; with
    what is `left` of the budget."""
    if way == (0.0, 0.0, 0.0):
        return center
    there = vec3.add(center, way)
    gap, at, left = deepest(objects, there, radius, known, left)
    if any_wide(objects):
        if gap >= radius * (1.0 - INSIDE):  # beside a convex edge it is a little above the surface
            return there
        if at < 0.0:
            return center
    _, point, normal, left = closest_to_within(objects, at, there, left)
    there = vec3.add_scaled(point, radius, normal)
    gap, _, _ = deepest(objects, there, radius, known, left)
    return there if gap >= radius * (1.0 - INSIDE) else center


@touch_or_stay.of(2)
def among_several_objects(
    patches: Any, objects: Any, scene: Scene, finger: Finger, state: FingerState, probe: Probe, dt: float
) -> tuple[FingerState, Contact]:
    radius, position, shapes = finger.radius, probe.position, all_bare(objects)
    start, center, left = state.center, state.center, BUDGET
    active = one_constraint(NONE, (0.0, 0.0, 1.0))
    touches, stuck = state.mode == FREE, state.stuck
    if stuck >= STUCK_TICKS and is_clear(shapes, radius, position):
        return out_of_contact(scene, finger, objects, state, probe, dt, left)
    if not touches:
        center, active = again(shapes, radius, state, position)
        touches = has_ended(active)
    before = center
    if touches:  # what is met in the tick in which the last contact ended is another one
        state = parted(state)
        start, center, active, left = meet(finger, shapes, state, position)
    if active.first < 0.0:
        return out_of_contact(scene, finger, objects, state, probe, dt, left)

    center, active, late, left = settle_among_several(shapes, radius, position, start, center, active, left)
    last = carried_patches(shapes, state.patches)
    held = hand_on(objects, last, active)
    way = aside(last, held)
    motion = Motion(
        radius=radius,
        form=finger.form,
        resolution=finger.position_resolution,
        dt=dt,
        probe=probe,
        last=state.probe,
        center=state.center,
        turn=rotations.relative(probe.orientation, state.probe.orientation),
        free=vec3.add(vec3.sub(position, state.probe.position), way),
        blocked=vec3.scale(-1.0, way),
        farther=farther_than_probe(last, held),
        touches=touches,
    )
    rough = roughened(objects, active, center)
    one = wrench_of(scene.rolling, finger, rough, held[0], motion)
    two = wrench_of(scene.rolling, finger, rough, held[1], motion)
    three = wrench_of(scene.rolling, finger, rough, held[2], motion)

    normal, rolled, mode = active.n1, state.rolled + one.theta, one.after.mode
    pressing = vec3.add(vec3.add(one.normal_force, two.normal_force), three.normal_force)
    tangential = vec3.add(vec3.add(one.tangential_force, two.tangential_force), three.tangential_force)
    lag = vec3.scale(one.after.share, one.after.deflection)
    lag = vec3.add_scaled(lag, two.after.share, two.after.deflection)
    lag = vec3.add_scaled(lag, three.after.share, three.after.deflection)
    shown = beside(shapes, radius, center, tangent_to_all(active, lag), held_by(active), left)
    against = velocity_against(carry(shapes, active.first), probe.velocity, state.probe.position, dt)
    extra, states, unknown = all_effects(scene, radius, objects, state, active, probe, against, dt)
    moving = late and any_wide(shapes)
    if moving:
        extra = vec3.add(extra, drawn_after(shapes, active, vec3.sub(center, position)))
    cause = one.cause
    if cause == CAUSE_NONE and touches:
        cause = float(CAUSE_TOUCH)
    after = FingerState(
        started=1.0,
        probe=probe,
        mode=mode,
        center=center,
        patches=(one.after, two.after, three.after),
        rolled=rolled,
        stuck=stuck + 1.0 if late and center == before else 0.0,
        effects=states,
    )
    budget = float(UNSEARCHED) if unknown != 0.0 or (late and left < 0) else 0.0
    if moving and budget == 0.0:
        budget = float(ON_ITS_WAY)
    to_fingertip = rotations.conjugate(probe.orientation)
    inward = rotations.rotate(to_fingertip, normal)
    contact = Contact(
        mode=mode,
        object=number_of(shapes, active.first),
        cause=cause,
        velocity=probe.velocity,
        center=shown,
        penetration=vec3.dot(vec3.sub(shown, position), normal),
        point=point_under(finger.form, radius, probe.orientation, shown, normal),
        normal=normal,
        finger_point=point_on(finger.form, radius, inward),
        rolled=rolled,
        spin=one.spin,
        normal_force=vec3.norm(pressing),
        tangential_force=vec3.norm(tangential),
        force=vec3.add(vec3.add(pressing, tangential), extra),
        torque=vec3.add(vec3.add(one.torque, two.torque), three.torque),
        torsion=one.torsion,
        patch_radius=one.radius,
        patch_normal=inward,
        patch_stretch=rotations.rotate(to_fingertip, vec3.reject(one.after.deflection, normal)),
        patches=(
            outcome_of(shapes, one, finger, probe.orientation, shown),
            outcome_of(shapes, two, finger, probe.orientation, shown),
            outcome_of(shapes, three, finger, probe.orientation, shown),
        ),
        budget=budget,
    )
    return after, contact


@jit
def filter_velocity(state: FingerState, position: Vec3, dt: float, time_constant: float) -> Vec3:
    """Probe velocity (3,) m/s: backward difference through a first-order low-pass."""
    if state.started == 0.0 or dt <= 0.0:
        return state.probe.velocity
    gain = 1.0 / (time_constant + dt)
    moved = vec3.sub(position, state.probe.position)
    return vec3.faded(vec3.add_scaled(vec3.scale(time_constant * gain, state.probe.velocity), gain, moved))


@jit
def out_of_contact(
    scene: Scene, finger: Finger, objects: Any, state: FingerState, probe: Probe, dt: float, left: int
) -> tuple[FingerState, Contact]:
    """State and outcome in free space; or, with less than 0 `left` of the budget, at a first pose of which that is not
    known yet: the next tick's is the first again."""
    up, free = (0.0, 0.0, 1.0), float(FREE)
    force, states, unknown = all_effects(
        scene, finger.radius, objects, state, one_constraint(NONE, up), probe, probe.velocity, dt
    )  # fmt: skip
    after = FingerState(
        started=1.0 if left >= 0 else state.started,
        probe=probe,
        mode=free,
        center=probe.position,
        patches=same_for(state.patches, NO_PATCH),
        rolled=0.0,
        stuck=0.0,
        effects=states,
    )
    return after, no_contact(state, probe, force, 1.0 if left < 0 else unknown)


@jit
def no_contact(state: FingerState, probe: Probe, force: Vec3, unsearched: float) -> Contact:
    """The outcome in free space; leaving a contact is a release, or a new start where the proxy was stuck in it."""
    zero, cause = (0.0, 0.0, 0.0), float(CAUSE_NONE)
    if state.mode != FREE:
        cause = float(CAUSE_RESTART) if state.stuck >= STUCK_TICKS else float(CAUSE_RELEASE)
    return Contact(
        mode=float(FREE),
        object=-1.0,
        cause=cause,
        velocity=probe.velocity,
        center=probe.position,
        penetration=0.0,
        point=zero,
        normal=zero,
        finger_point=zero,
        rolled=0.0,
        spin=0.0,
        normal_force=0.0,
        tangential_force=0.0,
        force=force,
        torque=zero,
        torsion=0.0,
        patch_radius=0.0,
        patch_normal=zero,
        patch_stretch=zero,
        patches=same_for(state.patches, NO_PATCH_CONTACT),
        budget=unsearched,
    )


@jit
def all_effects(
    scene: Scene,
    radius: float,
    objects: Any,
    state: FingerState,
    active: Constraints,
    probe: Probe,
    against: Vec3,
    dt: float,
) -> tuple[Vec3, Any, float]:
    """Force of the workspace's and the objects' effects, their states, and 1 where the gap to an object is not known,
    because the search for its nearest point did not end; else 0."""
    up, in_contact = (0.0, 0.0, 1.0), 0.0 if active.first < 0.0 else 1.0
    around = Situation(
        position=probe.position, velocity=probe.velocity, dt=dt, touched=in_contact, gap=0.0, normal=up, carrier=None
    )  # fmt: skip
    force, states = apply_effects(scene.effects, state.effects[0], around)
    contact = Situation(
        position=probe.position, velocity=against, dt=dt, touched=0.0, gap=0.0, normal=up, carrier=None
    )  # fmt: skip
    touched = Touched(
        number_of(objects, active.first), number_of(objects, active.second), number_of(objects, active.third),
        active.n1, active.n2, active.n3,
    )  # fmt: skip
    more, states_of_objects, unknown = apply_objects_effects(objects, state.effects[1], radius, touched, contact)
    return vec3.add(force, more), (states, states_of_objects), unknown
