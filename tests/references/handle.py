"""One axis of a handle with motor lag, hand and Coulomb friction, by a high-order integrator with events."""

from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

from references.rotation import Array


@dataclass(frozen=True)
class Handle:
    """Moving mass kg (handle and hand), damping and hand damping N s/m, stiffness N/m, friction N, lag s."""

    mass: float
    damping: float = 0.0
    friction: float = 0.0
    lag: float = 0.0
    hand_damping: float = 0.0
    stiffness: float = 0.0


def integrate(handle: Handle, period: float, commands: Array, goals: Array, x: float, v: float = 0.0) -> Array:
    """Return position and velocity (n + 1, 2) at the ticks, for commands (n,) N and goals (n + 1,) m."""
    a, out = 0.0, [(x, v)]
    for n, u in enumerate(commands):
        w = (goals[n + 1] - goals[n]) / period
        x, v, a = _tick(handle, period, u, goals[n], w, x, v, a)
        out.append((x, v))
    return np.array(out)


def _tick(
    h: Handle, period: float, u: float, p0: float, w: float, x: float, v: float, a: float
) -> tuple[float, float, float]:
    def motors(t: float, a: float) -> float:
        return u if h.lag == 0.0 else a

    def applied(t: float, x: float, a: float) -> float:
        """All but damping and friction."""
        return motors(t, a) + h.stiffness * (p0 + w * t - x) + h.hand_damping * w

    def rates(sense: float):
        def f(t: float, y: Array) -> list[float]:
            total = applied(t, y[0], y[2]) - (h.damping + h.hand_damping) * y[1] - sense * h.friction
            fall = 0.0 if h.lag == 0.0 else (u - y[2]) / h.lag
            if sense == 0.0 and h.friction > 0.0:
                return [0.0, 0.0, fall]
            return [y[1], total / h.mass, fall]

        return f

    # It breaks away a rounding late, or it would be found to stop again at once.
    limit = h.friction * (1.0 + 1e-12)
    t, sense = 0.0, float(np.sign(v))
    if sense == 0.0 and abs(applied(0.0, x, a)) > limit:
        sense = float(np.sign(applied(0.0, x, a)))
    for _ in range(50):
        if t >= period:
            return x, v, a
        events = []
        if h.friction > 0.0:
            if sense:
                # A start from rest is not a stop: the event is found slightly late, by rounding.
                events = [lambda t, y, sense=sense: sense * y[1] + 1e-15]
                events[0].direction = -1.0
            else:
                events = [lambda t, y: abs(applied(t, y[0], y[2])) - limit]
                events[0].direction = 1.0
            events[0].terminal = True
        options = {"rtol": 1e-12, "atol": 1e-16, "events": events, "max_step": period / 8.0}
        solution = solve_ivp(rates(sense), (t, period), [x, v, a], "DOP853", **options)
        t, (x, v, a) = float(solution.t[-1]), solution.y[:, -1]
        if solution.status == 1:
            force = applied(t, x, a)
            if sense:
                v = 0.0
                sense = float(np.sign(force)) if abs(force) > limit else 0.0
            else:
                sense = float(np.sign(force))
    raise RuntimeError(f"the integrator does not get past {t} s of a tick: {h}")
