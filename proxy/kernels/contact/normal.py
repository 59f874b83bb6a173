"""Normal force f_N of one object as a function of depth and speed.

    compute_normal_force(law, depth, speed) -> N

`depth` delta, m, is the distance of the probe behind the proxy along the normal. `speed` v, m/s, is that of the probe
along the normal, positive when it moves out. f_N is 0 at depth 0, so it does not jump at a touch, and is never
negative: a contact does not pull.
"""

from typing import Any

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import HuntCrossley, LinearNormal


@jit
def compute_normal_force(law: Any, depth: float, speed: float) -> float:
    """Return the force of spring and damper.

    HuntCrossley: k delta^p (1 - c v), clamped to 0 when the probe moves out faster than 1 / c. Source: Hunt and
    Crossley (1975); c is their lambda / k.
    """
    elastic = compute_spring_force(law, depth)
    if isinstance(law, HuntCrossley):
        return max(bound_force(elastic, law.law.damping, speed) - law.damping * elastic * speed, 0.0)
    return bound_force(elastic, law.damping, speed)


@jit
def bound_force(elastic: float, damping: float, speed: float) -> float:
    """Return elastic - B v, at least 0 and at most 2 elastic: damping never pulls, and at most doubles the force."""
    return min(max(elastic - damping * speed, 0.0), max(2.0 * elastic, 0.0))


@jit
def compute_spring_force(law: Any, depth: float) -> float:
    """Return the elastic part of the normal force, N: the force at speed 0."""
    return compute_elastic_force(law.law if isinstance(law, HuntCrossley) else law, depth)


@jit
def compute_elastic_force(law: Any, depth: float) -> float:
    """Return k delta or, for PowerNormal, k delta^p (Hertz, 1882, p = 3/2; Xydas and Kao, 1999, for soft fingers)."""
    if isinstance(law, LinearNormal):
        return law.stiffness * depth
    power: float = law.coefficient * max(depth, 0.0) ** law.exponent
    return power
