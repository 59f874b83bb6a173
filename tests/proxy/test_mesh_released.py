"""Proxies are blocked only by triangles they touch: strokes through thin walls, threads, bars and needles, compared
with brute force. A fingertip without friction at rest is blocked by the triangles it touches: its force is a sum of
their normals with no negative weight. Compiled: a stroke takes two thousand ticks."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import hostile_meshes, meshes
from helpers.examples import Cases
from helpers.hostile_meshes import bar
from helpers.touching import SLIPPERY, Array, engine, make_object, posed, write_part
from numpy.typing import ArrayLike
from references.brute_force import balls_of, brute_distances
from scipy.optimize import nnls

from softfinger.proxy.kernels.contact.first_pose import OVERLAP_TOLERANCE
from softfinger.proxy.record import AT, CAUSE_RESTART, FREE, ON_ITS_WAY
from softfinger.tools.accuracy.meshes import triangulate_grid

pytestmark = pytest.mark.scaled
STEP = 1e-4
"""Travel per tick, m: 0.1 m/s."""
STILL = 1e-7
"""Travel per tick, m, below which a proxy counts as resting; a free proxy follows the probe."""
STIFF = {"stiffness_n_per_m": 1000.0}
UNEXPLAINED = 0.02
"""Share of a direction: contacts within 1e-4 r may differ by as much around a corner; a blocked proxy leaves some
tenths."""


def turned_about_z(profile: ArrayLike, around: int) -> meshes.Mesh:
    """Rotate a closed profile (n, 2) of r and z, m, about the z axis in this number of steps."""
    angle = 2.0 * np.pi * np.arange(around) / around
    rings = [np.column_stack([r * np.cos(angle), r * np.sin(angle), np.full(around, z)]) for r, z in np.array(profile)]
    vertices, triangles = triangulate_grid(np.array(rings), rows_meet=True, columns_meet=True)
    return meshes.made((vertices, triangles[:, ::-1]))


def thread(turns: int = 5, around: int = 48) -> meshes.Mesh:
    """A screw of 40 mm without a head: a ridge of 3 mm on a core of 10 mm radius."""
    rows = 12 * turns + 1
    z = np.linspace(-0.02, 0.02, rows)
    angle = 2.0 * np.pi * np.arange(around) / around
    phase = (z[:, None] * turns / 0.04 - angle / (2.0 * np.pi)) % 1.0
    r = 0.01 + 0.003 * np.abs(2.0 * phase - 1.0)
    side = np.stack([r * np.cos(angle), r * np.sin(angle), np.broadcast_to(z[:, None], r.shape)], axis=2)
    vertices, sides = triangulate_grid(side, columns_meet=True)
    triangles = sides[:, ::-1].tolist()
    low, high = rows * around, rows * around + 1
    for k in range(around):
        m = (k + 1) % around
        triangles += [(low, m, k), (high, (rows - 1) * around + k, (rows - 1) * around + m)]
    return meshes.made((np.vstack([vertices, [(0.0, 0.0, -0.02), (0.0, 0.0, 0.02)]]), np.array(triangles)))


def lattice() -> meshes.Mesh:
    """Three times three bars along each axis that intersect, 1 mm wide."""
    half, thin, bars = 0.0225, 0.0005, []
    for a in (-0.015, 0.0, 0.015):
        for b in (-0.015, 0.0, 0.015):
            bars.append(meshes.moved(bar(half, thin, thin), (0.0, a, b)))
            bars.append(meshes.moved(bar(thin, half, thin), (a, 0.0, b)))
            bars.append(meshes.moved(bar(thin, thin, half), (a, b, 0.0)))
    return meshes.joined(*bars)


def needles() -> meshes.Mesh:
    """Nine needles of 30 mm and 0.8 mm radius."""
    rng = np.random.default_rng(3)
    angle = 2.0 * np.pi * np.arange(8) / 8
    ring = np.column_stack([0.0008 * np.cos(angle), 0.0008 * np.sin(angle), np.full(8, -0.015)])
    corners = np.vstack([ring, [(0.0, 0.0, 0.015), (0.0, 0.0, -0.015)]])
    faces = [face for k in range(8) for face in ((k, (k + 1) % 8, 8), ((k + 1) % 8, k, 9))]
    needle = meshes.Mesh(corners, np.array(faces, np.int32))
    return meshes.joined(*(meshes.moved(needle, (x, y, 0.0)) for x, y in rng.uniform(-0.02, 0.02, (9, 2)).tolist()))


KINDS = {
    "tube": turned_about_z([(0.03, -0.025), (0.03, 0.025), (0.0295, 0.025), (0.0295, -0.025)], 32),
    "cup": turned_about_z(
        [(1e-5, -0.025), (0.03, -0.025), (0.03, 0.025), (0.0295, 0.025), (0.0295, -0.0245), (1e-5, -0.0245)], 48
    ),
    "thread": thread(),
    "lattice": lattice(),
    "needles": needles(),
    "bumpy": meshes.bumpy_sphere(24, 0.03, 0.05, 20.0),
}
"""Thin walls, threads, bars, needles: a proxy once got stuck on each. The hole in the cup's floor is narrower than any
fingertip."""


def feet(corners: Array, x: Array) -> Array:
    """Return the points (m, 3) of triangles (m, 3, 3) closest to `x` (3,)."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normal = np.cross(b - a, c - a)
    square = np.einsum("ij,ij->i", normal, normal)
    safe = np.where(square > 0.0, square, 1.0)
    plane = x - (np.einsum("ij,ij->i", x - a, normal) / safe)[:, None] * normal
    inside = square > 0.0
    best, least = a.copy(), np.full(len(corners), np.inf)
    for p, q in ((a, b), (b, c), (c, a)):
        inside &= np.einsum("ij,ij->i", np.cross(q - p, plane - p), normal) >= 0.0
        step = q - p
        length = np.einsum("ij,ij->i", step, step)
        share = np.clip(np.einsum("ij,ij->i", x - p, step) / np.where(length > 0.0, length, 1.0), 0.0, 1.0)
        foot = p + share[:, None] * step
        apart = np.linalg.norm(x - foot, axis=1)
        best = np.where((apart < least)[:, None], foot, best)
        least = np.minimum(least, apart)
    return np.where(inside[:, None], plane, best)


def unexplained(corners: Array, radius: float, proxy: Array, probe: Array) -> float:
    """Share, 0 to 1, of the direction from probe to proxy that no sum of touched normals explains."""
    apart = proxy - feet(corners, proxy)
    far = np.linalg.norm(apart, axis=1)
    touched = apart[far < radius * (1.0 + 1e-4)] / far[far < radius * (1.0 + 1e-4)][:, None]
    behind = (proxy - probe) / np.linalg.norm(proxy - probe)
    return float(nnls(touched.T, behind)[1]) if len(touched) else 1.0


def strokes(mesh: meshes.Mesh, radius: float, rng: np.random.Generator, count: int) -> list[Array]:
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    middle, reach = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low)) + 3.0 * radius
    paths = []
    for _ in range(count):
        start = rng.normal(size=3)
        start = middle + reach * start / np.linalg.norm(start)
        step = rng.uniform(low, high) - start
        step /= np.linalg.norm(step)
        paths.append(start + STEP * np.arange(int(2.2 * reach / STEP))[:, None] * step)
    return paths


@pytest.mark.sampled(4)
@pytest.mark.parametrize("radius", [0.004, 0.001])
@pytest.mark.parametrize("kind", KINDS)
def test_a_proxy_is_blocked_by_triangles_it_touches(kind: str, radius: float, tmp_path: Path, cases: Cases) -> None:
    mesh = KINDS[kind]
    file = meshes.write_ply(tmp_path / "part.ply", mesh)
    part: dict[str, Any] = make_object("part", "mesh", file=str(file), material=SLIPPERY)
    running = engine(part, fingertip={"radius_m": radius})
    corners = np.ascontiguousarray(mesh.vertices[mesh.triangles])
    for step in strokes(mesh, radius, np.random.default_rng(5), cases(12, 100)):
        running.reset()
        records = np.asarray(running.run(posed(step)))
        proxy = records[:, AT.proxy_position : AT.proxy_position + 3]
        moved = np.linalg.norm(np.diff(proxy, axis=0), axis=1)
        for tick in (*range(199, len(step), 200), len(step) - 1):
            touching = records[tick, AT.contact_mode] != 0
            if not touching:
                assert not records[tick, AT.force : AT.force + 3].any()
            elif moved[tick - 1] < STILL and np.linalg.norm(proxy[tick] - step[tick]) > 1e-6:
                assert unexplained(corners, radius, proxy[tick], step[tick]) < UNEXPLAINED, (kind, radius, tick)


FINGERS = [{"name": name, "radius_m": r, "coupling": STIFF} for name, r in (("thumb", 0.004), ("index", 0.002))]
SWAY = {"kind": "sinusoid", "translation_m": [0.004, -0.003, 0.002], "frequency_hz": 2.0}
SLIDES = ("tube", "needles")
"""Meshes off which a fingertip without friction slides on most strokes."""
REST = [pytest.param(kind, marks=pytest.mark.exhaustive) for kind in KINDS if kind != "lattice"]


@pytest.mark.plain
@pytest.mark.parametrize("moves", [True, pytest.param(False, marks=pytest.mark.exhaustive)])
@pytest.mark.parametrize("kind", ["lattice", *REST])
def test_two_proxies_are_blocked_by_triangles_they_touch(kind: str, moves: bool, tmp_path: Path, cases: Cases) -> None:
    """On separate strokes in the frame of a moving mesh, or on opposite strokes through a fixed one."""
    mesh, count = KINDS[kind], cases(3, 25)
    file, coarse = meshes.write_ply(tmp_path / "part.ply", mesh), cases(2, 1)
    part = make_object("part", "mesh", file=str(file), material=SLIPPERY, **({"motion": SWAY} if moves else {}))
    running = engine(part, fingertip=None, coupling=None, finger=FINGERS)
    corners, blocked = np.ascontiguousarray(mesh.vertices[mesh.triangles]), 0
    ways = [strokes(mesh, f["radius_m"], np.random.default_rng(seed), count) for seed, f in enumerate(FINGERS)]
    for thumb, index in zip(*ways, strict=True):
        ticks = min(len(thumb), len(index)) // coarse
        seconds = 1e-3 * np.arange(1, ticks + 1)[:, None]  # objects are at their position at the end of the tick
        sway = moves * np.sin(2.0 * np.pi * SWAY["frequency_hz"] * seconds) * SWAY["translation_m"]
        forward = thumb[::coarse][:ticks]
        relative = {"thumb": forward, "index": index[::coarse][:ticks] if moves else forward[::-1]}
        running.reset()
        records_of = running.run({name: posed(step + sway) for name, step in relative.items()})
        for name, finger in zip(relative, FINGERS, strict=True):
            records, probe, radius = np.asarray(records_of[name]), relative[name], finger["radius_m"]
            proxy = records[:, AT.proxy_position : AT.proxy_position + 3] - sway
            moved = np.linalg.norm(np.diff(proxy, axis=0), axis=1)
            for tick in (*range(9, ticks, 10), ticks - 1):
                if records[tick, AT.contact_mode] == FREE:
                    assert not records[tick, AT.force : AT.force + 3].any()
                elif moved[tick - 1] < STILL and np.linalg.norm(proxy[tick] - probe[tick]) > 1e-6:
                    blocked += 1
                    assert unexplained(corners, radius, proxy[tick], probe[tick]) < UNEXPLAINED, (kind, name, tick)
    assert blocked or kind in SLIDES


@pytest.fixture(scope="module")
def crumpled() -> meshes.Mesh:
    """A hundred thousand large intersecting triangles: a search rarely finishes within a tick."""
    return hostile_meshes.MANY["crumpled 100k"]()


def test_a_stuck_proxy_restarts_at_the_probe(crumpled: meshes.Mesh, tmp_path: Path, cases: Cases) -> None:
    """Where no search finishes within a tick, a proxy rests, and restarts once the probe is in free space. Strokes 61
    and 95 once ended 0.3 m from the mesh with a proxy that moved by 0.8 um per tick, or in a cycle of three places."""
    file, radius = write_part(tmp_path, *crumpled), 0.002
    running = engine(make_object("part", "mesh", file=file, material=SLIPPERY), fingertip={"radius_m": radius})
    corners = np.ascontiguousarray(crumpled.vertices[crumpled.triangles])
    restarted = 0
    all_strokes = strokes(crumpled, radius, np.random.default_rng(1), 100)
    for step in (all_strokes[k] for k in (*range(cases(12, 100)), 61, 95)):
        running.reset()
        records = np.asarray(running.run(posed(step[::4])))
        restarted += int((records[:, AT.contact_cause] == CAUSE_RESTART).sum())
        assert records[records[:, AT.contact_cause] == CAUSE_RESTART, AT.contact_mode].max(initial=FREE) == FREE
        if records[-1, AT.force : AT.force + 3].any():
            proxy = records[-1, AT.proxy_position : AT.proxy_position + 3]
            assert unexplained(corners, radius, proxy, step[::4][-1]) < UNEXPLAINED
    assert restarted > 0


def test_a_first_touch_is_resolved_or_flagged(crumpled: meshes.Mesh, tmp_path: Path, cases: Cases) -> None:
    """Outside after a tick, or `contact.budget` is nonzero and it is free; no force without contact."""
    file, radius = write_part(tmp_path, *crumpled), 0.002
    running = engine(make_object("part", "mesh", file=file, material=SLIPPERY), fingertip={"radius_m": radius})
    rng, balls = np.random.default_rng(2), balls_of(*crumpled)
    low, high = crumpled.vertices.min(axis=0), crumpled.vertices.max(axis=0)
    points = rng.uniform(low, high, (cases(300, 3000), 3))
    ticks = []
    for point in points:
        running.reset()
        ticks.append(np.asarray(running.run(posed(np.tile(point, (2, 1))))))
    both = np.array(ticks)
    touching = brute_distances(balls, points) < radius * (1.0 - OVERLAP_TOLERANCE)
    assert 0.1 < touching.mean() < 0.9
    for records in (both[:, 0], both[:, 1]):
        free, unknown = records[:, AT.contact_mode] == FREE, records[:, AT.contact_budget] != 0.0
        assert (free <= (unknown | ~touching)).all() and not records[free, AT.force : AT.force + 3].any()
        clearance = brute_distances(balls, records[:, AT.proxy_position : AT.proxy_position + 3]) / radius - 1.0
        assert (clearance[~(free & unknown)] >= -np.where(free, OVERLAP_TOLERANCE, 1e-9)[~(free & unknown)]).all()


@pytest.mark.exhaustive
def test_a_magnet_with_an_unknown_gap_is_flagged(crumpled: meshes.Mesh, tmp_path: Path, cases: Cases) -> None:
    """In free space the magnet's force follows from the distance to all triangles, or `contact.budget` is nonzero.
    Compiled only: plain Python builds the tree of so many triangles in 15 s."""
    file, radius, force, reach = write_part(tmp_path, *crumpled), 1e-5, 2.0, 0.05
    magnet = {"kind": "magnet", "force_n": force, "range_m": reach, "exponent": 1.0}
    part = make_object("part", "mesh", file=file, material=SLIPPERY, effect=[magnet])
    running = engine(part, fingertip={"radius_m": radius})
    low, high = crumpled.vertices.min(axis=0), crumpled.vertices.max(axis=0)
    points = np.random.default_rng(3).uniform(low, high, (cases(8, 1000), 3))
    ticks = []
    for point in points:
        running.reset()
        ticks.append(np.asarray(running.run(posed([point])))[0])
    records = np.array(ticks)
    gap = brute_distances(balls_of(*crumpled), points) - radius
    known = force * np.clip(1.0 - gap / reach, 0.0, 1.0)
    off = np.abs(np.linalg.norm(records[:, AT.force : AT.force + 3], axis=1) - known)
    free, unknown = records[:, AT.contact_mode] == FREE, records[:, AT.contact_budget] != 0.0
    assert (off[free & ~unknown] < 1e-9 * force).all()
    assert (off[free] > 1e-3 * force).any()  # otherwise the test would be empty


@pytest.mark.plain
@pytest.mark.parametrize("speed", [0.3, 3.0])
def test_a_thin_wall_that_sweeps_over_the_hand_touches_it(speed: float, tmp_path: Path) -> None:
    """A box thinner than its travel per tick moves the proxy of a hand that presses into a mesh as on a plane."""
    file = meshes.write_ply(tmp_path / "plate.ply", meshes.moved(meshes.sheet(0.2, 0.2, 8, 8), (-0.1, -0.1, 0.0)))
    wall = make_object(
        "wall", "box", size_m=[2e-4, 0.1, 0.1], position_m=[0.01, 0.0, 0.0], material=SLIPPERY,
        motion={"kind": "sinusoid", "translation_m": [-0.03, 0.0, 0.0], "frequency_hz": speed / (0.03 * 2.0 * np.pi)},
    )  # fmt: skip
    still = np.tile([0.0, 0.0, 0.003], (int(0.03 / speed * 1000), 1))
    mesh = make_object("plate", "mesh", file=str(file), material=SLIPPERY)
    floors = mesh, make_object("plate", "plane", material=SLIPPERY)
    on_mesh, on_plane = (
        np.asarray(engine(floor, wall, fingertip={"radius_m": 0.004}).run(posed(still)))[:, AT.proxy_position :][:, :3]
        for floor in floors
    )
    assert on_plane[-1, 0] < -0.005  # the box met the finger
    np.testing.assert_allclose(on_mesh, on_plane, rtol=0.0, atol=1e-7)


@pytest.mark.parametrize("radius", [0.01, 0.003])
def test_a_plate_is_a_plane_at_any_depth(radius: float, tmp_path: Path, cases: Cases) -> None:
    file = meshes.write_ply(tmp_path / "plate.ply", meshes.sheet(0.2, 0.2, 78, 78))
    running = engine(make_object("plate", "mesh", file=str(file), material=SLIPPERY), fingertip={"radius_m": radius})
    rng, t = np.random.default_rng(1), 1e-3 * np.arange(600)
    for _ in range(cases(10, 200)):
        depth, begin, speed = rng.uniform(0.3, 4.0) * radius, rng.uniform(0.07, 0.13, 2), rng.uniform(-0.08, 0.08, 2)
        height = radius - depth * np.minimum(1.0, 10.0 * t) + 1e-3 * np.sin(9.0 * t)
        step = np.column_stack([begin + t[:, None] * speed, height])
        running.reset()
        records = np.asarray(running.run(posed(step)))
        expected = 1000.0 * np.maximum(radius - height, 0.0)[:, None] * [0.0, 0.0, 1.0]
        np.testing.assert_allclose(records[:, AT.force : AT.force + 3], expected, rtol=0.0, atol=1000.0 * 1e-9)
        proxies = records[:, AT.proxy_position : AT.proxy_position + 3]
        nearest = np.column_stack([step[:, :2], np.maximum(height, radius)])
        np.testing.assert_allclose(proxies, nearest, rtol=0.0, atol=1e-9)  # required of a plate; rounding is 1e-15


def test_a_plate_is_a_plane_next_to_a_vertex(tmp_path: Path, cases: Cases) -> None:
    """The fingertip lands within 0.1 um of a vertex. Deeper than the radius, a search that starts on a facet next to it
    moves away facet by facet, and the tilted plane of a passed facet lifts it by less than a gap can show."""
    radius, pitch, rng = 0.01, 0.2 / 78, np.random.default_rng(5)
    file = meshes.write_ply(tmp_path / "plate.ply", meshes.sheet(0.2, 0.2, 78, 78))
    running = engine(make_object("plate", "mesh", file=str(file), material=SLIPPERY), fingertip={"radius_m": radius})
    for _ in range(cases(300, 30_000)):
        vertex, z = pitch * rng.integers(30, 48, 2), radius * rng.uniform(-3.0, 0.9)
        angles = rng.uniform(0.0, 2.0 * np.pi, 2)
        (end_direction, start_direction) = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        end = vertex + 10.0 ** rng.uniform(-10.0, -7.0) * end_direction
        begin = vertex + 1e-3 * start_direction
        down = np.column_stack([np.tile(begin, (60, 1)), np.linspace(1.1 * radius, z, 60)])
        over = np.column_stack([vertex + np.linspace(1e-3, 2e-4, 6)[:, None] * start_direction, np.full(6, z)])
        running.reset()
        last = np.asarray(running.run(posed(np.concatenate([down, over, [[*end, z]]]))))[-1]
        proxy = last[AT.proxy_position : AT.proxy_position + 3]
        np.testing.assert_allclose(proxy, [*end, radius], rtol=0.0, atol=1e-9)  # required of a plate


@pytest.mark.plain
@pytest.mark.parametrize("kind", ["thread", pytest.param("cup", marks=pytest.mark.exhaustive)])
def test_contacts_sum_to_the_force_unless_the_proxy_is_flagged(kind: str, tmp_path: Path, cases: Cases) -> None:
    """From deep inside, a proxy moves around obstacles for some ticks: `contact.budget` is 2."""
    mesh, radius = KINDS[kind], 0.001
    file = meshes.write_ply(tmp_path / "part.ply", mesh)
    running = engine(make_object("part", "mesh", file=str(file)), fingertip={"radius_m": radius})
    late = 0
    for step in strokes(mesh, radius, np.random.default_rng(7), cases(8, 50)):
        running.reset()
        records = running.run(posed(step[::4]))
        contacts = records["contacts0.force"] + records["contacts1.force"] + records["contacts2.force"]
        off = np.linalg.norm(records["force"] - contacts, axis=1)
        late += int((off > 1e-9).sum())
        assert (records["contact.budget"][off > 1e-9] == ON_ITS_WAY).all()
    assert late > 0
