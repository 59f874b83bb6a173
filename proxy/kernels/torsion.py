"""Spin moment of a soft finger: a torsional spring whose anchor slips at the torsional limit."""

from typing import Any

from softfinger.proxy.kernels.dispatch import by_type
from softfinger.proxy.kernels.model import Torsion


@by_type
def wind(torsion: Any, spin: float, turn: float, normal_force: float) -> Any: ...


@wind.of(None)
def no_torsion(torsion: None, spin: float, turn: float, normal_force: float) -> tuple[float, float]:
    return 0.0, 0.0


@wind.of(Torsion)
def wind_linear(torsion: Torsion, spin: float, turn: float, normal_force: float) -> tuple[float, float]:
    """New wind-up phi (rad) and moment about the normal on the hand (N m) after a twist of `turn` rad.

    tau_n = k_z phi, |tau_n| <= mu_t f_N. Source: Salvietti et al. (2013), eq. 1; the paper has no limit.
    """
    limit = torsion.friction_length * normal_force / torsion.stiffness
    wound = min(max(spin + turn, -limit), limit)
    return wound, -torsion.stiffness * wound
