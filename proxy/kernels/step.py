"""Contact step: forces and torques of one tick from the poses of the probes, in the order of the equations.

`step` is called by the tick of the servo loop and of `simulate`, and by the engine of the Python interface.
"""

from typing import Any

from softfinger.proxy.kernels.contact.approach import STUCK_TICKS
from softfinger.proxy.kernels.contact.contact_friction import (
    apply_friction,
    compute_load,
    find_ground,
    find_textured_ground,
)
from softfinger.proxy.kernels.contact.continuation import detect_or_continue
from softfinger.proxy.kernels.contact.detection import is_clear
from softfinger.proxy.kernels.contact.effects import sum_effects
from softfinger.proxy.kernels.contact.fingertip import minkowski_objects
from softfinger.proxy.kernels.contact.one_contact import land_on_one, make_outcome_of_one
from softfinger.proxy.kernels.contact.outcome import end_contact_tick, make_free_contact, make_free_state
from softfinger.proxy.kernels.contact.rest.active_set import make_single_constraint
from softfinger.proxy.kernels.contact.several_contacts import (
    apply_friction_of_contact,
    continue_or_detect_several,
    land_among_several,
    make_no_approach,
)
from softfinger.proxy.kernels.contact.several_outcome import make_outcome_of_several
from softfinger.proxy.kernels.contact.several_rest import settle_after_friction
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.dispatch import by_type
from softfinger.proxy.kernels.jit.outlined import outlined_where
from softfinger.proxy.kernels.jit.tuples import map_each, unzip
from softfinger.proxy.kernels.model import (
    NONE,
    Contact,
    FacetedSearch,
    Finger,
    FingerState,
    Many,
    Pose,
    Probe,
    ProbeMotion,
    Scene,
    State,
    Vec3,
)
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.kernels.query.bodies import NO_FAULT, SUBSTEPS, has_fault, push_bodies, step_bodies
from softfinger.proxy.kernels.query.kinds import has_simulated_object
from softfinger.proxy.kernels.query.objects import choose_search
from softfinger.proxy.kernels.query.world import advance, place_all, strip_materials
from softfinger.proxy.kernels.shapes.budget import BUDGET


@by_type
def step_once(elastic: Any, scene: Scene, state: State, poses: Any, dt: float) -> Any:
    """Compute one contact step of all fingers, with all objects at their new poses; `elastic` is that of the scene."""


@step_once.of(None)
def step_on_rigid(elastic: None, scene: Scene, state: State, poses: Any, dt: float) -> Any:
    world = advance(scene.objects, state.world, dt)
    objects = place_all(scene.objects, world)
    fingers, contacts = unzip(map_each(step_finger, (scene.fingers, state.fingers, poses), scene, objects, dt))
    return State(world=world, fingers=fingers), contacts


@jit
def step(scene: Scene, state: State, poses: Any, dt: float) -> Any:
    """Advance the world and all fingers by one tick, and apply the reaction of each contact to the touched body.

    scene     Scene   model and parameters
    state     State   state after the last tick
    poses             a Pose for each finger: probe position, m, and orientation, unit quaternion, fingertip to world
    dt        s       time since the last tick; 0 freezes velocity and damping
    returns           State, and a tuple of a Contact for each finger

    A tick with bodies has substeps of equal length; the fingers move on a straight path from their last poses to these.
    While the bodies have a fault, nothing is touched: their poses are unknown.
    """
    if scene.bodies is None:
        return step_once(scene.elastic, scene, state, poses, dt)
    bodies, start = scene.bodies, state.fingers
    if not has_fault(bodies):
        count = bodies.block[SUBSTEPS]
        for i in range(count):
            if i == 0 or step_bodies(bodies) == NO_FAULT:
                substep_poses = map_each(interpolate_pose, (start, poses), (i + 1.0) / count)
                state, contacts = step_once(scene.elastic, scene, state, substep_poses, dt / count)
                push_bodies(bodies, contacts, state.fingers)
    if has_fault(bodies):
        fingers, contacts = unzip(map_each(release_finger, (scene.fingers, start, poses), dt))
        state = State(world=state.world, fingers=fingers)
    return state, contacts


@jit
def release_finger(finger: Finger, state: FingerState, pose: Pose, dt: float) -> tuple[FingerState, Contact]:
    """Return FingerState and Contact of a finger without contact and without effects."""
    velocity = filter_velocity(finger, state, pose.position, dt)
    probe = Probe(pose.position, pose.orientation, velocity)
    return make_free_state(state, probe, state.effects, True), make_free_contact(state, probe, (0.0, 0.0, 0.0), 0.0)


@jit
def interpolate_pose(state: FingerState, pose: Pose, share: float) -> Pose:
    """Return the pose at the fraction `share` of the path from the last pose to the given one.

    Before its first pose, a finger is at the given pose.
    """
    probe = state.probe
    if share == 1.0 or state.started == 0.0:
        return pose
    path = vec3.sub(pose.position, probe.position)
    turn = rotations.log(rotations.relative(pose.orientation, probe.orientation))
    orientation = rotations.multiply(rotations.exp(vec3.scale(share, turn)), probe.orientation)
    return Pose(vec3.add_scaled(probe.position, share, path), orientation)


@outlined_where(has_simulated_object)
def step_finger(
    finger: Finger, state: FingerState, pose: Pose, scene: Scene, objects: Any, dt: float
) -> tuple[FingerState, Contact]:
    """Compute the contact of one finger in the advanced world; `objects` is the result of `place_all`."""
    velocity = filter_velocity(finger, state, pose.position, dt)
    motion = ProbeMotion(Probe(pose.position, pose.orientation, velocity), state.probe, dt)
    start = pose.position if state.started == 0.0 else state.center
    obstacles = choose_search(finger.radius, minkowski_objects(finger, objects, pose.orientation), start, pose.position)
    if isinstance(objects, Many) or isinstance(objects.search, FacetedSearch):
        return step_with_several_objects(scene, finger, obstacles, state, motion)
    return step_with_one_object(scene, finger, obstacles, state, motion)


@jit
def filter_velocity(finger: Finger, state: FingerState, position: Vec3, dt: float) -> Vec3:
    """Return the probe velocity (3,) m/s: the backward difference, filtered by a first-order low-pass."""
    if state.started == 0.0 or dt <= 0.0:
        return state.probe.velocity
    time_constant = finger.velocity_time_constant
    gain = 1.0 / (time_constant + dt)
    displacement = vec3.sub(position, state.probe.position)
    return vec3.add_scaled(vec3.scale_and_flush(time_constant * gain, state.probe.velocity), gain, displacement)


@jit
def step_with_one_object(
    scene: Scene, finger: Finger, objects: Any, state: FingerState, motion: ProbeMotion
) -> tuple[FingerState, Contact]:
    """Compute the contact in a scene of one object that is not a mesh: its proxy follows the slip on that object."""
    shapes, probe = strip_materials(objects), motion.probe
    if state.stuck_ticks >= STUCK_TICKS and is_clear(shapes, finger.radius, probe.position):
        return step_without_contact(scene, finger, objects, state, motion, BUDGET)
    state, approach = detect_or_continue(scene, finger, shapes, state, probe, motion.dt)
    if approach.active[0].object_index < 0.0:
        return step_without_contact(scene, finger, objects, state, motion, BUDGET)
    ground = find_textured_ground(objects, 0.0, approach.active, approach.center)
    forces = apply_friction(finger, objects, ground, approach.predicted[0], motion)
    landing = land_on_one(finger, shapes, approach, forces, probe.position)
    load = compute_load(finger, objects, ground, landing.active[0], motion, approach.is_new)
    effects = sum_effects(scene, finger, objects, state, landing.active, motion)
    outcome = make_outcome_of_one(finger, ground, probe, approach, forces, landing, load)
    return end_contact_tick(finger, probe, approach, forces.result.cause, outcome, effects)


@jit
def step_with_several_objects(
    scene: Scene, finger: Finger, objects: Any, state: FingerState, motion: ProbeMotion
) -> tuple[FingerState, Contact]:
    shapes, probe, approach = strip_materials(objects), motion.probe, make_no_approach(motion.probe)
    if state.stuck_ticks < STUCK_TICKS or not is_clear(shapes, finger.radius, probe.position):
        state, approach = continue_or_detect_several(scene, finger, objects, shapes, state, motion)
    if approach.active[0].object_index < 0.0:
        return step_without_contact(scene, finger, objects, state, motion, approach.budget)
    forces = map_each(apply_friction_of_contact, (approach.predicted,), finger, objects, approach, motion)
    landing, is_single = land_among_several(finger, shapes, approach, forces[0], probe.position)
    active = landing.active
    if not is_single:
        settled = settle_after_friction(finger, objects, shapes, approach, forces, probe.position)
        active = settled.active
    effects = sum_effects(scene, finger, objects, state, active, motion)
    if is_single:
        ground = find_ground(objects, active[0].object_index)
        load = compute_load(finger, objects, ground, active[0], motion, approach.is_new)
        outcome = make_outcome_of_one(finger, ground, probe, approach, forces[0], landing, load)
    else:
        outcome = make_outcome_of_several(finger, objects, shapes, motion, approach, forces, settled)
    return end_contact_tick(finger, probe, approach, forces[0].result.cause, outcome, effects)


@jit
def step_without_contact(
    scene: Scene, finger: Finger, objects: Any, state: FingerState, motion: ProbeMotion, budget: int
) -> tuple[FingerState, Contact]:
    """Return state and Contact in free space, or at a first pose with an incomplete search (`budget` below 0)."""
    active = make_single_constraint(NONE, (0.0, 0.0, 1.0), 0.0)
    effects = sum_effects(scene, finger, objects, state, active, motion)
    unsearched = 1.0 if budget < 0 else effects.unknown
    return (
        make_free_state(state, motion.probe, effects.states, budget >= 0),
        make_free_contact(state, motion.probe, effects.force, unsearched),
    )
