"""Contact with one or several meshes by one or two fingers, compared with shapes and closed forms; shading; malformed
meshes. Compiled tests have one type of scene, which compiles for half a minute; the others run as plain Python."""

import numpy as np
import pytest
from helpers import hostile_meshes, meshes
from helpers.hostile_meshes import bar, valley
from helpers.surface_hand import hand
from helpers.touching import SLIPPERY, SMOOTH, Array, R, engine, make_object, spun, visit, wander, write_part
from mesh_truth import ask
from references.brute_force import balls_of, brute_distances

from softfinger.proxy.engine import Engine
from softfinger.proxy.kernels.contact.first_pose import OVERLAP_TOLERANCE
from softfinger.proxy.kernels.jit.pack import flatten
from softfinger.proxy.kernels.shapes.budget import BUDGET
from softfinger.proxy.record import AT


@pytest.mark.plain
def test_a_crease_pushes_with_both_sides(tmp_path):
    """Pressed 1 mm into a right angle, each side bears 1/sqrt(2) N and rubs with mu times that, also on edges between
    triangles. In a turn both resist like a V-block: r mu (f1 + f2), with f1 + f2 = 2 F / (1 + mu^2)."""
    running = engine(make_object("groove", "mesh", file=write_part(tmp_path, *valley(3, 0.1, 0.1))))
    top = R * np.sqrt(2.0)
    press = np.linspace((0.0, -0.05, top + 1e-3), (0.0, -0.05, top - 1e-3), 50)
    drag = np.linspace((0.0, -0.05, top - 1e-3), (0.0, 0.05, top - 1e-3), 300)
    records = visit(running, np.concatenate([press, drag]))
    component = 1.0 / np.sqrt(2.0)
    assert records[49, AT.force : AT.force + 3] == pytest.approx([0.0, 0.0, 1.0], abs=1e-9)
    late = np.asarray(records)[150:]
    assert late[:, AT.force + 1] == pytest.approx(-0.5 * 2.0 * component, abs=1e-6)
    assert late[:, AT.force + 2] == pytest.approx(1.0, abs=1e-6)
    turning = visit(running, np.tile(drag[-1], (200, 1)), spun((0.0, 1.0, 0.0), np.linspace(0.0, 1.0, 200)))
    assert abs(turning[-1, AT.torque + 1]) == pytest.approx(R * 0.5 * 2.0 * component / 1.25, rel=1e-6)


def errors_of_ball(tmp_path, frequency, shading="none"):
    """Errors of a faceted sphere: maxima of force, N, contact point, m, force direction, and its turn per tick."""
    part = meshes.geodesic(frequency, 0.05)
    t = np.linspace(0.0, 1.0, 800)
    directions = np.stack([np.cos(t) * np.cos(0.3 * t), np.sin(t) * np.cos(0.3 * t), np.sin(0.3 * t)], axis=1)
    points = directions * (0.0601 - 1.1e-3 * np.minimum(8.0 * t, 1.0))[:, None]
    turned = spun((0.0, 0.6, 0.8), 0.5 * t)
    file = write_part(tmp_path, *part, name=f"{frequency}.ply")
    faceted = make_object("ball", "mesh", file=file, shading=shading, material=SLIPPERY)
    mesh = visit(engine(faceted), points, turned)[150:]
    height = np.linalg.norm(points, axis=1)[150:, None]
    normals = points[150:] / height
    forces, expected = mesh["force"], 1000.0 * (0.05 + R - height) * normals
    along = forces / np.linalg.norm(forces, axis=1)[:, None]
    true = expected / np.linalg.norm(expected, axis=1)[:, None]
    points_off = mesh["contact.point"] - 0.05 * normals
    return [
        np.linalg.norm(errors, axis=1).max()
        for errors in (forces - expected, points_off, along - true, np.diff(along, axis=0))
    ]


def test_a_faceted_sphere_converges_to_the_sphere(tmp_path):
    """The error of a facet's normal is of first order, that of its depth of second: four times finer facets reduce all
    at least threefold. With shading, the coarse mesh's force has the direction of the sphere's, without steps."""
    coarse, fine = errors_of_ball(tmp_path, 16), errors_of_ball(tmp_path, 64)
    assert all(after < before / 3.0 for before, after in zip(coarse[:3], fine[:3], strict=True))
    shaded = errors_of_ball(tmp_path, 16, "normals")
    assert shaded[2] < 0.25 * coarse[2] and shaded[3] < 0.25 * coarse[3]


def test_an_open_cavity_equals_a_hollow_sphere(tmp_path):
    """A hole smaller than the fingertip; away from it the forces are those of the hollow sphere."""
    ball = meshes.geodesic(16, 0.03)
    lower = ball.vertices[ball.triangles].mean(axis=1)[:, 2] < 0.0295
    file = write_part(tmp_path, ball.vertices, ball.triangles[lower])
    path = wander(4, 1500, 0.024)
    path[:, 2] = -np.abs(path[:, 2])
    path = path * np.minimum(np.arange(1500) / 200.0, 1.0)[:, None]
    closed = write_part(tmp_path, *ball, name="ball.ply")
    cases = (file, False), (file, True), (closed, True)
    sheet, hollow, whole = (visit(engine(make_object("ball", "mesh", file=f, inside=i)), path) for f, i in cases)
    assert (np.asarray(sheet) == np.asarray(hollow)).all()
    assert (whole["contact.mode"] > 0).mean() > 0.1
    np.testing.assert_allclose(hollow["force"], whole["force"], rtol=0.0, atol=1e-6)


def test_a_first_pose_inside_is_pushed_out(tmp_path):
    running = engine(make_object("part", "mesh", file=write_part(tmp_path, *bar(0.03, 0.03, 0.03))))
    records = visit(running, np.tile((0.0, 0.0, 0.028), (5, 1)))
    assert records[-1, AT.force : AT.force + 3] == pytest.approx([0.0, 0.0, 12.0], abs=1e-9)


@pytest.mark.plain
def test_a_finger_at_rest_may_touch_to_rounding(tmp_path):
    """The gap is smaller than the radius by rounding, and the path of the tick has no length."""
    mesh = make_object("part", "mesh", file=write_part(tmp_path, *bar(0.03, 0.03, 0.02)), position_m=[0.0, 0.0, -0.02])
    records = visit(engine(mesh), np.tile([0.002, 0.0045, R], (4, 1)))
    assert not records["force"].any() and np.isfinite(records).all()


def test_a_thin_sheet_is_not_crossed_in_a_tick(tmp_path):
    running = engine(make_object("sheet", "mesh", file=write_part(tmp_path, *meshes.sheet(0.2, 0.2, 20, 20))))
    for side in (1.0, -1.0):
        running.reset()
        records = visit(running, [(0.003, 0.004, side * 0.05), *[(0.003, 0.004, -side * 0.02)] * 10])
        assert records[-1, AT.force + 2] == pytest.approx(side * 30.0, abs=1e-6)


@pytest.mark.plain
@pytest.mark.scaled
def test_a_moving_mesh_carries_and_presses(tmp_path, cases):
    motion = {"kind": "sinusoid", "translation_m": [0.004, 0.0, 0.003], "frequency_hz": 1.0}
    far = make_object("far", "plane", position_m=[0.0, 0.0, -5.0])
    of_triangles = make_object("part", "mesh", file=write_part(tmp_path, *bar(0.03, 0.03, 0.02)), motion=motion)
    shape = make_object("part", "box", size_m=[0.06, 0.06, 0.04], motion=motion)
    points = np.tile((0.0, 0.0, 0.0295), (cases(500, 1500), 1))
    mesh, solid = (visit(engine(body, far), points) for body in (of_triangles, shape))
    assert np.abs(solid["force"]).max() > 1.0
    np.testing.assert_allclose(mesh["force"], solid["force"], rtol=0.0, atol=1e-9)


BALL, DEPTH, DT, WAY, PRESSED = 0.05, 1e-3, 1e-3, 0.012, 200


@pytest.fixture(scope="module")
def balls(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Engine]:
    """Engines with 5120 triangles, one for each shading, without friction: only the normal turns."""
    file = write_part(tmp_path_factory.mktemp("ball"), *meshes.geodesic(16, BALL))
    ball = make_object("ball", "mesh", file=file, material=SLIPPERY)
    return {shading: engine(ball | {"shading": shading}) for shading in ("normals", "none")}


def turned(running: Engine, speed: float) -> Array:
    """Turn of the force per tick, rad, in a drag at `speed` m/s of the proxy, oblique to the triangles."""
    angles = np.concatenate([np.zeros(PRESSED), np.arange(round(WAY / (speed * DT))) * speed * DT / (BALL + R)])
    heights = np.full(len(angles), BALL + R - DEPTH)
    heights[:PRESSED] = np.linspace(BALL + R + 0.1 * DEPTH, BALL + R - DEPTH, PRESSED)
    begin = np.array([0.6, 0.48, 0.64])
    ahead = np.cross(begin, (0.3, -0.5, 0.8))
    ahead /= np.linalg.norm(ahead)
    ways = np.cos(angles)[:, None] * begin + np.sin(angles)[:, None] * ahead
    running.reset()
    forces = visit(running, ways * heights[:, None])["force"][PRESSED:]
    return np.linalg.norm(np.diff(forces / np.linalg.norm(forces, axis=1)[:, None], axis=0), axis=1)


@pytest.mark.parametrize("speed", [0.004, 0.02])
def test_a_shaded_mesh_turns_the_force_like_a_sphere(balls: dict[str, Engine], speed: float) -> None:
    """At most 1.18 times v dt / (R + r), the turn of the sphere's normal: on a facet the contact point moves as fast as
    the probe and meets the sphere's normals at a radius of R instead of R + r - d. Round edges both are constant.
    Triangles of unequal size add five per cent. In numbers: 0.08 mN per N at 4 mm/s, 0.4 at 20."""
    own = speed * DT / (BALL + R)
    steps = turned(balls["normals"], speed)
    assert steps.max() < 1.05 * (BALL + R - DEPTH) / BALL * own
    # The sum over many triangles is the turn of the sphere's normal.
    assert steps.sum() == pytest.approx(own * len(steps), rel=0.05)


@pytest.mark.parametrize("speed", [0.004, 0.02])
def test_an_unshaded_mesh_turns_the_force_at_its_edges(balls: dict[str, Engine], speed: float) -> None:
    """Round an edge the probe is r - d away: the normal turns (R + r - d) / (r - d) = 6.6 times as fast."""
    steps, shaded = turned(balls["none"], speed), turned(balls["normals"], speed)
    travel = speed * DT * (BALL + R - DEPTH) / (BALL + R)
    # The maximum is for a path straight over an edge; a chord differs from its arc by the square of the angle.
    assert 0.95 < steps.max() * (R - DEPTH) / travel < 1.001 and steps.max() > 4.0 * shaded.max()
    assert (steps < 1e-9).mean() > 0.5  # no turn on a facet


OUTSIDE = R * (1.0 - 1e-9)
FINGERS = [{"name": name, "radius_m": R, "coupling": {"stiffness_n_per_m": 1000.0}} for name in ("thumb", "index")]


@pytest.mark.plain
@pytest.mark.scaled
def test_two_fingers_on_one_mesh_are_independent(tmp_path, cases):
    bumpy, ticks = meshes.bumpy_sphere(cases(8, 24), 0.05, height=0.06), cases(120, 1500)
    part = make_object("part", "mesh", file=write_part(tmp_path, *bumpy))
    poses = {name: hand(bumpy, ticks, R, np.random.default_rng(seed)) for seed, name in ((5, "thumb"), (26, "index"))}
    together = engine(part, fingertip=None, coupling=None, finger=FINGERS).run(poses)
    for name, path in poses.items():
        alone = engine(part, fingertip=None, coupling=None, finger=[f for f in FINGERS if f["name"] == name])
        expected = alone.run({name: path})[name]
        assert (expected["contact.mode"] > 0).mean() > 0.2
        np.testing.assert_array_equal(np.asarray(together[name]), np.asarray(expected))


@pytest.mark.plain
@pytest.mark.scaled
def test_meshes_and_shapes_in_one_scene(tmp_path, cases):
    """A mesh box on a plane, a mesh sphere, a sphere; forces as of the equivalent shapes, median to 30 mN."""
    box, ball = bar(0.03, 0.03, 0.02), meshes.moved(meshes.geodesic(cases(10, 24), 0.03), (0.075, 0.0, 0.01))
    floor = make_object("floor", "plane", position_m=[0.0, 0.0, -0.02], material=SMOOTH)
    sphere = make_object("other", "sphere", radius_m=0.02, position_m=[0.0, 0.06, 0.0], material=SMOOTH)
    parts = [
        make_object(name, "mesh", file=write_part(tmp_path, *made, name=f"{name}.ply"), material=SMOOTH)
        for name, made in (("box", box), ("ball", ball))
    ]
    shapes = [
        make_object("box", "box", size_m=[0.06, 0.06, 0.04], material=SMOOTH),
        make_object("ball", "sphere", radius_m=0.03, position_m=[0.075, 0.0, 0.01], material=SMOOTH),
    ]
    first, last = cases(750, 0), cases(1250, 6000)  # over the edge of the box, onto the sphere
    points = wander(3, 6000, 0.06)
    points[:, 2] = 0.02 + 0.3 * points[:, 2]
    points = np.concatenate([np.linspace((0.0, 0.0, 0.2), points[first], 2 * (last - first) // 5), points[first:last]])
    mesh, solid = (visit(engine(*those, floor, sphere, rolling=None), points) for those in (parts, shapes))
    proxies = mesh["proxy.position"]
    for made in (box, ball):
        assert brute_distances(balls_of(*made), proxies).min() >= OUTSIDE
    assert proxies[:, 2].min() >= R * (1.0 - 1e-9) - 0.02
    assert np.linalg.norm(proxies - (0.0, 0.06, 0.0), axis=1).min() >= (R + 0.02) * (1.0 - 1e-9)
    assert len(np.unique(mesh["contact.object"][mesh["contact.mode"] > 0])) >= 2
    # A facet of the sphere is 2.5 mm long and up to 25 um below its sphere: 25 mN. The proxy takes ticks round an edge.
    assert np.median(np.linalg.norm(mesh["force"] - solid["force"], axis=1)) < 0.03


TICKS, STIFFNESS = 3000, 1000.0
STATIC = 0.6
"""Friction coefficient."""
LANES = 8
"""Triangles of the last node of a query, which are tested although the budget is exhausted."""


def smooth_and_rough(tmp_path, made, **keys):
    file = write_part(tmp_path, *made)
    smooth = engine(make_object("part", "mesh", file=file, material=SLIPPERY, **keys))
    return smooth, engine(make_object("part", "mesh", file=file, **keys))


def is_outside(made, records):
    return brute_distances(balls_of(*made), records["proxy.position"]).min() >= OUTSIDE


def largest_query(running, points):
    shape = running.scene.objects.body.shape
    results = np.zeros((len(points), 3))
    ask(shape, flatten(shape), np.ascontiguousarray(points), BUDGET, results)
    return results[:, 2].max()


@pytest.mark.sampled(5)
@pytest.mark.parametrize("name", hostile_meshes.MADE)
def test_it_is_touched_safely(tmp_path, name):
    """Without friction the force is at most the stiffness times the distance from probe to proxy; friction adds at most
    its cone for each of three patches. No query exceeds its budget."""
    made = hostile_meshes.MADE[name]()
    smooth, rough = smooth_and_rough(tmp_path, made)
    poses = hand(made, TICKS, R, np.random.default_rng(4))
    even, rubbed = smooth.run(poses), rough.run(poses)
    assert (even["contact.mode"] > 0).any()
    for records in (even, rubbed):
        assert np.isfinite(np.asarray(records)).all() and is_outside(made, records)
    depth = np.linalg.norm(even["proxy.position"] - even["probe.position"], axis=1)
    rounding = 1e-9 * (1.0 + np.abs(made.vertices).max())
    assert (np.linalg.norm(even["force"], axis=1) <= STIFFNESS * (depth + rounding)).all()
    behind = np.linalg.norm(rubbed["proxy.position"] - rubbed["probe.position"], axis=1)
    limit = STIFFNESS * (behind + rounding) + rubbed["contact.tangential_force"]
    assert (rubbed["contact.normal_force"] <= limit).all()
    loads = sum(np.linalg.norm(rubbed[f"contacts{i}.force"], axis=1) for i in range(3))
    assert (rubbed["contact.tangential_force"] <= STATIC * loads * (1.0 + 1e-9)).all()
    assert largest_query(smooth, np.concatenate([even["proxy.position"], poses[:, :3]])) <= BUDGET + LANES


@pytest.mark.scaled
@pytest.mark.parametrize("room", [1e-6, 0.01, 0.3])
def test_a_fingertip_in_the_centre_of_a_socket(tmp_path, cases, room):
    """The hollow is wider than the fingertip by a fraction `room`. If it fits exactly, no search can decide on contact:
    `contact.budget` is set in every tick, and there is no force."""
    made = hostile_meshes.socket(R * (1.0 + room))
    smooth, rough = smooth_and_rough(tmp_path, made, inside=True)
    path = np.concatenate([np.zeros((20, 3)), wander(6, 1000, 2.0 * R)])
    ways = (path - path[20]) * np.minimum(np.arange(len(path)) / 200.0, 1.0)[:, None]
    even, rubbed = visit(smooth, ways), visit(rough, ways)
    for records in (even, rubbed):
        assert np.isfinite(np.asarray(records)).all()
        behind = np.linalg.norm(records["proxy.position"] - ways, axis=1)
        limit = STIFFNESS * (behind + 1e-9) + records["contact.tangential_force"]
        assert (records["contact.normal_force"] <= limit).all()
        if room < OVERLAP_TOLERANCE:
            assert records["contact.budget"].all() and not records["contact.mode"].any()
            continue
        assert is_outside(made, records[:: cases(6, 1)])
        touching = records["contact.mode"] > 0
        assert touching[np.linalg.norm(ways, axis=1) > 1.001 * room * R].all()


@pytest.mark.parametrize("room", [0.1, 0.3])
def test_a_fingertip_in_a_socket_moves_to_the_side_of_the_hand(tmp_path, room):
    """Without friction, though all triangles are equally close, and the search finishes."""
    smooth, _ = smooth_and_rough(tmp_path, hostile_meshes.socket(R * (1.0 + room)), inside=True)
    for side in np.concatenate([np.eye(3), -np.eye(3), hostile_meshes.directions(7, 100)]):
        last = visit(smooth, np.repeat(R * (room + 0.2) * side[None], 60, axis=0))[-1]
        # It rests on a facet; its tangent deviates by the angle of a facet, or in an edge between two.
        assert last["contact.budget"] == 0 and last["proxy.position"] @ side > 0.99 * room * R


@pytest.mark.parametrize("name", ["star", "messy", "crossing"])
def test_a_delayed_proxy_does_not_let_the_force_jump(tmp_path, name):
    """Up to six radii deep: at most the stiffness times the motion of probe and proxy."""
    made = hostile_meshes.MADE[name]()
    smooth, _ = smooth_and_rough(tmp_path, made)
    start = np.abs(made.vertices).max() + 2.0 * R
    ways = np.concatenate([np.linspace([0.0, 0.0, start], [0.0, 0.0, 0.0], 150), wander(9, TICKS, 6.0 * R)])
    records = visit(smooth, ways)
    assert np.linalg.norm(records["proxy.position"] - ways, axis=1).max() > 2.0 * R
    went = np.linalg.norm(np.diff(ways, axis=0), axis=1)
    went += np.linalg.norm(np.diff(records["proxy.position"], axis=0), axis=1)
    # Lifting a proxy among many facets changes the force by less than 1e-4 of the radius, as does the distribution in a
    # pinch.
    assert (np.linalg.norm(np.diff(records["force"], axis=0), axis=1) <= STIFFNESS * (went + 2e-4 * R)).all()
