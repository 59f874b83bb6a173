"""Picture of a device's axes in text: directions in the world, range of the handle, and observed motions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

Report = Mapping[str, Any]

WORDS: Final = {"+x": "right", "+y": "away from you", "+z": "up", "-x": "left", "-y": "towards you", "-z": "down"}


def picture(report: Report) -> list[str]:
    """Draw arrows of x, y and z with the range of the handle along each, and list the motions seen along each axis."""
    span = report["range"]
    reach = ["not seen"] * 3
    if span is not None:
        pairs = zip(span["position_min_m"], span["position_max_m"], strict=True)
        reach = [f"{low * 1e3:.1f} to {high * 1e3:.1f} mm" for low, high in pairs]
    x, y, z = (f"{name}  {WORDS[f'+{name}']}: {reach[k]}" for k, name in enumerate("xyz"))
    return [
        f"    ^ {z}",
        "    |",
        f"    |    7 {y}",
        "    |   /",
        "    |  /",
        "    | /",
        f"    +----------> {x}",
        *_motions(report),
    ]


def _motions(report: Report) -> list[str]:
    motions = []
    for move in report["moves"]:
        if move["kind"] == "translation":
            right = "as it has to be" if move["agrees"] else f"WRONG: it has to be {move['expected']}"
            motions.append(f"    {WORDS[move['expected']]:>14} --> {move['seen']}   {right}")
    return motions
