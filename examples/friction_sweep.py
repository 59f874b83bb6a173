"""How far can a finger be dragged before it slips? Sweep the static friction, and compare with Coulomb's law.

    python examples/friction_sweep.py sweep.png

The finger presses with a normal force N and is dragged; the tangential spring (stiffness K) winds up until it holds
mu N, so it slips after a way of mu N / K. One `Engine` serves for all values: `set` changes a parameter without
compiling anything.
"""

import sys

import matplotlib.pyplot as plt
import numpy as np

from softfinger import Engine, load_scene

DEPTH_M = 0.001
SPEED_M_PER_S = 0.002
SCENE = load_scene("paper-plane", {"coupling.damping_ns_per_m": 0.0})  # a damper would hold, too


def drag(count: int = 2500, rate_hz: float = 1000.0) -> np.ndarray:
    """Poses (n, 7): 1 mm deep from the start, along x at a constant speed."""
    poses = np.tile([0.0, 0.0, SCENE.fingertip.radius_m - DEPTH_M, 1.0, 0.0, 0.0, 0.0], (count, 1))
    poses[:, 0] = SPEED_M_PER_S / rate_hz * np.arange(count)
    return poses


def slip_way(engine: Engine, friction: float) -> float:
    """Way (m) at which the finger begins to slide."""
    engine.reset()
    engine.set(
        {
            "object.table.material.friction.static": friction,
            "object.table.material.friction.kinetic": 0.8 * friction,
        }
    )
    records = engine.run(drag())
    return float(records["probe.position"][records["contact.mode"] == 2][0, 0])


def main(picture: str) -> None:
    engine = Engine(SCENE)
    friction = np.linspace(0.1, 1.0, 10)
    found = np.array([slip_way(engine, mu) for mu in friction])
    stiffness = SCENE.object[0].material.stiffness_n_per_m
    expected = friction * stiffness * DEPTH_M / SCENE.coupling.stiffness_n_per_m

    figure, axes = plt.subplots(figsize=(5, 4), layout="constrained")
    axes.plot(friction, 1e3 * expected, "k-", label="Coulomb: mu N / K")
    axes.plot(friction, 1e3 * found, "o", label="rendered")
    axes.set(xlabel="static friction", ylabel="way before it slips (mm)")
    axes.legend()
    figure.savefig(picture)
    print(f"largest difference {1e6 * np.abs(found - expected).max():.1f} um, one tick is 2 um; {picture} is drawn")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "sweep.png")
