"""Press a fingertip into the paper's plane, drag it sideways until it slips, and plot the force.

    python examples/press_and_plot.py press.png

It needs no daemon: `Engine` renders all poses in this process. They are one millisecond apart, as at 1 kHz.
"""

import sys

import matplotlib.pyplot as plt
import numpy as np

from softfinger import Engine

RADIUS_M = 0.010  # fingertip of the scene; at first contact, the height of its centre above the plane
UPRIGHT = (1.0, 0.0, 0.0, 0.0)  # w, x, y, z


def motion(seconds: float = 2.0, rate_hz: float = 1000.0) -> np.ndarray:
    """Return poses (n, 7): press 1 mm deep in half a second, then drag 3 mm along x."""
    t = np.arange(0.0, seconds, 1.0 / rate_hz)
    poses = np.zeros((len(t), 7))
    poses[:, 2] = RADIUS_M - 0.001 * np.clip(t / 0.5, 0.0, 1.0)
    poses[:, 0] = 0.003 * np.clip((t - 0.5) / 1.5, 0.0, 1.0)
    poses[:, 3:] = UPRIGHT
    return poses


def main(picture: str) -> None:
    records = Engine("paper-plane").run(motion())
    t, force, mode = records["timestamp"], records["force"], records["contact.mode"]

    figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    axes.plot(t, force[:, 2], label="normal, z")
    axes.plot(t, force[:, 0], label="tangential, x")
    axes.fill_between(t, *axes.get_ylim(), where=mode == 2, alpha=0.15, label="sliding")
    axes.set(xlabel="time (s)", ylabel="force on the hand (N)")
    axes.legend()
    figure.savefig(picture)

    slips = t[mode == 2][0]
    print(f"slips after {slips:.3f} s; largest normal force {force[:, 2].max():.2f} N; {picture} is drawn")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "press.png")
