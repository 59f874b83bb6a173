"""Animation at the top of README: a box lifted by two fingertips, with torsion and without, side by side.

Both are simulated. The picture shows poses 20 times a second, seen along the line between the fingers. SVG animates it
without a script (SMIL), in a page and in an image; a program without SMIL shows the frame STILL_FRAME.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from softfinger.config.load import describe, load_scene
from softfinger.drivers.poses import load_poses
from softfinger.drivers.resample import resample
from softfinger.proxy.engine import Engine
from softfinger.tools.measure import Array

RATE_HZ: Final = 1000.0
BLOCK: Final = 50
"""Ticks per frame."""
STILL_FRAME: Final = 50
"""Frame in which the box is up and held."""
PIXELS_PER_M: Final = 1400.0
WIDTH: Final = 360
HEIGHT: Final = 270
FLOOR: Final = 235
"""Size of a half, and height of the floor, px."""
HALF_M: Final = 0.02
RADIUS_M: Final = 0.01
TITLES: Final = (
    "soft fingertips: the torsion of the contacts carries it",
    "without torsion it turns about the fingers",
)


def make_lift(torsion: bool) -> Engine:
    """Return an engine of the scene `lift-a-box`, with or without the torsion of the contacts."""
    mapping = describe(load_scene("lift-a-box"))
    if not torsion:
        for table in (mapping["world"], *mapping["object"]):
            del table["material"]["torsion"]
    return Engine(mapping, RATE_HZ)


def simulate_lift(torsion: bool) -> tuple[Array, Array, Array]:
    """Return the states of all frames.

    They are the box's position in the plane (n, 2) m, its turn (n,) deg, and the fingers' position (n, 2) m.
    """
    engine = make_lift(torsion)
    hands = {name: resample(load_poses(f"lift-{name}"), RATE_HZ) for name in engine.fingers}
    # A hand yields by as much as the contact: half of the depth in the recording.
    for poses in hands.values():
        touch = HALF_M + RADIUS_M
        gap = np.abs(poses[:, 0]) - touch
        poses[:, 0] = np.sign(poses[:, 0]) * (touch + np.where(gap < 0.0, 0.5 * gap, gap))
    boxes, fingers = [engine.data.qpos.copy()], [hands["thumb"][0, 1:3]]
    for first in range(0, len(hands["thumb"]) - BLOCK, BLOCK):
        engine.run({name: poses[first : first + BLOCK] for name, poses in hands.items()})
        boxes.append(engine.data.qpos.copy())
        fingers.append(hands["thumb"][first + BLOCK - 1, 1:3])
    states = np.array(boxes)
    turn = np.degrees(np.unwrap(2.0 * np.arctan2(states[:, 4], states[:, 3])))
    return states[:, 1:3], turn, np.array(fingers)


def draw_picture() -> str:
    halves = [_round_half(place, *simulate_lift(torsion)) for place, torsion in enumerate((True, False))]
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {2 * WIDTH} {HEIGHT}" width="{2 * WIDTH}" '
        f'height="{HEIGHT}" font-family="sans-serif" font-size="14">\n'
        f'<rect width="{2 * WIDTH}" height="{HEIGHT}" fill="#fff"/>\n' + "".join(halves) + "</svg>\n"
    )


def _round_half(place: int, boxes: Array, turns: Array, fingers: Array) -> str:
    seconds = len(boxes) * BLOCK / RATE_HZ
    side, size = 2.0 * HALF_M * PIXELS_PER_M, HALF_M * PIXELS_PER_M
    box = (
        f'<rect x="{-size:g}" y="{-size:g}" width="{side:g}" height="{side:g}" rx="2" fill="#9fb4cc" stroke="#445"/>'
        '<circle r="3" fill="#445"/>'
    )
    finger = f'<circle r="{RADIUS_M * PIXELS_PER_M:g}" fill="#e68c5a" fill-opacity="0.85" stroke="#8a4a25"/>'
    return (
        f'<g transform="translate({place * WIDTH} 0)">\n'
        f'<text x="{WIDTH / 2:g}" y="20" text-anchor="middle" fill="#222">{TITLES[place]}</text>\n'
        f'<path d="M20 {FLOOR}h{WIDTH - 40}" stroke="#445" stroke-width="2"/>\n'
        + _animate(
            "translate",
            _to_pixels(boxes),
            seconds,
            _animate("rotate", [f"{-turn:.1f}" for turn in turns], seconds, box),
        )
        + _animate("translate", _to_pixels(fingers), seconds, finger)
        + "</g>\n"
    )


def _to_pixels(places: Array) -> list[str]:
    """Convert positions (n, 2) m, to the right and up, to points of a half."""
    return [f"{WIDTH / 2 + PIXELS_PER_M * y:.1f} {FLOOR - PIXELS_PER_M * z:.1f}" for y, z in places.tolist()]


def _animate(kind: str, values: list[str], seconds: float, shape: str) -> str:
    return (
        f'<g transform="{kind}({values[STILL_FRAME]})"><animateTransform attributeName="transform" type="{kind}" '
        f'dur="{seconds:g}s" repeatCount="indefinite" values="{";".join(values)}"/>{shape}</g>\n'
    )


def draw(path: Path) -> None:
    path.write_text(draw_picture(), encoding="ascii", newline="\n")
