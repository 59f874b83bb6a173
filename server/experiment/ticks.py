"""Ticks of a touch as rows of a table, and their summary for the table of trials."""

from __future__ import annotations

from typing import Any

import numpy as np

from softfinger.server.wire.client import Sample


def row(finger: str, sample: Sample) -> dict[str, Any]:
    """Return a tick as a row of the table of a trial."""
    tick = sample.data
    (x, y, z), (fx, fy, fz) = tick.probe.position, tick.force
    return {
        "finger": finger, "tick": tick.tick, "timestamp": tick.timestamp, "x_m": x, "y_m": y, "z_m": z,
        "fx_n": fx, "fy_n": fy, "fz_n": fz, "mode": tick.contact.mode, "object": tick.contact.object,
        "penetration_m": tick.contact.penetration, "buttons": tick.buttons, "lost": sample.lost,
    }  # fmt: skip


def summary(ticks: list[dict[str, Any]], reached_s: float | None) -> dict[str, Any]:
    """Return the columns of a touch for the table of trials.

    With several fingers, the path is that of the first one; the forces are over all.
    """
    if not ticks:
        return {}
    force = np.array([[tick["fx_n"], tick["fy_n"], tick["fz_n"]] for tick in ticks])
    first = [tick for tick in ticks if tick["finger"] == ticks[0]["finger"]]
    path = np.array([[tick["x_m"], tick["y_m"], tick["z_m"]] for tick in first])
    norm = np.linalg.norm(force, axis=1)
    touching = norm > 0.0
    return {
        "first_tick": first[0]["tick"],
        "last_tick": first[-1]["tick"],
        "lost_ticks": sum(tick["lost"] for tick in first),
        "peak_force_n": float(norm.max()),
        "mean_force_n": float(norm[touching].mean()) if touching.any() else 0.0,
        "path_m": float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()),
        "duration_s": float(first[-1]["timestamp"] - first[0]["timestamp"]) if reached_s is None else reached_s,
        "reached": reached_s is not None,
    }
