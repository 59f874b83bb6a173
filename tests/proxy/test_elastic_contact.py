"""Contact with an elastic object: springs in series, coupling of fingers, energy, and the rigid limit."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

pytest.importorskip("skfem")
pytest.importorskip("gmsh")

from softfinger.config.load import load_scene
from softfinger.proxy.elastic.compliance import patch_loads, vertex_normals
from softfinger.proxy.elastic.prepared import body_of, solid_of, volume_of
from softfinger.proxy.elastic.volume import boundary
from softfinger.proxy.engine import Engine
from softfinger.proxy.kernels.elastic import step
from softfinger.proxy.kernels.elastic.spots import respond_alone, respond_to_other, spot_on
from softfinger.proxy.kernels.jit.decorators import PLAIN
from softfinger.proxy.kernels.numerics import mat3
from softfinger.proxy.scene import build_scene

pytestmark = pytest.mark.plain

HEIGHT, RADIUS, STIFFNESS, SIDE = 0.012, 0.008, 1000.0, 800.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("elastic")
    corners = [(x, y, z) for x in (-0.015, 0.015) for y in (-0.015, 0.015) for z in (0.0, HEIGHT)]
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    lines = ["v {} {} {}".format(*each) for each in corners]
    (made / "pad.obj").write_text("\n".join(lines + ["f " + " ".join(str(i + 1) for i in face) for face in faces]))
    return made


def scene(file: Path, youngs_pa: float | None = 1e5, friction: bool = False, fingers: int = 1, **more: Any) -> Any:
    material: dict[str, Any] = {"stiffness_n_per_m": STIFFNESS}
    if friction:
        material["friction"] = {"static": 0.6, "kinetic": 0.5}
    thing: dict[str, Any] = {"shape": "mesh", "name": "pad", "file": str(file), "material": material}
    if youngs_pa is not None:
        fixed = [{"region": "below", "z_m": 1e-5}]
        thing["elastic"] = {
            "youngs_pa": youngs_pa, "poisson": 0.4, "fixed": fixed, "resolution_m": 0.006, **more,
        }  # fmt: skip
    tips: dict[str, Any] = {"fingertip": {"radius_m": RADIUS}}
    if fingers > 1:
        tips = {"finger": [{"name": name, "radius_m": RADIUS} for name in "abcde"[:fingers]]}
    return load_scene({"object": [thing], "coupling": {"stiffness_n_per_m": SIDE}, **tips})


def at(x: float, y: float, depth: float) -> list[float]:
    return [x, y, HEIGHT + RADIUS - depth, 1.0, 0.0, 0.0, 0.0]


def compliance_at(engine: Engine, facet: int, point: Any) -> Any:
    """Return the compliance (3, 3) m/N at a point of a facet."""
    elastic, body = engine.scene.elastic, engine.scene.objects.body
    spot = spot_on(elastic, body, float(facet), tuple(point), (0.0, 0.0, 1.0))
    return np.array(respond_alone(elastic, spot).compliance)


def facet_below(engine: Engine, x: float, y: float) -> int:
    """Return the facet of the top face below a point."""
    mesh = engine.scene.objects.body.shape.row[0]
    corners = mesh.vertices.array.reshape(-1, 3)[mesh.corners.array.reshape(-1, 3)]
    for number, (a, b, c) in enumerate(corners):
        if abs(np.array([a, b, c])[:, 2] - HEIGHT).max() > 1e-6:
            continue
        weights = np.linalg.solve(np.array([[*a[:2], 1.0], [*b[:2], 1.0], [*c[:2], 1.0]]).T, [x, y, 1.0])
        if weights.min() > -1e-9:
            return number
    raise AssertionError("no facet")


def test_the_spring_of_the_finger_is_in_series_with_the_surface(folder: Path) -> None:
    engine, depth = Engine(scene(folder / "pad.obj")), 0.0004
    for _ in range(3):
        load = engine.step(at(0.001, 0.002, depth)[:3], [1.0, 0.0, 0.0, 0.0]).normal_force
    # The surface yields sideways, too, so that the contact is slightly to the side of the probe.
    x, y = 0.001, 0.002
    for _ in range(20):
        found = compliance_at(engine, facet_below(engine, x, y), (x, y, HEIGHT))
        x, y = 0.001 + found[0, 2] * load, 0.002 + found[1, 2] * load
    assert load == pytest.approx(depth / (1.0 / STIFFNESS + found[2, 2]), rel=1e-6)  # gmsh rounds heights to 1e-10 m


def test_a_hundred_contacts_displace_the_surface_as_a_direct_solution_does(folder: Path) -> None:
    from scipy.sparse.linalg import spsolve

    config = scene(folder / "pad.obj")
    thing, kernel = config.object[0], build_scene(config)
    assert thing.elastic is not None
    volume = volume_of(thing, thing.elastic.resolution_m)
    solid = solid_of(volume, thing.elastic)
    mesh = kernel.objects.body.shape.row[0]
    vertices, corners = mesh.vertices.array.reshape(-1, 3), mesh.corners.array.reshape(-1, 3)
    normals = vertex_normals(volume.vertices, boundary(volume))
    random = np.random.default_rng(46)
    facets = random.choice(np.flatnonzero((kernel.elastic.nodes.array[corners] >= 0).all(axis=1)), 100)
    loads, spots, forces = [], [], random.normal(size=(100, 3))
    for facet in facets:
        weights, places = random.dirichlet([1.0, 1.0, 1.0]), vertices[corners[facet]]
        normal = np.cross(places[1] - places[0], places[2] - places[0])
        own = [((volume.vertices - place) ** 2).sum(axis=1).argmin() for place in places]
        patches = patch_loads(solid, volume.vertices[own], normals[own], thing.elastic.radius_m)
        loads.append(np.stack([patch @ weights for patch in patches], axis=1))
        up = tuple((normal / np.linalg.norm(normal)).tolist())
        spots.append(spot_on(kernel.elastic, kernel.objects.body, float(facet), tuple(weights @ places), up))
    nodal = np.stack([load @ force for load, force in zip(loads, forces, strict=True)], axis=1)
    direct = np.zeros(nodal.shape)
    direct[solid.free] = spsolve(solid.matrix, nodal[solid.free])
    for load, spot, force, moved in zip(loads, spots, forces, direct.T, strict=True):
        found = mat3.times(respond_alone(kernel.elastic, spot).compliance, tuple(force))
        assert found == pytest.approx(
            load.T @ moved / thing.elastic.youngs_pa, rel=1e-8, abs=1e-8 * max(map(abs, found))
        )


def path(count: int) -> Any:
    share = np.linspace(0.0, 1.0, count)
    middle = np.stack(
        [
            0.004 * np.sin(9 * share),
            0.003 * np.cos(7 * share),
            HEIGHT + RADIUS + 0.0005 - 0.003 * np.sin(3 * share) ** 2,
        ]
    )
    return np.concatenate([middle.T, np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))], axis=1)


@pytest.mark.parametrize("friction", [False, True])
def test_a_stiff_body_gives_the_forces_of_the_rigid_mesh(folder: Path, friction: bool) -> None:
    stiff = scene(folder / "pad.obj", youngs_pa=1e15, friction=friction)
    surface = body_of(stiff.object[0]).surface
    lines = ["v {!r} {!r} {!r}".format(*each) for each in surface.vertices.tolist()]
    lines += ["f {} {} {}".format(*each) for each in (surface.triangles + 1).tolist()]
    (folder / "surface.obj").write_text("\n".join(lines))
    rigid = scene(folder / "surface.obj", youngs_pa=None, friction=friction)
    found, expected = Engine(stiff).run(path(200))["force"], Engine(rigid).run(path(200))["force"]
    assert abs(expected).max() > 1.0
    assert found == pytest.approx(expected, abs=1e-9)


def test_friction_stays_in_its_cone_on_the_deformed_surface(folder: Path) -> None:
    records = Engine(scene(folder / "pad.obj", friction=True)).run(path(200))
    normal, tangential = records["contact.normal_force"], records["contact.tangential_force"]
    assert (records["contact.mode"] == 2).any() and (records["contact.mode"] == 1).any()
    assert (tangential <= 0.6 * normal * (1.0 + 1e-9)).all()


@pytest.mark.skipif(not PLAIN, reason="compiled kernels have the number of rounds as a constant")
def test_a_sliding_contact_is_solved_in_three_rounds(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The slopes of Newton's method are exact, with friction too: more rounds change nothing."""
    angle = 0.1 + 0.006 * np.arange(120)
    poses = np.array([at(x, y, 0.001) for x, y in zip(0.008 * np.cos(angle), 0.008 * np.sin(angle), strict=True)])
    found = []
    for rounds in (3, 6):
        monkeypatch.setattr(step, "ROUNDS", rounds)
        found.append(Engine(scene(folder / "pad.obj", friction=True)).run(poses)[40:])
    assert (found[1]["contact.mode"] == 2).all()
    assert found[0]["force"] == pytest.approx(found[1]["force"], abs=2e-8)  # 1e-11 m of each, at 1000 N/m


def test_two_fingers_are_coupled_by_the_body(folder: Path) -> None:
    engine = Engine(scene(folder / "pad.obj", fingers=2))
    held, beside, away = at(-0.004, 0.0, 0.0015), at(0.005, 0.001, 0.0005), at(0.005, 0.001, -0.02)
    records = engine.run({"a": np.tile(held, (10, 1)), "b": np.array([away] * 5 + [beside] * 5)})
    alone, together = records["a"]["force"][4], records["a"]["force"][9]
    single = Engine(scene(folder / "pad.obj")).run(np.tile(held, (5, 1)))["force"][4]
    assert alone == pytest.approx(single, abs=2e-8)  # each is solved to 1e-11 m, and the spring has 1000 N/m
    assert together[2] < alone[2] - 0.005
    single = Engine(scene(folder / "pad.obj")).run(np.tile(beside, (5, 1)))["force"][4]
    assert records["b"]["force"][9][2] < single[2] - 0.005
    elastic, body = engine.scene.elastic, engine.scene.objects.body
    one, two = (
        spot_on(elastic, body, float(facet_below(engine, *point[:2])), (*point[:2], HEIGHT), (0.0, 0.0, 1.0))
        for point in (held, beside)
    )
    there, back = (np.array(response.compliance) for response in respond_to_other(elastic, one, two))
    assert there == pytest.approx(back.T, abs=1e-10 * abs(there).max())


def test_the_work_across_facets_is_the_change_of_the_energy_of_springs_and_body(folder: Path) -> None:
    """The force jumps where the contact crosses an edge, so steps are halved until each sum of two is exact."""
    engine = Engine(scene(folder / "pad.obj"))

    def step(turn: float) -> tuple[Any, Any, float]:
        """Return position of the probe, force, and energy."""
        pose = at(0.006 * np.cos(turn), 0.006 * np.sin(turn), 0.001 + 0.0005 * np.sin(turn))
        found = engine.step(pose[:3], pose[3:])
        load = -found.normal_force * np.array(found.normal)
        energy = 0.5 * STIFFNESS * found.penetration**2 + 0.5 * load @ found.displacement
        return np.array(pose[:3]), np.array(found.force), energy

    def work(first: float, last: float, start: Any, end: Any, halvings: int = 22) -> Any:
        middle = 0.5 * (first + last)
        half = step(middle)
        whole, parts = trapezoid(start, end), trapezoid(start, half) + trapezoid(half, end)
        if abs(parts - whole) < 1e-10 or halvings == 0:
            return parts + (parts - whole) / 3.0  # Simpson's rule
        return work(first, middle, start, half, halvings - 1) + work(middle, last, half, end, halvings - 1)

    turns = np.linspace(0.0, 2.0 * np.pi, 51)
    ends = [step(turn) for turn in turns[-5:]][-1:] + [step(turn) for turn in turns[1:]]
    done = [work(*turns[k : k + 2], *ends[k : k + 2]) for k in range(50)]
    energies = np.array([end[2] for end in ends])
    assert np.abs(np.diff(energies)).sum() > 5e-4
    assert np.cumsum(done) == pytest.approx(energies[0] - energies[1:], abs=1e-9)


def test_the_forces_of_two_fingers_are_the_gradient_of_the_common_energy(folder: Path) -> None:
    """Without friction, with central differences of 1 um."""
    engine, step_m = Engine(scene(folder / "pad.obj", fingers=2)), 1e-6
    places = {"a": np.array(at(-0.0035, 0.001, 0.0015)), "b": np.array(at(0.0045, 0.002, 0.001))}

    def rendered(moved: str = "a", shift: Any = (0.0, 0.0, 0.0)) -> tuple[float, Any]:
        """Return energy, and forces by finger, with one finger shifted."""
        tracks = {name: np.tile(place, (4, 1)) for name, place in places.items()}
        tracks[moved][:, :3] += shift
        records, energy = engine.run(tracks), 0.0
        for found in records.values():
            load = -found["contact.normal_force"][-1] * found["contact.normal"][-1]
            energy += 0.5 * STIFFNESS * found["contact.penetration"][-1] ** 2
            energy += 0.5 * load @ found["contact.displacement"][-1]
        return energy, {name: records[name]["force"][-1] for name in places}

    _, forces = rendered()
    for name in places:
        for axis, shift in enumerate(step_m * np.eye(3)):
            slope = (rendered(name, shift)[0] - rendered(name, -shift)[0]) / (2.0 * step_m)
            assert forces[name][axis] == pytest.approx(-slope, abs=1e-5)


def trapezoid(start: Any, end: Any) -> float:
    """Return the work between two steps of the cycle above."""
    return float(0.5 * (start[1] + end[1]) @ (end[0] - start[0]))


def test_a_damped_surface_yields_with_its_time_constant(folder: Path) -> None:
    quick, slow = (Engine(scene(folder / "pad.obj", damping_s=time)) for time in (0.0, 0.05))
    poses = np.tile(at(0.0, 0.0, 0.001), (400, 1))
    end, forces = quick.run(poses)["force"][-1, 2], slow.run(poses)["force"][:, 2]
    assert (np.diff(forces) < 1e-9).all()
    assert forces[0] > end + 0.05
    assert forces[-1] == pytest.approx(end, rel=1e-3)
    lifted = np.tile(at(0.0, 0.0, -0.02), (10, 1))
    assert slow.run(np.concatenate([lifted, poses[:1]]))["force"][-1, 2] < forces[0] - 0.05  # it has not come back


def test_the_displacement_follows_the_load_with_the_time_constant_of_each_finger(folder: Path) -> None:
    """(1 + T / dt) u_k - T / dt u_k-1 = C f_k: at rest u = C f, of two fingers with different loads."""
    ratio, poses = 20.0, [np.tile(at(x, 0.0, depth), (400, 1)) for x, depth in ((-0.006, 0.001), (0.006, 0.0004))]
    records = Engine(scene(folder / "pad.obj", fingers=2, damping_s=ratio * 1e-3)).run(
        dict(zip("ab", poses, strict=True))
    )
    single = Engine(scene(folder / "pad.obj", damping_s=ratio * 1e-3)).run(poses[0])
    still = Engine(scene(folder / "pad.obj", fingers=2)).run(dict(zip("ab", poses, strict=True)))
    for name in "ab":
        assert records[name]["force"][-1] == pytest.approx(still[name]["force"][-1], abs=1e-4)
    alone = Engine(scene(folder / "pad.obj")).run(poses[0])
    assert single["force"][-1] == pytest.approx(alone["force"][-1], abs=1e-4)
    moved, force = single["contact.displacement"][:, 2], single["force"][:, 2]
    compliances = ((1.0 + ratio) * moved[1:40] - ratio * moved[:39]) / force[1:40]
    # The contact moves sideways with the surface, to where the compliance is a little different.
    assert compliances == pytest.approx(moved[-1] / force[-1], rel=0.02)


def test_forces_and_displacements_turn_with_the_object(folder: Path) -> None:
    turned = np.array([0.5, 0.5, 0.5, 0.5])  # x to y, y to z, z to x
    straight = scene(folder / "pad.obj", friction=True, fingers=2)
    upright = msgspec.structs.replace(straight.object[0], orientation_wxyz=tuple(turned.tolist()))
    tracks = {"a": path(80), "b": path(80) + np.array([0.004, 0.002, 0.0, 0.0, 0.0, 0.0, 0.0])}
    rolled = {
        name: np.concatenate([track[:, [2, 0, 1]], np.tile(turned, (80, 1))], axis=1) for name, track in tracks.items()
    }
    expected = Engine(straight).run(tracks)
    found = Engine(msgspec.structs.replace(straight, object=(upright,))).run(rolled)
    for name in tracks:
        for field, tolerance in (("force", 1e-7), ("contact.displacement", 1e-10), ("contact.point", 1e-10)):
            assert found[name][field] == pytest.approx(expected[name][field][:, [2, 0, 1]], abs=tolerance)
        assert abs(expected[name]["contact.displacement"][:, 2]).max() > 1e-4
