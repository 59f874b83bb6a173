"""Contacts of a finger in a scene of several objects: continuation, friction, and contact with a single object.

Friction is computed first, separately for each contact. Then the proxy moves to its rest position on all objects,
and deflections are transferred from contacts that lose load to contacts that gain it (`several_rest`). A finger that
touches one object, and is clear of all other objects, is treated as in a scene of that object only.
"""

from typing import Any

from softfinger.proxy.kernels.contact.approach import NO_PREDICTION, Approach, has_ended, release_contacts
from softfinger.proxy.kernels.contact.contact_friction import (
    ContactForces,
    Prediction,
    apply_friction,
    find_textured_ground,
)
from softfinger.proxy.kernels.contact.continuation import continue_contact
from softfinger.proxy.kernels.contact.detection import detect_contact
from softfinger.proxy.kernels.contact.one_contact import Landing, does_move
from softfinger.proxy.kernels.contact.prediction import continue_several
from softfinger.proxy.kernels.contact.rest.active_set import make_single_constraint
from softfinger.proxy.kernels.contact.rest.cutting_planes import REST_STEP
from softfinger.proxy.kernels.contact.rest.facets import slide_over_facets
from softfinger.proxy.kernels.contact.rest.one_object import settle_on_one
from softfinger.proxy.kernels.contact.rest.projection import is_safe_step
from softfinger.proxy.kernels.friction.contact_patch import NO_PATCH
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.outlined import outlined
from softfinger.proxy.kernels.model import (
    NONE,
    ActiveSet,
    Finger,
    FingerState,
    FrictionResult,
    Probe,
    ProbeMotion,
    Scene,
    SmoothSearch,
    Vec3,
)
from softfinger.proxy.kernels.model.vectors import ZERO
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.query.carry import has_moving_object
from softfinger.proxy.kernels.query.kinds import has_creases_near, is_mesh_at, is_smooth_at
from softfinger.proxy.kernels.query.objects import find_closest_within, find_deepest_of_others
from softfinger.proxy.kernels.query.sweep import find_first_hit
from softfinger.proxy.kernels.shapes.budget import BUDGET, INSIDE_TOLERANCE
from softfinger.proxy.kernels.shapes.protocol import compute_direction
from softfinger.proxy.record import CAUSE_NONE, FREE

NO_FORCES = ContactForces(
    result=FrictionResult(
        mode=float(FREE), cause=float(CAUSE_NONE), deflection=ZERO, rolled_part=ZERO, slip_speed=0.0,
        slip_deflection=0.0, spin=0.0, spin_slip_speed=0.0, spin_slip_angle=0.0, force=ZERO, moment=0.0,
    ),
    patch=NO_PATCH, unit=1.0, load=0.0, bend=ZERO, bending=ZERO,
)  # fmt: skip
"""Forces of an unused contact."""


SEAM_DISTANCE = 1e-3
"""Distance, as a share of the radius, within which a proxy that moves towards an edge is about to cross it."""


@jit
def is_single(state: FingerState, radius: float) -> bool:
    """Return True if the proxy is at rest on one object, and displaced from the probe by that contact only."""
    one, two, _ = state.contacts
    if two.object_index >= 0.0:
        return False
    displacement = vec3.sub(vec3.sub(state.center, state.probe.position), one.deflection)
    residual = vec3.add_scaled(displacement, -one.push, one.normal)
    return vec3.dot(residual, residual) <= (10.0 * REST_STEP * radius) ** 2


@jit
def make_no_approach(probe: Probe) -> Approach:
    """Return an Approach without a contact."""
    return Approach(
        start=probe.position, clear_center=probe.position, center=probe.position,
        active=make_single_constraint(NONE, (0.0, 0.0, 1.0), 0.0),
        predicted=(NO_PREDICTION, NO_PREDICTION, NO_PREDICTION),
        rolled=0.0, center_lacks_roll=False, is_single=True, is_new=False,
        budget_exhausted=0.0, budget=BUDGET, stuck_ticks=0.0,
    )  # fmt: skip


@outlined
def is_clear_of_others(
    objects: Any, radius: float, start: Vec3, center: Vec3, before: Vec3, index: float, budget: int
) -> bool:
    """Return True if the proxy hits no object except `index` on its path from `start` to `center` (3,) m.

    before  (3,) m  position from which it moved, if an object flush with `index` counts, too; otherwise `center`

    The same object twice is one: it does not obstruct the proxy.
    """
    own_gap = radius
    if is_smooth_at(objects, index):  # a touch over the probe may be inside, by the curvature
        own_gap, _, _, _ = find_closest_within(objects, index, center, budget)
    if start != center or has_moving_object(objects):
        skip = (index, -1.0, -1.0)
        hit, _, budget = find_first_hit(objects, start, center, min(radius, own_gap), True, skip, budget)
        if hit >= 0.0:
            return False
    gap, _, budget = find_deepest_of_others(objects, center, radius * (1.0 + INSIDE_TOLERANCE), index, budget)
    if budget < 0 or gap < min(radius, own_gap) - INSIDE_TOLERANCE * radius:
        return False
    is_touching = gap < radius * (1.0 + INSIDE_TOLERANCE) and before != center
    return not is_touching or not crosses_seam(objects, radius, before, center, index, budget)


@jit
def crosses_seam(objects: Any, radius: float, before: Vec3, center: Vec3, index: float, budget: int) -> bool:
    """Return True if another object is closer than object `index` a little further on the path to `center` (3,) m.

    The proxy is then at the edge of the first of two flush objects, or beyond it.
    """
    _, heading = compute_direction(vec3.sub(center, before), ZERO)
    further = vec3.add_scaled(center, SEAM_DISTANCE * radius, heading)
    own_gap, _, _, _ = find_closest_within(objects, index, further, budget)
    gap, _, budget = find_deepest_of_others(objects, further, own_gap, index, budget)
    return budget < 0 or gap < own_gap - INSIDE_TOLERANCE * radius


@jit
def continue_or_detect_several(
    scene: Scene, finger: Finger, objects: Any, shapes: Any, state: FingerState, motion: ProbeMotion
) -> tuple[FingerState, Approach]:
    """Continue the contacts; if all are released, detect a new one in the same tick.

    The returned state does not include released contacts.
    """
    if state.mode != FREE:
        single = is_single(state, finger.radius)
        approach = make_no_approach(motion.probe)
        if single:
            index = state.contacts[0].object_index
            approach = continue_contact(scene, finger, shapes, index, state, motion.probe, motion.dt)
            if approach.center != approach.clear_center:
                # Past a seam it rolls on the next object. Facets that share an edge are both touched there, and form
                # one surface.
                index, center = approach.active[0].object_index, approach.center
                before = center if is_mesh_at(shapes, index) else approach.clear_center
                single = is_clear_of_others(shapes, finger.radius, center, center, before, index, approach.budget)
        if not single:
            approach = continue_several(scene, objects, shapes, finger.radius, state, motion)
        if not has_ended(approach.active):
            return state, approach
    state = release_contacts(state)
    return state, detect_contact(finger, shapes, state, motion.probe)


@jit
def apply_friction_of_contact(
    predicted: Prediction, finger: Finger, objects: Any, approach: Approach, motion: ProbeMotion
) -> ContactForces:
    """Compute the friction of one of several contacts."""
    contact = predicted.contact
    if contact.object_index < 0.0 or contact.share <= 0.0:
        return NO_FORCES
    ground = find_textured_ground(objects, contact.object_index, approach.active, approach.center)
    return apply_friction(finger, objects, ground, predicted, motion)


@jit
def follow_slip(
    objects: Any, index: float, radius: float, position: Vec3, center: Vec3, deflection: Vec3, normal: Vec3
) -> tuple[Vec3, ActiveSet, float, bool]:
    """Move the proxy by a slip (`settle_on_one`, on a mesh `slide_over_facets`). Also return True if it is at rest."""
    if not isinstance(objects.search, SmoothSearch) and not has_creases_near(objects) and is_mesh_at(objects, index):
        center, active, at_rest = slide_over_facets(objects, index, radius, position, center, deflection, normal)
        return center, active, 0.0, at_rest
    center, active, budget_exhausted = settle_on_one(objects, index, radius, position, center, deflection, normal)
    return center, active, budget_exhausted, True


@jit
def land_among_several(
    finger: Finger, objects: Any, approach: Approach, forces: ContactForces, position: Vec3
) -> tuple[Landing, bool]:
    """Return the proxy of the only contact after friction, and True if it is clear of all other objects."""
    center, active, budget_exhausted, at_rest = approach.center, approach.active, 0.0, True
    constraint, radius = active[0], finger.radius
    if not approach.is_single:
        return Landing(center, active, budget_exhausted), False
    if does_move(approach, forces):
        center, active, budget_exhausted, at_rest = follow_slip(
            objects, constraint.object_index, radius, position, center, forces.result.deflection, constraint.normal
        )
    if not at_rest or (
        is_mesh_at(objects, constraint.object_index) and not is_safe_step(approach.clear_center, center, radius)
    ):
        return Landing(center, active, budget_exhausted), False
    # A first touch may be over the second of two flush objects, beyond the edge of the one that was hit.
    before = approach.clear_center if approach.is_new else center
    clear = is_clear_of_others(objects, radius, approach.start, center, before, active[0].object_index, approach.budget)
    return Landing(center, active, budget_exhausted), clear
