"""Normal force f_N of one object as a function of depth and speed.

    normal_force_of(law, depth, speed) -> N

`depth` delta, m, is the distance of the probe behind the proxy along the normal. `speed` v, m/s, is that of the probe
along the normal, positive when it moves out. f_N is 0 at depth 0, so it does not jump at a touch, and is never
negative: a contact does not pull.
"""

from typing import Any

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.dispatch import by_type
from softfinger.proxy.kernels.model import HuntCrossley, LinearNormal, PowerNormal


@by_type
def normal_force_of(law: Any, depth: float, speed: float) -> Any: ...


@by_type
def spring(law: Any, depth: float) -> Any:
    """Return the elastic part of the normal force, N: the force at speed 0."""


@jit
def bound_force(elastic: float, damping: float, speed: float) -> float:
    """Return elastic - B v, at least 0 and at most 2 elastic: damping never pulls, and at most doubles the force."""
    return min(max(elastic - damping * speed, 0.0), max(2.0 * elastic, 0.0))


@spring.of(LinearNormal)
def linear_spring(law: LinearNormal, depth: float) -> float:
    return law.stiffness * depth


@spring.of(PowerNormal)
def power_spring(law: PowerNormal, depth: float) -> float:
    """Return k delta^p (Hertz, 1882, p = 3/2; Xydas and Kao, 1999, for soft fingers)."""
    return law.coefficient * max(depth, 0.0) ** law.exponent


@spring.of(HuntCrossley)
def spring_under_damping(law: HuntCrossley, depth: float) -> float:
    return spring(law.law, depth)


@normal_force_of.of(LinearNormal, PowerNormal)
def normal_force_of_spring(law: Any, depth: float, speed: float) -> float:
    return bound_force(spring(law, depth), law.damping, speed)


@normal_force_of.of(HuntCrossley)
def normal_force_hunt_crossley(law: HuntCrossley, depth: float, speed: float) -> float:
    """Return k delta^p (1 - c v), clamped to 0 when the probe moves out faster than 1 / c.

    Source: Hunt and Crossley (1975); c is their lambda / k.
    """
    return max(normal_force_of(law.law, depth, speed) - law.damping * spring(law.law, depth) * speed, 0.0)
