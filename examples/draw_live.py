"""Subscribe to a running daemon and draw the last second of force, ten times per second.

    softfinger run                                  # in one terminal
    python examples/draw_live.py                    # in another: a window
    python examples/draw_live.py live.png           # or a file, without a screen

A `window` stores the latest ticks as arrays with the names of the telemetry; `update` reads new messages. Optional
second argument: telemetry endpoint.
"""

import sys

import matplotlib

if len(sys.argv) > 1:
    matplotlib.use("agg")  # to a file, without a screen

import matplotlib.pyplot as plt

from softfinger import Client

FRAME_S = 0.1


def main(picture: str | None, *endpoint: str, frames: int | None = None) -> None:
    figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    lines = [axes.plot([], [], label=name)[0] for name in ("x", "y", "z")]
    axes.set(xlabel="time (s)", ylabel="force on the hand (N)")
    axes.legend(loc="upper left")
    with Client(*endpoint) as daemon:
        window = daemon.window(samples=1000)
        while frames is None or frames > 0:
            if window.update(timeout_s=10.0) == 0:
                sys.exit("nothing arrives: is the server running (softfinger run)?")
            t = window["timestamp"] - window["timestamp"][0]
            for line, component in zip(lines, window["force"].T, strict=True):
                line.set_data(t, component)
            axes.relim()
            axes.autoscale_view()
            if picture is not None:
                figure.savefig(picture)
            plt.pause(FRAME_S)
            frames = None if frames is None else frames - 1
    print(f"{len(t)} ticks drawn, {window.lost} lost")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(sys.argv[1], *sys.argv[2:], frames=5)
    else:
        main(None)
