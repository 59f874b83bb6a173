"""State machine of rolling and sliding exactly as in the paper, for study: docs/model/friction.md lists its failures.

    stick_slip_by_equations(law, torsion, coupling, k_tau, inputs) -> FrictionResult

The end of a contact is that of our contact model, not the paper's f_N = 0.
"""

from typing import Any

from softfinger.proxy.kernels.friction.torsion import wind_up
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Coupling, FrictionInput, FrictionResult, PaperFriction
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.record import CAUSE_DRAG, CAUSE_NONE, CAUSE_STOP, CAUSE_THETA_MAX, ROLLING, SLIDING

EQUALITY_TOLERANCE = 1e-9
"""Relative tolerance for rounding: the paper's equalities hold up to it."""


@jit
def stick_slip_by_equations(
    law: PaperFriction, torsion: Any, coupling: Coupling, torque_stiffness: float, inputs: FrictionInput
) -> FrictionResult:
    """Compute friction and torsion of one tick by the text of section 3.2.

    rolling to sliding   the tangential force of the hand, -K e, is outside the static cone and has the sign of the
                         displacement P produced by rolling since the start of rolling; or |P| / r > theta_max
    while sliding        exactly mu_d f_N, no spring-damper: e is scaled to it, down and up
    sliding to rolling   inside the kinetic cone and no tangential velocity

    `rolled_part` is P: the total roll, whether the hand has followed it or not.

    Source: Salvietti, Malvezzi, Prattichizzo (2013), section 3.2. The sign of a zero displacement is assumed to
    agree with any force, so that a finger that has never rolled can be dragged.
    """
    stiffness = coupling.stiffness
    static_limit, kinetic_limit = law.static * inputs.normal_force, law.kinetic * inputs.normal_force
    mode, cause = inputs.mode, float(CAUSE_NONE)
    deflection, rolled = inputs.deflection, inputs.rolled_part
    length = vec3.norm(deflection)
    change = vec3.sub(deflection, inputs.deflection_before)

    if mode == ROLLING:
        outside = stiffness * length >= static_limit and length > 0.0
        if outside and -vec3.dot(deflection, rolled) >= 0.0:
            mode, cause = float(SLIDING), float(CAUSE_DRAG)
        elif torque_stiffness * vec3.norm(rolled) > static_limit:
            mode, cause = float(SLIDING), float(CAUSE_THETA_MAX)
    elif (
        stiffness * length < (1.0 - EQUALITY_TOLERANCE) * kinetic_limit
        and vec3.norm(change) <= EQUALITY_TOLERANCE * length
    ):
        mode, cause = float(ROLLING), float(CAUSE_STOP)

    force = vec3.scale(stiffness, deflection)
    if mode == SLIDING:
        rolled = (0.0, 0.0, 0.0)
        if length > 0.0:
            deflection = vec3.scale(kinetic_limit / (stiffness * length), deflection)
        force = vec3.scale(stiffness, deflection)
    elif inputs.dt > 0.0:
        force = vec3.add_scaled(force, coupling.damping / inputs.dt, change)
    wind = wind_up(torsion, coupling.torsional_damping, inputs.spin, inputs.twist, inputs)
    return FrictionResult(
        mode=mode, cause=cause, deflection=deflection, rolled_part=rolled, slip_speed=0.0, slip_deflection=0.0,
        spin=wind.spin, spin_slip_speed=wind.slip_speed, spin_slip_angle=wind.slip_angle, force=force,
        moment=wind.moment,
    )  # fmt: skip
