"""What a contact brings into a tick: a first touch, or the old contact carried along and rolled."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels import rotations, vec3
from softfinger.proxy.kernels.bodies import closest_to, deepest, roll_on, transport_on
from softfinger.proxy.kernels.carry import carried_direction, carried_point, carry, turn_against
from softfinger.proxy.kernels.contacts import NONE, Held, displacement_by, find_others, hold_again, hold_by, pressed
from softfinger.proxy.kernels.dispatch import by_count
from softfinger.proxy.kernels.jit import jit
from softfinger.proxy.kernels.model import Quaternion, Scene, State, Vec3
from softfinger.proxy.kernels.sweep import first_hit
from softfinger.proxy.state import CAUSE_NONE, CAUSE_TOUCH, ROLLING


class Approach(NamedTuple):
    """The contact before friction has its say; `held.first` is -1 where there is none.

    deflection, before, rolled_part   (3,) m  e now, e at the last tick and p, tangent to all holding objects
    theta, twist                      rad     roll and spin of the fingertip against the object in this tick
    against                           m/s     probe velocity against the object
    """

    mode: float
    cause: float
    center: Vec3
    held: Held
    deflection: Vec3
    before: Vec3
    rolled_part: Vec3
    theta: float
    twist: float
    against: Vec3


@by_count
def start_of(objects: Any, position: Vec3, met: Vec3, held: Held) -> Any:
    """Where the proxy (3,) m of a contact begins that was met at `met`."""


@start_of.of(1)
def start_over_the_probe(objects: Any, position: Vec3, met: Vec3, held: Held) -> Vec3:
    return vec3.add(position, displacement_by(objects, held))


@start_of.of(2)
def start_where_it_met(objects: Any, position: Vec3, met: Vec3, held: Held) -> Vec3:
    """Over the probe there may be another object: `settle` finds its way there."""
    return met


@jit
def touch(scene: Scene, objects: Any, state: State, position: Vec3, velocity: Vec3) -> Approach:
    """First contact on the way from the last probe position to this one.

    The whole way is swept, so a thin object is not jumped over. The first pose of all has no way: it is in
    contact where it stands inside.
    """
    radius, zero = scene.radius, (0.0, 0.0, 0.0)
    if state.started == 0.0:
        gap, index = deepest(objects, position)
        met = position
        if gap >= radius:
            index = NONE
    else:
        share, index = first_hit(objects, state.position, position, radius, (NONE, NONE, NONE))
        met = vec3.add_scaled(state.position, share, vec3.sub(position, state.position))
    held, center = hold_by(NONE, (0.0, 0.0, 1.0)), position
    if index >= 0.0:
        _, point, normal = closest_to(objects, index, met)
        center = vec3.add_scaled(point, radius, normal)
        held = pressed(hold_by(index, normal), vec3.sub(center, position))
        center = start_of(objects, position, center, held)
    return Approach(
        float(ROLLING), float(CAUSE_TOUCH), center, held, zero, zero, zero, 0.0, 0.0, velocity
    )  # fmt: skip


@jit
def stay(
    scene: Scene, objects: Any, state: State, position: Vec3, orientation: Quaternion, velocity: Vec3, dt: float
) -> Approach:
    """The contact goes with its object and rolls by what the fingertip turned against it."""
    radius, against = scene.radius, velocity
    index = hold_again(objects, state, state.normal).first
    carried = carry(objects, index, state.object)
    old_normal, moved = carried_direction(carried, state.normal), carried_point(carried, state.center)
    if dt > 0.0:
        against = vec3.add_scaled(velocity, -1.0 / dt, vec3.sub(moved, state.center))
    turn = turn_against(carried, rotations.relative(orientation, state.orientation))
    rolled = roll_on(scene.rolling, objects, index, radius, moved, old_normal, turn)
    center, normal = rolled.center, rolled.normal
    rolled_part = transport_on(objects, index, carried_direction(carried, state.rolled_part), old_normal, normal)
    before = transport_on(objects, index, carried_direction(carried, state.deflection), old_normal, normal)
    behind = vec3.sub(center, position)
    held = pressed(find_others(objects, radius, center, hold_again(objects, state, normal)), behind)
    deflection = vec3.sub(behind, displacement_by(objects, held))
    return Approach(
        state.mode, float(CAUSE_NONE), center, held, deflection, before, vec3.add(rolled_part, rolled.motion),
        rolled.theta, rolled.spin, against,
    )  # fmt: skip


@jit
def has_ended(objects: Any, radius: float, position: Vec3, held: Held) -> bool:
    """Whether nothing pushes and the probe is outside of everything.

    Both are asked: a probe that has popped through a thin body is outside and still held, and one that damping
    has freed of its force is still inside.
    """
    if held.first < 0.0:
        return True
    if held.push.first > 0.0 or held.push.second > 0.0 or held.push.third > 0.0:
        return False
    gap, _ = deepest(objects, position)
    return gap >= radius
