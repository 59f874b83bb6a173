"""Geometry of the page against closed forms, targets of the hand from drags of the mouse, and the timeline."""

import gc
import weakref
from math import atan2, cos, pi, radians, sin, sqrt
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import paper_mapping
from hypothesis import example, given
from hypothesis import strategies as st

from softfinger.config import schema
from softfinger.config.load import build
from softfinger.drivers.quaternions import exp
from softfinger.proxy.engine import Engine
from softfinger.proxy.record import AT, FREE, RECORD_SIZE, ROLLING, SLIDING
from softfinger.server.surface_meshes import SurfaceMesh, make_cone, make_surface
from softfinger.server.viewer import page
from softfinger.server.viewer.inputs import Nudge
from softfinger.server.viewer.nodes import glyphs, looks
from softfinger.server.viewer.nodes.bodies import BodyNodes, SceneStart
from softfinger.server.viewer.nodes.fingertip import make_finger, nail
from softfinger.server.viewer.nodes.looks import ARROW_MAX_CM, COLOURS, VisibleState, classify_contact
from softfinger.server.viewer.plots import LINES
from softfinger.server.viewer.target import Target, drag_target, from_angles, intersect_plane, nudge_target, to_angles
from softfinger.server.viewer.timeline import COLUMNS, Events, find_state_runs, format_band, format_pointer

pytestmark = pytest.mark.plain

SOLIDS = [
    ({"shape": "sphere", "radius_m": 0.02}, 4 / 3 * pi * 0.02**3),
    ({"shape": "cylinder", "radius_m": 0.02, "length_m": 0.05}, pi * 0.02**2 * 0.05),
    ({"shape": "capsule", "radius_m": 0.02, "length_m": 0.05}, pi * 0.02**2 * 0.05 + 4 / 3 * pi * 0.02**3),
    ({"shape": "box", "size_m": [0.02, 0.03, 0.04]}, 0.02 * 0.03 * 0.04),
    ({"shape": "ellipsoid", "semi_axes_m": [0.02, 0.03, 0.04]}, 4 / 3 * pi * 0.02 * 0.03 * 0.04),
    ({"shape": "torus", "major_radius_m": 0.04, "minor_radius_m": 0.01}, 2 * pi**2 * 0.04 * 0.01**2),
]
UP = np.array([0.0, 0.0, 1.0])
units = st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(np.array).filter(lambda v: np.linalg.norm(v) > 0.1)


def make_object(table: dict[str, Any]) -> Any:
    mapping = paper_mapping(table={"shape": None, **table})
    return build(schema.Scene, mapping, "test scene").object[0]


def compute_volume(mesh: SurfaceMesh) -> float:
    """Return the volume enclosed by the triangles by the divergence theorem, positive if they face outwards."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6.0)


@pytest.mark.parametrize(("table", "exact"), SOLIDS, ids=[table["shape"] for table, _ in SOLIDS])
def test_solids_have_their_volume_and_face_outwards(table: dict[str, Any], exact: float) -> None:
    """A polygon of 40 corners lacks 0.4 % of a circle's area; a meridian lacks half as much again."""
    assert compute_volume(make_surface(make_object(table))) == pytest.approx(exact, rel=0.015)


def test_a_plane_faces_along_its_normal() -> None:
    mesh = make_surface(make_object({"shape": "plane"}))
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    assert (mesh.vertices[:, 2] == 0.0).all() and (np.cross(b - a, c - a) @ UP > 0.0).all()


@given(st.floats(-3.0 * pi, 3.0 * pi), st.floats(0.1, 10.0))
def test_an_arc_is_as_long_as_its_angle(angle: float, radius: float) -> None:
    line = glyphs.make_arc(angle, radius)[: glyphs.ARC_PIECES]
    drawn = min(abs(angle), glyphs.ARC_MAX)
    chord = 2.0 * radius * sin(drawn / glyphs.ARC_PIECES / 2.0)
    assert np.linalg.norm(line[:, 1] - line[:, 0], axis=1).sum() == pytest.approx(glyphs.ARC_PIECES * chord, abs=1e-9)
    assert np.cross(line[:, 0], line[:, 1])[:, 2].sum() * angle >= 0.0
    np.testing.assert_allclose(np.linalg.norm(line[:, 1], axis=1), radius, rtol=1e-12)


def test_a_cone_has_the_slope_of_the_friction() -> None:
    rim = make_cone(1.0, 0.6).vertices[-1]
    assert atan2(np.hypot(rim[0], rim[1]), rim[2]) == pytest.approx(atan2(0.6, 1.0), rel=1e-12)


@given(units)
def test_rotation_to_a_normal_maps_z_to_it(normal: np.ndarray) -> None:
    normal = normal / np.linalg.norm(normal)
    np.testing.assert_allclose(glyphs.rotate(glyphs.rotate_z_to(normal), UP), normal, atol=2e-3)  # limited near -z


@given(st.floats(-1.4, 1.4), st.floats(-1.4, 1.4), st.floats(-3.0, 3.0))
def test_angles_of_the_sliders_round_trip(x: float, y: float, z: float) -> None:
    np.testing.assert_allclose(to_angles(from_angles(x, y, z)), (x, y, z), atol=1e-9)


@example([(0.0, 0.0, 1.0), (1.0, 1.0, 1.0), (-1.0, -1.0, -1.0)])  # out and back along one line
@given(st.lists(st.tuples(*[st.floats(-1.0, 1.0)] * 3), min_size=2, max_size=60))
def test_a_trace_extends_a_segment_only_along_a_line(steps: list[tuple[float, ...]]) -> None:
    points = [np.zeros(3), *np.cumsum(0.02 * np.array(steps), axis=0)]
    drawn = trace_segments(glyphs.Trace(0.01, segments=80), points)
    if len(drawn):
        np.testing.assert_array_equal(drawn[1:, 0], drawn[:-1, 1])
    for point in points:
        assert min((distance_to_segment(point, *segment) for segment in drawn), default=0.0) < 0.02
    assert len(trace_segments(glyphs.Trace(0.01), [np.array([x, 0.0, 0.0]) for x in np.arange(0.0, 0.2, 0.01)])) == 1


def trace_segments(trace: glyphs.Trace, points: list[np.ndarray]) -> np.ndarray:
    """Return the drawn segments of a trace through points."""
    for point in points:
        trace.add(point, (1, 2, 3))
    return trace.segments[np.linalg.norm(trace.segments[:, 1] - trace.segments[:, 0], axis=1) > 0.0]


def distance_to_segment(point: np.ndarray, start: np.ndarray, end: np.ndarray) -> float:
    long = end - start
    share = np.clip((point - start) @ long / (long @ long), 0.0, 1.0)
    return float(np.linalg.norm(point - start - share * long))


class Frames:
    def __getattr__(self, name: str) -> Any:
        return lambda *args, **kwargs: SimpleNamespace()


@pytest.mark.parametrize("own_clock", [False, True])
def test_a_moving_body_is_drawn_at_its_pose_in_the_contact(own_clock: bool) -> None:
    """The plane oscillates under the fingertip; ticks are missed, also before the scene started, and few are shown. The
    drawn pose is that of the contact step, so the contact point is on it. If a device has its own clock, a missed
    deadline does not advance its time."""
    motion = {"kind": "sinusoid", "translation_m": [0.0, 0.0, 0.004], "frequency_hz": 3.0}
    scene = build(schema.Scene, paper_mapping(table={"motion": motion}), "test scene")
    engine, period, first_tick, missed = Engine(scene), 1e-3, 500, 70
    bodies = BodyNodes(Frames(), scene, SceneStart(first_tick, missed, period, own_clock))
    random = np.random.default_rng(3)
    for tick in range(first_tick, first_tick + 400):
        skipped = int(random.integers(0, 8)) if random.random() < 0.1 and tick > first_tick else 0
        missed += skipped
        dt = period if own_clock else period * (1 + skipped)
        row = np.array(engine.step([0.0, 0.0, 0.004], [1.0, 0.0, 0.0, 0.0], dt).record)
        row[AT.tick], row[AT.servo_missed] = tick, missed
        if tick % 37 == 0:
            bodies.show(row)
            assert bodies.poses[0][0][2] == pytest.approx(row[AT.contact_point + 2], abs=1e-12)  # rounding of a sum


def test_an_object_on_a_body_is_drawn_in_the_frame_of_the_body() -> None:
    ball = {"name": "ball", "shape": "sphere", "radius_m": 0.01, "position_m": [0.0, 0.1, 0.0]}
    ball |= {"material": {"stiffness_n_per_m": 500.0}, "motion": {"kind": "body", "body": "arm"}}
    mapping = {"fingertip": {"radius_m": 0.01}, "world": {"model": "arm.xml"}, "object": [ball]}
    bodies = BodyNodes(Frames(), build(schema.Scene, mapping, "test scene"), SceneStart(0, 0, 1e-3, True))
    half = np.sqrt(0.5).item()
    leg = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    bodies.move_bodies({"arm": ((1.0, 2.0, 3.0), (half, 0.0, 0.0, half)), "leg": leg})
    position, turn = bodies.poses[0]
    assert position == pytest.approx((0.9, 2.0, 3.0)) and turn == pytest.approx((half, 0.0, 0.0, half))
    bodies.move_bodies({})
    assert bodies.poses[0] == (position, turn)


def make_bodies(*objects: dict[str, Any]) -> BodyNodes:
    tables = [table | {"material": {"stiffness_n_per_m": 1000.0}} for table in objects]
    scene = build(schema.Scene, {"fingertip": {"radius_m": 0.01}, "object": tables}, "test scene")
    return BodyNodes(Frames(), scene, SceneStart(0, 0, 1e-3, True))


@given(units, st.floats(-0.9, 0.9), st.floats(0.0, 2.0 * pi))
def test_a_plumb_line_ends_on_top_of_a_ball(axis: np.ndarray, share: float, turn: float) -> None:
    """On a ball of 20 mm in any rotation the foot is at height sqrt(r^2 - d^2) with the normal of the ball. Triangles
    have 9 degrees in each direction, so they are within 2 r (1 - cos 4.5 degrees) = 0.12 mm of the ball, which is 0.28
    mm of height at the slope of 0.9 r; their normals are within 2 * 4.5 degrees."""
    ball, centre, radius = {"shape": "sphere", "radius_m": 0.02, "name": "ball"}, np.array([0.01, -0.03, 0.05]), 0.02
    turned = exp(turn * axis / np.linalg.norm(axis))
    place = {"position_m": centre.tolist(), "orientation_wxyz": turned.tolist()}
    bodies = make_bodies(ball | place)
    offset = share * radius * np.array([cos(turn), sin(turn), 0.0])
    exact = np.array([*offset[:2], sqrt(radius**2 - offset @ offset)])
    foot = bodies.below(centre + offset + 0.1 * UP)
    np.testing.assert_allclose(foot.point, centre + exact, atol=2.9e-4)
    assert foot.normal @ exact / radius > cos(radians(9.0))
    assert bodies.below(centre + offset - 0.1 * UP) is None
    assert bodies.below(centre + 1.01 * radius * np.array([cos(turn), sin(turn), 5.0])) is None


def test_a_plumb_line_ends_on_the_highest_object_and_follows_it() -> None:
    box = {"shape": "box", "size_m": [0.02, 0.02, 0.02], "position_m": [0.0, 0.0, 0.01], "name": "box"}
    bodies = make_bodies({"shape": "plane", "name": "floor"}, box | {"motion": {"kind": "driven"}})
    point = np.array([0.005, -0.005, 0.1])
    for place, height in (((0.0, 0.0, 0.01), 0.02), ((0.0, 0.0, 0.05), 0.06), ((0.03, 0.0, 0.01), 0.0)):
        bodies.drive(1, place)
        foot = bodies.below(point)
        np.testing.assert_allclose(foot.point, [0.005, -0.005, height], atol=1e-15)
        np.testing.assert_allclose(foot.normal, UP, atol=1e-15)


def make_record(**values: float) -> np.ndarray:
    row = np.zeros(RECORD_SIZE)
    for name, value in values.items():
        row[getattr(AT, name)] = value
    return row


@pytest.mark.parametrize(
    ("after", "state"),
    [
        ({"contact_mode": 0}, VisibleState.FREE),
        ({"contact_mode": 1}, VisibleState.STICKING),
        ({"contact_mode": 1, "contact_rolled": 0.1}, VisibleState.ROLLING),
        ({"contact_mode": 1, "contact_spin": -0.1}, VisibleState.SPINNING),
        ({"contact_mode": 1, "contact_rolled": 1e-3, "contact_spin": 1e-3}, VisibleState.STICKING),
        ({"contact_mode": 2, "contact_rolled": 0.1, "contact_spin": 0.1}, VisibleState.SLIDING),
    ],
)
def test_a_contact_is_classified_by_its_motion(after: dict[str, float], state: VisibleState) -> None:
    before, now = make_record(contact_mode=1), make_record(timestamp=0.1, **after)
    assert classify_contact(before, now, 0.01) == state
    if state in (VisibleState.ROLLING, VisibleState.SPINNING):
        late = make_record(timestamp=9.0, **after)
        for pair in ((make_record(), now), (now, now), (before, late)):
            assert classify_contact(*pair, 0.01) == VisibleState.STICKING
    assert set(COLOURS) == set(VisibleState) and len(set(COLOURS.values())) == len(COLOURS)


@pytest.mark.parametrize("background", [(255, 255, 255), (36, 36, 36)])
def test_colours_are_visible_in_both_looks(background: tuple[int, int, int]) -> None:
    """Contrast of colours with a meaning to the panel: at least 3 to 1, by WCAG 2.2, 1.4.11."""
    lines = [tuple(bytes.fromhex(line[1:])) for line in LINES]
    for colour in (*COLOURS.values(), *lines, looks.TORSION, looks.PLUMB):
        darker, brighter = sorted(luminance(shown) for shown in (colour, background))
        assert (brighter + 0.05) / (darker + 0.05) >= 3.0, colour


def luminance(colour: tuple[int, ...]) -> float:
    """Return the relative luminance of an sRGB colour, by WCAG 2.2."""
    linear = [x / 12.92 if x <= 0.04045 else ((x + 0.055) / 1.055) ** 2.4 for x in (byte / 255.0 for byte in colour)]
    return float(np.dot([0.2126, 0.7152, 0.0722], linear))


@given(st.floats(0.0, 1e3), st.floats(0.1, 10.0))
def test_an_arrow_fits_on_the_screen(force: float, newtons_per_cm: float) -> None:
    scale = looks.Looks(newtons_per_cm=newtons_per_cm).arrow(force)
    assert force / scale <= ARROW_MAX_CM * (1.0 + 1e-12) and scale >= newtons_per_cm
    if force / newtons_per_cm > ARROW_MAX_CM:
        assert force / scale > ARROW_MAX_CM / 2.5 * (1.0 - 1e-12)
        assert float(f"{scale:.0e}") == pytest.approx(scale, rel=1e-12)
    else:
        assert scale == newtons_per_cm


IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
EYE = np.array([0.3, -0.4, 0.5])
START = Target(np.array([0.01, 0.0, 0.02]), IDENTITY)
GRABBED = np.array([0.01, -0.01, 0.02])


def aim(to: np.ndarray) -> np.ndarray:
    return intersect_plane(EYE, to, GRABBED, GRABBED - EYE)


QUARTER = 0.5 * pi * 0.01
"""A quarter circumference of the fingertip, m."""


@pytest.mark.parametrize(
    ("moved", "gesture", "turn"),
    [
        ((0.02, 0.01, 0.0), "move", IDENTITY),
        ((0.0, 0.0, -0.015), "press", IDENTITY),
        ((QUARTER, 0.0, 0.0), "roll", (sqrt(0.5), 0.0, sqrt(0.5), 0.0)),  # about +y, as a ball without slip
    ],
)
def test_a_drag_moves_presses_or_rolls(moved: Any, gesture: Any, turn: Any) -> None:
    target = drag_target(START, EYE, GRABBED, aim(GRABBED + moved), gesture, 0.01)
    np.testing.assert_allclose(target.position, START.position + moved, atol=1e-12)
    np.testing.assert_allclose(target.orientation, turn, atol=1e-9 if gesture == "roll" else 0.0)


def test_a_nudge_moves_rolls_and_spins() -> None:
    on = nudge_target(START, Nudge(x=0.001, z=-0.002), 0.01)
    np.testing.assert_allclose(on.position, START.position + np.array([0.001, 0.0, -0.002]), atol=1e-15)
    assert on.orientation == pytest.approx(IDENTITY)
    by_mouse = drag_target(START, EYE, GRABBED, aim(GRABBED + np.array([0.0, QUARTER, 0.0])), "roll", 0.01)
    by_key = nudge_target(START, Nudge(roll_y=QUARTER), 0.01)
    assert by_mouse is not None and by_key.orientation == pytest.approx(by_mouse.orientation)
    np.testing.assert_allclose(by_key.position, by_mouse.position, atol=1e-12)
    spun = nudge_target(START, Nudge(spin=0.5 * pi), 0.01)
    assert spun.orientation == pytest.approx((sqrt(0.5), 0.0, 0.0, sqrt(0.5)))


def test_a_view_along_a_plane_gives_no_target() -> None:
    """A view from above has no upright plane, and a view along the table no horizontal one, so there is no target."""
    above = GRABBED + np.array([0.0, 0.0, 0.5])
    assert drag_target(START, above, GRABBED, GRABBED, "press", 0.01) is None
    level = GRABBED + np.array([0.0, -0.5, 0.0])
    assert drag_target(START, level, GRABBED, GRABBED + np.array([0.01, 0.0, 0.0]), "move", 0.01) is None
    assert intersect_plane(EYE, EYE + UP, np.zeros(3), UP) is None  # behind the eye


def test_angles_are_about_the_axes_of_the_world() -> None:
    rolled = glyphs.rotate(from_angles(radians(30.0), 0.0, radians(90.0)), UP)
    np.testing.assert_allclose(rolled, (sin(radians(30.0)), 0.0, cos(radians(30.0))), atol=1e-12)


def test_the_drawn_fingertip_is_the_rendered_ellipsoid() -> None:
    radii = np.array([0.008, 0.007, 0.012])
    mesh = make_finger(radii)
    assert compute_volume(mesh) > 4 / 3 * pi * radii.prod()
    unit = mesh.vertices / radii
    distance = np.linalg.norm(unit, axis=1)
    assert distance.min() > 1.0 - 1e-12
    lower = unit @ (0.0, sin(radians(45.0)), cos(radians(45.0))) <= 1e-12  # relative to the axis, tilted by 45 degrees
    assert lower.any() and np.allclose(distance[lower], 1.0, rtol=1e-12)
    assert (np.linalg.norm(nail(radii).vertices / radii, axis=1) > 1.0).all()


RADIUS = 0.01


def rows(modes: list[int], rolled: float = 0.0) -> np.ndarray:
    records = np.zeros((len(modes), RECORD_SIZE))
    records[:, AT.tick] = np.arange(len(modes)) + 40
    records[:, AT.timestamp] = 0.001 * np.arange(len(modes))
    records[:, AT.contact_mode] = modes
    records[:, AT.contact_rolled] = rolled * np.arange(len(modes))
    return records


def test_a_band_has_each_state_where_it_is() -> None:
    records = rows([FREE] * 200 + [ROLLING] * 400)
    records[400:, AT.contact_rolled] = 0.01 * np.arange(200)
    states = [VisibleState.FREE, VisibleState.STICKING, VisibleState.ROLLING]
    assert find_state_runs(records, RADIUS) == list(zip((0, 200, 403), states, strict=True))


def test_a_slide_shorter_than_a_column_is_visible() -> None:
    modes = [ROLLING] * (20 * COLUMNS)
    modes[5555] = SLIDING
    runs = find_state_runs(rows(modes), RADIUS)
    assert [state for _, state in runs] == [VisibleState.STICKING, VisibleState.SLIDING, VisibleState.STICKING]
    assert runs[1][0] <= 5555 < runs[2][0] <= runs[1][0] + 20


def test_the_band_and_its_pointer_as_html() -> None:
    drawn = format_band({"a<b": rows([FREE] * 10 + [SLIDING] * 30)}, {"a<b": RADIUS})
    free, sliding = (f"rgb{COLOURS[state]}" for state in (VisibleState.FREE, VisibleState.SLIDING))
    assert f'<rect x="0" width="10" height="1" fill="{free}"/><rect x="10" width="30"' in drawn
    assert f'fill="{sliding}"' in drawn and "a&lt;b" in drawn and "a<b" not in drawn
    assert "margin-left: 50.00%" in format_pointer(0.5)


def test_events_can_be_reached_from_both_sides() -> None:
    event_maps = (
        {"tick": 60, "kind": "mark", "name": "mark", "label": "<here>"},
        {"tick": 45, "kind": "contact", "name": "touch", "cause": "touch"},
        {"tick": 9999, "kind": "lifecycle", "name": "stopped"},
    )
    events = Events({"": rows([FREE] * 100)}, event_maps, 1000.0)
    assert [events.after(-1), events.after(5), events.after(20), events.after(99)] == [5, 20, 99, None]
    assert [events.before(5), events.before(20), events.before(99)] == [None, 5, 20]
    assert "no event yet" in events.format_html(4)
    text = events.format_html(20)
    assert text.index("0.020 s · mark mark, label &lt;here&gt;") < text.index("0.005 s · contact touch")
    assert "<here>" not in text


def test_events_follow_from_the_ticks_if_none_are_recorded() -> None:
    records = rows([ROLLING] * 10 + [FREE] * 10)
    records[10, AT.contact_cause] = 6
    events = Events({"": records}, (), 1000.0)
    assert events.after(0) == 10 and "release" in events.format_html(10)


class Circle:
    def __init__(self) -> None:
        self.itself = self


def test_a_page_collects_its_garbage_while_it_is_open(monkeypatch: pytest.MonkeyPatch) -> None:
    """A collection also frees CPython's free lists of tuples, which programs cannot clear directly."""
    monkeypatch.setattr(page, "COLLECT_S", 2.5 * page.FRAME_S)
    references: list[weakref.ref[Circle]] = []
    alive: list[int] = []

    def work(dt: float) -> None:
        references.append(weakref.ref(Circle()))
        alive.append(sum(reference() is not None for reference in references))

    gc.disable()  # nothing else collects
    try:
        page.run_frames(work, [], 20.0 * page.FRAME_S)
    finally:
        gc.enable()
        gc.unfreeze()
    assert len(alive) > 10  # a busy machine runs fewer frames
    assert max(alive) < 6
