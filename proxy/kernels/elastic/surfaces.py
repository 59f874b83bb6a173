"""Displaced surface under a fingertip: its expected displacement before a tick, its state and the contact after it."""

from math import pi
from typing import Any

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import replace
from softfinger.proxy.kernels.model import Contact, Finger, FingerState, Pose, Probe, Scene, Vec3
from softfinger.proxy.kernels.model.elastic import Elastic, Surface
from softfinger.proxy.kernels.model.vectors import ZERO
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.frames import turn_into, turn_out_of
from softfinger.proxy.record import FREE, LARGE_DISPLACEMENT, LARGE_ROTATION, LARGE_STRAIN, UNSOLVED

CORRECTION_ERROR_M = 1e-6
"""Error, m, below which the last round is a correction, too: it changes the force by 1 mN at 1000 N/m. A larger error
of the last round is reported as UNSOLVED."""
ROTATION_MAX_RAD = 10.0 * pi / 180.0
STRAIN_MAX = 0.1
"""Rotation and strain above which the linear solution is not valid."""


@jit
def shift_pose(body: Any, pose: Pose, surface: Vec3) -> Pose:
    """Return the pose relative to the displaced surface."""
    return Pose(vec3.sub(pose.position, turn_out_of(body.pose, surface)), pose.orientation)


@jit
def move_into_surface(body: Any, state: FingerState, surface: Vec3) -> FingerState:
    """Return the state of a finger with its probe relative to the displaced surface, where its contact is solved."""
    probe = state.probe
    moved = shift_pose(body, Pose(probe.position, probe.orientation), surface)
    return replace(state, "probe", Probe(moved.position, probe.orientation, probe.velocity))


@jit
def place_probe(state: FingerState, pose: Pose) -> FingerState:
    """Return the state of a finger with its probe in the world, where guard, passivity and record need it."""
    return replace(state, "probe", Probe(pose.position, pose.orientation, state.probe.velocity))


@jit
def compute_drive(body: Any, last: Surface, state: FingerState, pose: Pose, gain: float) -> tuple[Vec3, Vec3]:
    """Return the motion (3,) m of the probe in this tick, and the motion (3,) m that changes the displacement.

    The second is the first without the part of the last change that a damped surface repeats independently of the
    probe. Both are in the object frame.
    """
    motion = turn_into(body.pose, vec3.sub(pose.position, state.probe.position))
    return motion, vec3.add_scaled(motion, gain - 1.0, last.change)


@jit
def predict_displacement(last: Surface, change: Vec3, largest: float) -> Vec3:
    """Return the displacement (3,) m after an expected change, unless this exceeds `largest`, m, or is not a number."""
    return vec3.add(last.displacement, change) if vec3.norm(change) <= largest else last.displacement


@jit
def compute_gain(elastic: Elastic, dt: float) -> float:
    """Return the share of the new displacement that the surface reaches in a tick: 1 without damping."""
    if elastic.damping == 0.0:
        return 1.0
    return dt / (dt + elastic.damping)


@jit
def update_surface(
    scene: Scene, finger: Finger, last: Surface, displacement: Vec3, contact: Contact, measures: Any, dt: float
) -> Surface:
    """Return the displacement with its rate, filtered as the probe's velocity is, and the limits that are exceeded.

    measures  largest rotation, rad, and strain of the body, and squared error of the displacement, m^2
    """
    elastic, body, rate = scene.elastic, scene.objects.body, last.rate
    change = vec3.sub(displacement, last.displacement)
    if dt > 0.0:
        gain = 1.0 / (finger.velocity_time_constant + dt)
        rate = vec3.add_scaled(vec3.scale_and_flush(finger.velocity_time_constant * gain, last.rate), gain, change)
    nonlinear = 0.0
    if vec3.dot(displacement, displacement) > elastic.large * elastic.large:
        nonlinear += LARGE_DISPLACEMENT
    if measures[0] > ROTATION_MAX_RAD:
        nonlinear += LARGE_ROTATION
    if measures[1] > STRAIN_MAX:
        nonlinear += LARGE_STRAIN
    if not measures[2] <= CORRECTION_ERROR_M**2:  # also NaN
        nonlinear += UNSOLVED
    if contact.mode == FREE:
        return Surface(displacement, change, last.inverse, rate, ZERO, 0.0)
    return Surface(displacement, change, last.inverse, rate, turn_out_of(body.pose, displacement), nonlinear)


@jit
def report_surface(body: Any, contact: Contact, surface: Surface, slope: Vec3) -> Contact:
    """Return the contact at its place on the deformed surface, with the force `slope` (3,) N, object frame, added.

    slope  part of the force due to the slope of the deformed surface. A contact without friction conserves
           energy only with it. A contact with friction has none: it dissipates more than a slope below the coefficient
           of friction returns.
    """
    shift, rate = turn_out_of(body.pose, surface.displacement), turn_out_of(body.pose, surface.rate)
    if contact.mode == FREE:
        return replace(contact, "velocity", vec3.add(contact.velocity, rate), "center", vec3.add(contact.center, shift))
    force = turn_out_of(body.pose, slope)
    one, two, three = contact.contacts
    one = replace(one, "point", vec3.add(one.point, shift), "force", vec3.add(one.force, force))
    two = replace(two, "point", vec3.add(two.point, shift))
    three = replace(three, "point", vec3.add(three.point, shift))
    return replace(
        contact,
        "velocity", vec3.add(contact.velocity, rate),
        "center", vec3.add(contact.center, shift),
        "point", vec3.add(contact.point, shift),
        "force", vec3.add(contact.force, force),
        "contacts", (one, two, three),
    )  # fmt: skip
