"""A tick of contact among several objects: the proxy comes to rest first, then each contact has its own friction."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.contacts import (
    Motion,
    carried_contacts,
    displaced_by_friction,
    displaced_by_turning_objects,
    farther_than_probe,
    levers_of,
    warm_start,
)
from softfinger.proxy.kernels.contact.detection import detect_among_several, has_ended, separated
from softfinger.proxy.kernels.contact.effects import effects_of_tick
from softfinger.proxy.kernels.contact.hand_over import hand_over
from softfinger.proxy.kernels.contact.outcome import Outcome
from softfinger.proxy.kernels.contact.rest.active_set import INSIDE, active_objects, tangent_to_all
from softfinger.proxy.kernels.contact.rest.among import Rest, drawn_after
from softfinger.proxy.kernels.contact.texture import with_texture_friction
from softfinger.proxy.kernels.contact.wrench import Wrench, outcome_of, wrench_of
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import ActiveSet, Finger, FingerState, Probe, Scene, Vec3
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.kernels.query.kinds import any_multipoint
from softfinger.proxy.kernels.query.objects import closest_to_within, deepest, number_of
from softfinger.proxy.kernels.shapes.budget import BUDGET
from softfinger.proxy.record import CAUSE_NONE, CAUSE_TOUCH, FREE, ON_ITS_WAY, UNSEARCHED


class Candidates(NamedTuple):
    """What may hold the proxy in this tick.

    start, center   (3,) m   where its way begins, and where it is
    active                   the constraints
    budget                   what is left of it
    began                    the contact begins in this tick
    state                    of the finger, without a contact that has ended
    before          (3,) m   the proxy of the last tick, carried along
    stuck                    ticks in a row before this one in which the proxy found no rest
    """

    start: Vec3
    center: Vec3
    active: ActiveSet
    budget: int
    began: bool
    state: FingerState
    before: Vec3
    stuck: float


@jit
def find_candidates(finger: Finger, shapes: Any, state: FingerState, position: Vec3) -> Candidates:
    """The contacts of the last tick carried along by their objects; where they have ended, a first touch."""
    before, stuck = state.center, state.stuck
    if state.mode != FREE:
        center, active = warm_start(shapes, finger.radius, state, position)
        if not has_ended(active):
            return Candidates(
                start=state.center, center=center, active=active, budget=BUDGET, began=False, state=state,
                before=center, stuck=stuck,
            )  # fmt: skip
        before = center
    # What is met in the tick in which the last contact ended is another one.
    state = separated(state)
    met = detect_among_several(finger, shapes, state, position)
    return Candidates(
        start=met.start, center=met.center, active=met.active, budget=met.budget, began=True, state=state,
        before=before, stuck=stuck,
    )  # fmt: skip


@jit
def motion_of(
    finger: Finger, state: FingerState, probe: Probe, last: Any, contacts: Any, levers: Any, began: bool, dt: float
) -> Motion:
    """What moves the contacts in this tick; `last` are those of the last tick, carried along."""
    way = displaced_by_friction(last, contacts)
    rode = displaced_by_turning_objects(state.contacts, last)
    return Motion(
        radius=finger.radius,
        form=finger.form,
        resolution=finger.position_resolution,
        dt=dt,
        probe=probe,
        last=state.probe,
        center=state.center,
        turn=rotations.relative(probe.orientation, state.probe.orientation),
        free=vec3.add(vec3.add(vec3.sub(probe.position, state.probe.position), way), rode),
        blocked=vec3.scale(-1.0, way),
        farther=farther_than_probe(last, contacts, levers),
        touches=began,
    )


@jit
def displaced_proxy(objects: Any, radius: float, center: Vec3, way: Vec3, known: Vec3, budget: int) -> Vec3:
    """The proxy (3,) m that friction keeps `way` (3,) m beside `center`: on what is nearest there, outside of all."""
    if way == (0.0, 0.0, 0.0):
        return center
    there = vec3.add(center, way)
    gap, at, budget = deepest(objects, there, radius, known, budget)
    if any_multipoint(objects):
        if gap >= radius * (1.0 - INSIDE):  # beside a convex edge it is a little above the surface
            return there
        if at < 0.0:
            return center
    _, point, normal, budget = closest_to_within(objects, at, there, budget)
    there = vec3.add_scaled(point, radius, normal)
    gap, _, _ = deepest(objects, there, radius, known, budget)
    return there if gap >= radius * (1.0 - INSIDE) else center


@jit
def lag_of(one: Wrench, two: Wrench, three: Wrench) -> Vec3:
    """How far (3,) m friction keeps the proxy beside its rest: the mean deflection, by the load shares."""
    lag = vec3.scale(one.after.share, one.after.deflection)
    lag = vec3.add_scaled(lag, two.after.share, two.after.deflection)
    return vec3.add_scaled(lag, three.after.share, three.after.deflection)


@jit
def outcome_among_several(
    scene: Scene,
    finger: Finger,
    objects: Any,
    shapes: Any,
    probe: Probe,
    candidates: Candidates,
    rest: Rest,
    dt: float,
) -> Outcome:
    """Friction, rolling and torsion of each contact, and the sum of their forces."""
    state, active, began = candidates.state, rest.active, candidates.began
    last = carried_contacts(shapes, state.contacts)
    held = hand_over(objects, last, active)
    levers = levers_of(shapes, held, finger.radius, rest.center)
    motion = motion_of(finger, state, probe, last, held, levers, began, dt)
    rough = with_texture_friction(objects, active, rest.center)
    one = wrench_of(scene.rolling, finger, rough, held[0], levers[0], motion)
    two = wrench_of(scene.rolling, finger, rough, held[1], levers[1], motion)
    three = wrench_of(scene.rolling, finger, rough, held[2], levers[2], motion)
    pressing = vec3.add(vec3.add(one.normal_force, two.normal_force), three.normal_force)
    way = tangent_to_all(active, lag_of(one, two, three))
    shown = displaced_proxy(shapes, finger.radius, rest.center, way, active_objects(active), rest.budget)
    effects = effects_of_tick(scene, finger, objects, state, active, probe, dt)
    extra, on_its_way = effects.force, rest.late and any_multipoint(shapes)
    if on_its_way:
        extra = vec3.add(extra, drawn_after(shapes, active, vec3.sub(rest.center, probe.position)))
    cause = float(CAUSE_TOUCH) if one.cause == CAUSE_NONE and began else one.cause
    stuck = candidates.stuck + 1.0 if rest.late and rest.center == candidates.before else 0.0
    unsearched = effects.unknown != 0.0 or (rest.late and rest.budget < 0)
    budget = float(UNSEARCHED) if unsearched else 0.0
    if on_its_way and not unsearched:
        budget = float(ON_ITS_WAY)
    return Outcome(
        mode=one.after.mode,
        cause=cause,
        object=number_of(shapes, active[0].body),
        normal=active[0].normal,
        center=rest.center,
        shown=shown,
        contacts=(one.after, two.after, three.after),
        reported=(
            outcome_of(shapes, one, finger, probe.orientation, shown),
            outcome_of(shapes, two, finger, probe.orientation, shown),
            outcome_of(shapes, three, finger, probe.orientation, shown),
        ),
        pressing=pressing,
        normal_force=vec3.norm(pressing),
        tangential=vec3.add(vec3.add(one.tangential_force, two.tangential_force), three.tangential_force),
        effects=extra,
        effect_states=effects.states,
        torque=vec3.add(vec3.add(one.torque, two.torque), three.torque),
        torsion=one.torsion,
        spin=one.spin,
        radius=one.radius,
        rolled=state.rolled + one.theta,
        stuck=stuck,
        budget=budget,
    )
