"""Sketches of the model pages, drawn to scale: fingertip, surface and forces; and the animation at the top of README.

The animation is a box lifted by two fingertips, with torsion and without, side by side. Both are simulated. The picture
shows poses 20 times a second, seen along the line between the fingers. SVG animates it without a script (SMIL), in a
page and in an image; a program without SMIL shows the frame STILL_FRAME.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np

from softfinger.config.load import describe, load_scene
from softfinger.drivers.poses import load_poses
from softfinger.drivers.resample import resample
from softfinger.proxy.engine import Engine
from softfinger.tools.measure import Array

BLUE: Final = "C0"
RED: Final = "C3"
GREY: Final = "0.55"
TURN: Final = np.linspace(0.0, 2.0 * np.pi, 61)


def draw_contact(axes: Any) -> None:
    """Draw probe and proxy of a fingertip that is pressed into a plane and dragged along it."""
    (axes,) = axes
    probe, proxy = np.array([0.35, 0.7]), np.array([0.0, 1.0])
    _draw_ground(axes, -1.6, 2.2)
    _draw_circle(axes, proxy, 1.0, BLUE)
    _draw_circle(axes, probe, 1.0, GREY, "--")
    _mark(axes, proxy, "proxy c", (-46, 4))
    _mark(axes, probe, "probe x", (8, -10))
    _draw_arrow(axes, (0.0, 0.0), (0.0, 0.75), "n", RED)
    _span(axes, (probe[0], proxy[1]), probe, r"$\delta$")
    _span(axes, proxy, (probe[0], proxy[1]), "e")
    _draw_arrow(axes, probe, probe + np.array([-0.5, 1.25]), r"$f_N n + f_t$", BLUE)
    _hide_axes(axes, (-1.7, 2.3), (-0.5, 2.2))


def draw_conventions(axes: Any) -> None:
    """Draw the world axes with a fingertip on a floor, from the front and from above."""
    side, above = axes
    _draw_ground(side, -1.6, 2.2)
    _draw_circle(side, np.array([0.0, 0.9]), 1.0, BLUE)
    _draw_arrow(side, (0.0, 0.9), (0.0, 1.75), "force, normal n", BLUE)
    _draw_axes(side, (1.5, 0.3), "x", "z")
    side.set_title("from the front (y points away)", fontsize="small")
    _draw_circle(above, np.array([0.0, 0.7]), 1.0, BLUE)
    angle = np.linspace(-0.6, 1.6, 30)
    above.plot(0.55 * np.cos(angle), 0.7 + 0.55 * np.sin(angle), color=RED)
    _draw_arrow(above, (0.08, 1.25), (-0.1, 1.24), "", RED)
    above.annotate("spin > 0", (0.0, 0.7), ha="center", va="center", fontsize="small")
    _draw_axes(above, (1.5, 0.1), "x", "y")
    above.set_title("from above (z points to you)", fontsize="small")
    for panel in axes:
        _hide_axes(panel, (-1.7, 2.5), (-0.5, 2.1))


def draw_rolling(axes: Any) -> None:
    """Draw a ball before and after a roll: the contact travels r theta on the ball and on the plane."""
    (axes,) = axes
    theta = 1.1
    _draw_ground(axes, -1.5, 2.9)
    for x, turn, style in ((0.0, 0.0, "--"), (theta, -theta, "-")):
        center = np.array([x, 1.0])
        _draw_circle(axes, center, 1.0, BLUE, style)
        spoke = center + np.array([np.sin(turn), -np.cos(turn)])
        axes.plot(*zip(center, spoke, strict=True), color=BLUE, linewidth=0.8, linestyle=style)
        _mark(axes, center, "", (0, 0))
    arc = np.linspace(-np.pi / 2.0 - theta, -np.pi / 2.0, 30)
    axes.plot(theta + np.cos(arc), 1.0 + np.sin(arc), color=RED, linewidth=2.5)
    axes.plot([0.0, theta], [0.0, 0.0], color=RED, linewidth=2.5)
    axes.annotate(r"$r\,\theta$", (theta / 2.0, -0.25), ha="center", color=RED)
    axes.annotate(r"$\theta$", (theta - 0.28, 0.62), color=BLUE)
    _hide_axes(axes, (-1.6, 3.0), (-0.5, 2.1))


def draw_ellipsoid(axes: Any) -> None:
    """Draw an ellipse that rolls on a line: the support vector from contact to centre, and the path of the centre."""
    (axes,) = axes
    a, b = 1.3, 0.8
    _draw_ground(axes, -1.5, 4.7)
    turns = np.linspace(0.0, np.pi, 181)
    height = np.sqrt((a * np.sin(turns)) ** 2 + (b * np.cos(turns)) ** 2)
    lean = (a * a - b * b) * np.sin(turns) * np.cos(turns) / height
    # Without slip the contact travels the length of the ellipse, with the element h + h'' of the turn.
    arc = np.concatenate([[0.0], np.cumsum(0.5 * (height[1:] + height[:-1]) * np.diff(turns))]) + np.gradient(
        height, turns
    )
    for at in (0, 70, 150):
        t = turns[at]
        center = np.array([arc[at] - lean[at], height[at]])
        x, y = a * np.cos(TURN), b * np.sin(TURN)
        axes.plot(center[0] + x * np.cos(t) + y * np.sin(t), center[1] - x * np.sin(t) + y * np.cos(t), color=BLUE)
        _draw_arrow(axes, (arc[at], 0.0), center, r"$\rho$" if at == 70 else "", RED)
    axes.plot(arc - lean, height, color=GREY, linestyle="--", linewidth=0.8)
    _hide_axes(axes, (-1.6, 4.8), (-0.4, 2.5))


def draw_heightmap(axes: Any) -> None:
    """Draw hills and the surface on which the centre of a fingertip moves, with a valley that is too narrow for it."""
    (axes,) = axes
    x = np.linspace(-3.0, 3.0, 241)
    hills = 0.35 * np.cos(2.0 * x) + 0.25 * np.cos(0.9 * x)
    radius = 1.0
    reach = x[None, :] - x[:, None]
    lifted = np.where(np.abs(reach) <= radius, hills[None, :] + np.sqrt(np.maximum(radius**2 - reach**2, 0.0)), -9.0)
    offset = lifted.max(axis=1)
    axes.fill_between(x, hills, -1.0, color="0.85", linewidth=0)
    axes.plot(x, hills, color="0.3", label="surface")
    axes.plot(x, offset, "--", color=GREY, linewidth=0.8, label="positions of the proxy")
    for at in (int(np.argmin(np.abs(x))), int(np.argmin(np.where(np.abs(x - 1.7) < 0.5, offset, 9.0)))):
        _draw_circle(axes, np.array([x[at], offset[at]]), radius, BLUE)
        points = [int(np.argmax(np.where(side, lifted[at], -9.0))) for side in (reach[at] <= 0.0, reach[at] >= 0.0)]
        axes.plot(x[points], hills[points], ".", color=RED)
    _hide_axes(axes, (-3.0, 4.2), (-1.0, 2.8))


def draw_mesh(axes: Any) -> None:
    """Draw a faceted outline, the surface on which the centre moves, and normals with and without shading."""
    (axes,) = axes
    corners = np.array([[2.6 * np.sin(t), 2.6 * np.cos(t) - 2.6] for t in np.linspace(-0.9, 0.9, 5)])
    axes.fill(*np.vstack([corners, [3.0, -3.0], [-3.0, -3.0]]).T, color="0.85", linewidth=0)
    axes.plot(*corners.T, color="0.3", marker=".", label="facets")
    radius, outline = 0.6, []
    normals = [np.array([-(b - a)[1], (b - a)[0]]) / np.hypot(*(b - a)) for a, b in pairwise(corners)]
    for i, n in enumerate(normals):
        outline += [corners[i] + radius * n, corners[i + 1] + radius * n]
    axes.plot(*np.array(outline).T, "--", color=GREY, linewidth=0.8, label="positions of the proxy")
    for part in np.linspace(0.15, 0.85, 3):
        place = corners[1] + part * (corners[2] - corners[1])
        smooth = place - np.array([0.0, -2.6])
        _draw_arrow(axes, place, place + 0.8 * normals[1], "", BLUE)
        _draw_arrow(axes, place, place + 0.8 * smooth / np.hypot(*smooth), "", RED)
    axes.plot([], [], color=BLUE, label='force direction, shading = "none"')
    axes.plot([], [], color=RED, label='force direction, shading = "normals"')
    _hide_axes(axes, (-2.4, 4.6), (-1.4, 2.0))


def _draw_ground(axes: Any, left: float, right: float) -> None:
    axes.fill_between([left, right], [0.0, 0.0], [-0.4, -0.4], color="0.85", linewidth=0)
    axes.plot([left, right], [0.0, 0.0], color="0.3", linewidth=1.0)


def _draw_circle(axes: Any, center: Array, radius: float, color: str, style: str = "-") -> None:
    axes.plot(center[0] + radius * np.cos(TURN), center[1] + radius * np.sin(TURN), color=color, linestyle=style)


def _mark(axes: Any, place: Any, text: str, off: tuple[int, int]) -> None:
    axes.plot(*place, ".", color="0.2")
    axes.annotate(text, place, xytext=off, textcoords="offset points", fontsize="small")


def _draw_arrow(axes: Any, start: Any, end: Any, text: str, color: str) -> None:
    axes.annotate("", end, xytext=start, arrowprops={"arrowstyle": "->", "color": color, "shrinkA": 0, "shrinkB": 0})
    axes.annotate(text, end, xytext=(3, 3), textcoords="offset points", color=color, fontsize="small")


def _span(axes: Any, start: Any, end: Any, text: str) -> None:
    axes.annotate(
        "", end, xytext=start, arrowprops={"arrowstyle": "|-|,widthA=0.2,widthB=0.2", "shrinkA": 0, "shrinkB": 0}
    )
    middle = (np.asarray(start) + np.asarray(end)) / 2.0
    axes.annotate(text, middle, xytext=(4, 2), textcoords="offset points", fontsize="small")


def _draw_axes(axes: Any, origin: tuple[float, float], right: str, up: str) -> None:
    x, y = origin
    _draw_arrow(axes, origin, (x + 0.6, y), right, "0.2")
    _draw_arrow(axes, origin, (x, y + 0.6), up, "0.2")


def _hide_axes(axes: Any, x: tuple[float, float], y: tuple[float, float]) -> None:
    axes.set(xlim=x, ylim=y, aspect="equal")
    axes.axis("off")


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
    halves = [_draw_half(place, *simulate_lift(torsion)) for place, torsion in enumerate((True, False))]
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {2 * WIDTH} {HEIGHT}" width="{2 * WIDTH}" '
        f'height="{HEIGHT}" font-family="sans-serif" font-size="14">\n'
        f'<rect width="{2 * WIDTH}" height="{HEIGHT}" fill="#fff"/>\n' + "".join(halves) + "</svg>\n"
    )


def _draw_half(place: int, boxes: Array, turns: Array, fingers: Array) -> str:
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
