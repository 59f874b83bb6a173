"""Time-domain passivity: an observer of the energy that the rendering generates, and a damper that dissipates it.

The commanded wrench is constant while the hand moves, so the work of a tick is minus that force times the displacement
of the handle, minus that torque times its rotation; this is exact for a rotation about one axis. Negative work is
energy that the sampled contact has generated. The controller dissipates it with a damper until none remains, also after
the release. The damper is always a force, because few devices display a torque. Work taken during a contact is
discarded when the contact ends: losses to friction must not offset energy of the next wall.

Source: Hannaford, Ryu (2002), Time-domain passivity control of haptic interfaces, with the work taken over the held
force as in Ryu, Preusche, Hannaford, Hirzinger (2005), Time domain passivity control with reference energy following.
"""

from typing import Any, Final, NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Pose, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.rotations import log, relative, rotate
from softfinger.proxy.record import FREE
from softfinger.server.loop.guard import GuardState


class Passivity(NamedTuple):
    """Largest damping that may be added, N s/m; 0 only observes."""

    damping_max: float


class Energy(NamedTuple):
    """Work (J) taken from the hand, negative if energy was generated, and the damping (N s/m) that dissipates it."""

    work: float
    damping: float


NO_ENERGY: Final = Energy(0.0, 0.0)


class HandMotion(NamedTuple):
    """Poses of the fingertip at two successive ticks, and its tool or None."""

    before: Pose
    now: Pose
    tool: Any


@jit
def handle_at(tool: Any, tip: Pose) -> Vec3:
    """Return the position (3,) m of the handle."""
    if tool is None:
        return tip.position
    return vec3.sub(tip.position, rotate(tip.orientation, tool.lever))


@jit
def compute_work_on_hand(wrench: GuardState, motion: HandMotion) -> float:
    """Return the work (J) of a constant wrench on the handle over a motion."""
    displacement = vec3.sub(handle_at(motion.tool, motion.now), handle_at(motion.tool, motion.before))
    turn = log(relative(motion.now.orientation, motion.before.orientation))
    return vec3.dot(wrench.force, displacement) + vec3.dot(wrench.torque, turn)


@jit
def keep_passive(
    passivity: Any, energy: Energy, wrench: GuardState, motion: HandMotion, mode: float, force: Vec3, dt: float
) -> tuple[Energy, Vec3]:
    """Return the force with the damping that makes the rendering passive.

    A damper alpha v dissipates alpha v^2 T in the next tick at constant v, so alpha = -E / (v^2 T).

    energy          Energy      state after the last tick
    wrench          GuardState  wrench on the handle commanded since then, after the guard
    motion          HandMotion  of the hand under that wrench
    mode                        contact mode now
    force   (3,)    N           from the contact step
    dt              s           time since the last tick
    returns         Energy, force (3,) N
    """
    if passivity is None:
        return energy, force
    work = energy.work - compute_work_on_hand(wrench, motion)
    if mode == FREE:
        work = min(work, 0.0)
    if not work < 0.0 or not dt > 0.0 or not passivity.damping_max > 0.0:
        return Energy(work, 0.0), force
    displacement = vec3.sub(motion.now.position, motion.before.position)
    damping, square = passivity.damping_max, vec3.dot(displacement, displacement)
    if -work * dt < damping * square:
        damping = -work * dt / square
    return Energy(work, damping), vec3.add_scaled(force, -damping / dt, displacement)
