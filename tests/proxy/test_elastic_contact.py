"""Contact with an elastic object: springs in series, coupling of fingers, energy, and the rigid limit."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from helpers.touching import posed

from softfinger.config.load import describe, load_scene
from softfinger.proxy.elastic import solution
from softfinger.proxy.elastic.prepared import prepare_body
from softfinger.proxy.elastic.solution import ElasticBody, Report
from softfinger.proxy.engine import Engine
from softfinger.proxy.kernels.elastic import step, surfaces
from softfinger.proxy.kernels.elastic.response import compute_node_rows, read_compliance
from softfinger.proxy.kernels.elastic.spots import make_spot
from softfinger.proxy.kernels.jit.arrays import ReadOnly
from softfinger.proxy.kernels.jit.decorators import PLAIN
from softfinger.proxy.kernels.numerics import mat3
from softfinger.proxy.meshes.reading import Arrays
from softfinger.proxy.record import LARGE_STRAIN, UNSOLVED
from softfinger.proxy.scene import start_state

pytestmark = pytest.mark.plain

HEIGHT, RADIUS, STIFFNESS, SIDE = 0.02, 0.008, 1000.0, 800.0


def scene(friction: bool = False, fingers: int = 1, **values: Any) -> Any:
    """Return the pad of `press-a-pad`, which needs no solver, with `values` in its table `elastic`."""
    pad = describe(load_scene("press-a-pad"))["object"][0]
    material: dict[str, Any] = {"stiffness_n_per_m": STIFFNESS}
    if friction:
        material["friction"] = {"static": 0.6, "kinetic": 0.5}
    elastic = pad["elastic"] | {"damping_s": 0.0} | values
    return scene_of(pad | {"elastic": elastic, "material": material, "position_m": [0.0, 0.0, 0.0]}, fingers)


def scene_of(pad: dict[str, Any], fingers: int = 1) -> Any:
    tips: dict[str, Any] = {"fingertip": {"radius_m": RADIUS}}
    if fingers > 1:
        tips = {"finger": [{"name": name, "radius_m": RADIUS} for name in "abcde"[:fingers]]}
    return load_scene({"object": [pad], "coupling": {"stiffness_n_per_m": SIDE}, **tips})


def at(x: float, y: float, depth: float) -> list[float]:
    return [x, y, HEIGHT + RADIUS - depth, 1.0, 0.0, 0.0, 0.0]


def compliance_at(engine: Engine, facet: int, point: Any) -> Any:
    elastic, body = engine.scene.elastic, engine.scene.objects.body
    spot = make_spot(elastic, body, float(facet), tuple(point), (0.0, 0.0, 1.0))
    return np.array(read_compliance(spot, compute_node_rows(elastic, spot, spot)))


def facet_below(engine: Engine, x: float, y: float) -> int:
    mesh = engine.scene.objects.body.shape.row[0]
    corners = mesh.vertices.array.reshape(-1, 3)[mesh.corners.array.reshape(-1, 3)]
    for number, (a, b, c) in enumerate(corners):
        if abs(np.array([a, b, c])[:, 2] - HEIGHT).max() > 1e-6:
            continue
        weights = np.linalg.solve(np.array([[*a[:2], 1.0], [*b[:2], 1.0], [*c[:2], 1.0]]).T, [x, y, 1.0])
        if weights.min() > -1e-9:
            return number
    raise AssertionError("no facet")


def test_the_spring_of_the_finger_is_in_series_with_the_surface() -> None:
    engine, depth = Engine(scene()), 0.0004
    for _ in range(3):
        load = engine.step(at(0.001, 0.002, depth)[:3], [1.0, 0.0, 0.0, 0.0]).normal_force
    # The surface yields sideways, too, so that the contact is slightly to the side of the probe.
    x, y = 0.001, 0.002
    for _ in range(20):
        compliance = compliance_at(engine, facet_below(engine, x, y), (x, y, HEIGHT))
        x, y = 0.001 + compliance[0, 2] * load, 0.002 + compliance[1, 2] * load
    assert load == pytest.approx(
        depth / (1.0 / STIFFNESS + compliance[2, 2]), rel=1e-6
    )  # gmsh rounds heights to 1e-10 m


def path(count: int) -> Any:
    share = np.linspace(0.0, 1.0, count)
    height = HEIGHT + RADIUS + 0.0005 - 0.003 * np.sin(3 * share) ** 2
    return posed(np.stack([0.004 * np.sin(9 * share), 0.003 * np.cos(7 * share), height], axis=1))


@pytest.mark.parametrize("friction", [False, True])
def test_a_stiff_body_has_the_force_of_the_rigid_mesh(tmp_path: Path, friction: bool) -> None:
    stiff = scene(friction, youngs_pa=1e15)
    surface = prepare_body(stiff.object[0]).surface
    lines = ["v {!r} {!r} {!r}".format(*row) for row in surface.vertices.tolist()]
    lines += ["f {} {} {}".format(*row) for row in (surface.triangles + 1).tolist()]
    (tmp_path / "surface.obj").write_text("\n".join(lines))
    pad = describe(stiff)["object"][0] | {"file": str(tmp_path / "surface.obj")}
    rigid = scene_of({key: value for key, value in pad.items() if key != "elastic"})
    forces, expected = Engine(stiff).run(path(200))["force"], Engine(rigid).run(path(200))["force"]
    assert abs(expected).max() > 1.0 and forces == pytest.approx(expected, abs=1e-9)


def test_the_recorded_velocity_is_that_of_the_probe() -> None:
    """The contact is solved relative to the surface: the rate of the surface is added to the relative velocity."""
    config, above = scene(friction=True), np.array([0.0, 0.0, 0.05, 0.0, 0.0, 0.0, 0.0])
    pressed, free = Engine(config).run(path(60)), Engine(config).run(path(60) + above)
    assert abs(pressed["contact.displacement"]).max() > 1e-4 and not free["contact.mode"].any()
    assert pressed["probe.velocity"] == pytest.approx(free["probe.velocity"], abs=1e-9)


def groove(folder: Path, compliance: float) -> Any:
    """Return walls at 45 degrees along y with one compliance (m/N) of all patches: a rigid body on a spring."""
    vertices = np.array([(x, y, abs(x)) for x in (-0.02, 0.0, 0.02) for y in (-0.02, 0.02)])
    triangles = np.array([(0, 2, 3), (0, 3, 1), (2, 4, 5), (2, 5, 3)], np.int32)
    lines = ["v {} {} {}".format(*row) for row in vertices]
    lines += ["f {} {} {}".format(*row) for row in triangles + 1]
    (folder / "groove.obj").write_text("\n".join(lines))
    pad = describe(scene())["object"][0] | {"file": str(folder / "groove.obj")}
    pad["elastic"]["solution"] = str(folder / "groove.npz")
    config = scene_of(pad)
    elastic = config.object[0].elastic
    blocks = np.tile(elastic.youngs_pa * compliance * np.eye(3), (6, 6, 1, 1))
    body = ElasticBody(
        surface=Arrays(vertices, triangles),
        nodes=np.arange(6, dtype=np.int32),
        compliance=ReadOnly(blocks),
        bending=ReadOnly(np.zeros((6, 3, 2))),
        report=Report(6, 1, 6, 1.0, 1.0, [[0.0, 0.0, 0.0]], [1.0], None),
    )
    key = solution.make_identity(config.object[0], elastic, (folder / "groove.obj").read_bytes())
    solution.save(elastic.solution, key, body)
    return config


def test_a_finger_between_two_walls_loads_the_body_with_the_forces_of_both(tmp_path: Path) -> None:
    """Each wall bears its spring times the depth over sqrt(2): together they are as stiff as one spring."""
    depth, compliance = 0.001, 2e-4
    engine = Engine(groove(tmp_path, compliance))
    records = engine.run(np.tile([0.0, 0.003, RADIUS * np.sqrt(2.0) - depth, 1.0, 0.0, 0.0, 0.0], (4, 1)))
    assert (records["contacts1.force"][-1] != 0.0).any()
    force = depth / (1.0 / STIFFNESS + compliance)
    assert records["force"][-1] == pytest.approx([0.0, 0.0, force], abs=1e-6)
    assert records["contact.displacement"][-1] == pytest.approx([0.0, 0.0, -compliance * force], abs=1e-9)


def test_friction_stays_in_its_cone_on_the_deformed_surface() -> None:
    records = Engine(scene(friction=True)).run(path(200))
    normal, tangential = records["contact.normal_force"], records["contact.tangential_force"]
    assert (records["contact.mode"] == 2).any() and (records["contact.mode"] == 1).any()
    assert (tangential <= 0.6 * normal * (1.0 + 1e-9)).all()
    # The slope of the surface adds no force.
    assert np.linalg.norm(records["force"], axis=1) == pytest.approx(np.hypot(normal, tangential), abs=1e-9)


@pytest.mark.skipif(not PLAIN, reason="compiled kernels have the number of rounds as a constant")
def test_a_sliding_contact_is_solved_in_three_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    """The slopes of Newton's method are exact, with friction too: more rounds change nothing."""
    angle = 0.1 + 0.006 * np.arange(120)
    poses = np.array([at(x, y, 0.001) for x, y in zip(0.008 * np.cos(angle), 0.008 * np.sin(angle), strict=True)])
    runs = []
    for rounds in (3, 6):
        monkeypatch.setattr(step, "MAX_RIGID_STEPS", rounds)
        runs.append(Engine(scene(friction=True)).run(poses)[40:])
    assert (runs[1]["contact.mode"] == 2).all()
    assert runs[0]["force"] == pytest.approx(runs[1]["force"], abs=2e-8)  # 1e-11 m of each, at 1000 N/m


def run(engine: Engine, tracks: dict[str, Any]) -> dict[str, Any]:
    return engine.run(tracks) if len(tracks) > 1 else {"a": engine.run(tracks["a"])}


def random_track(random: np.random.Generator, x: float) -> Any:
    """Return 16 poses near `x`, m, 10 um to 5 mm below the top of the pad, with a random speed and acceleration."""
    ticks = np.arange(16)[:, None]
    speed, more = random.normal(size=(2, 3)) * 10.0 ** random.uniform([[-6.0], [-7.0]], [[-3.5], [-4.0]])
    depth, places = 10.0 ** random.uniform(-5.0, -2.3), speed * ticks + 0.5 * more * ticks**2
    return np.array([at(x + a, b, max(depth + c, -0.001)) for a, b, c in places])


@pytest.mark.scaled
@pytest.mark.parametrize("fingers", [1, 2])
def test_the_displacement_is_that_under_the_loads_for_any_modulus(fingers: int, cases: Any) -> None:
    """With friction, from a body a hundred times softer than the finger to a rigid one; otherwise UNSOLVED is set."""
    engine, random = Engine(scene(True, fingers)), np.random.default_rng(58)
    names, errors, unsolved = "ab"[:fingers], [], 0
    for _ in range(cases(12, 500)):
        engine.reset()
        engine.set("object.0.elastic.youngs_pa", 10.0 ** random.uniform(3.0, 9.0))
        tracks = {name: random_track(random, x) for name, x in zip(names, (-0.008, 0.008), strict=False)}
        records = run(engine, tracks)
        for k in range(16):
            touching = [name for name in names if records[name]["contact.mode"][k] > 0]
            spots = [spot_under(engine, records[name], k) for name in touching]
            for name, spot in zip(touching, spots, strict=True):
                expected = np.zeros(3)
                for neighbour, loaded_spot in zip(touching, spots, strict=True):
                    compliance = read_compliance(spot, compute_node_rows(engine.scene.elastic, spot, loaded_spot))
                    expected -= np.array(compliance) @ records[neighbour]["force"][k]
                error = np.linalg.norm(records[name]["contact.displacement"][k] - expected)
                if int(records[name]["contact.nonlinear"][k]) & UNSOLVED:
                    unsolved += 1
                else:
                    errors.append(error)
    assert len(errors) > 100 and unsolved <= 0.01 * len(errors)
    assert max(errors) < surfaces.CORRECTION_ERROR_M and np.quantile(errors, 0.95) < 1e-10


def spot_under(engine: Engine, records: Any, k: int) -> Any:
    point = records["contacts0.point"][k] - records["contact.displacement"][k]
    facet = facet_below(engine, *point[:2])
    return make_spot(engine.scene.elastic, engine.scene.objects.body, float(facet), tuple(point), (0.0, 0.0, 1.0))


@pytest.mark.skipif(not PLAIN, reason="compiled kernels have the number of rounds as a constant")
@pytest.mark.parametrize("fingers", [1, 2])
def test_a_displacement_that_is_not_solved_is_reported_and_not_felt_as_rigid(fingers, monkeypatch):
    """With few rounds; the body bears at most its stiffness times the depth."""
    monkeypatch.setattr(step, "MAX_RIGID_STEPS", 2 + fingers)
    engine, random, unsolved = Engine(scene(True, fingers, youngs_pa=1e3)), np.random.default_rng(58), 0
    compliance = compliance_at(engine, facet_below(engine, 0.0, 0.0), (0.0, 0.0, HEIGHT))[2, 2]
    for _ in range(8):
        engine.reset()
        tracks = {name: random_track(random, x) for name, x in zip("ab"[:fingers], (-0.008, 0.008), strict=False)}
        records = run(engine, tracks)
        for name, track in tracks.items():
            depth = np.maximum(at(0.0, 0.0, 0.0)[2] - track[:, 2], 0.0)
            largest = 2.0 * depth / compliance + STIFFNESS * surfaces.CORRECTION_ERROR_M
            assert (records[name]["contact.normal_force"] <= largest).all()
            unsolved += np.count_nonzero(records[name]["contact.nonlinear"].astype(int) & UNSOLVED)
    assert unsolved > 0


@pytest.mark.skipif(not PLAIN, reason="compiled kernels do not call the replaced function")
@pytest.mark.parametrize("fingers", [1, 2])
def test_a_correction_that_is_not_a_number_is_not_used(fingers: int, monkeypatch: pytest.MonkeyPatch) -> None:
    engine, inverse = Engine(scene(True, fingers)), mat3.inverse
    pose = {name: [at(x, 0.0, 0.001)] for name, x in zip("ab"[:fingers], (-0.008, 0.008), strict=False)}

    def press() -> list[Any]:
        records = run(engine, pose)
        assert all(np.isfinite(rows["force"]).all() for rows in records.values())
        return [int(rows["contact.nonlinear"][-1]) & UNSOLVED for rows in records.values()]

    monkeypatch.setattr(mat3, "inverse", lambda m: tuple((np.nan,) * 3 for _ in range(3)))
    assert press() == [UNSOLVED] * fingers
    monkeypatch.setattr(mat3, "inverse", inverse)
    assert press() == [0] * fingers


@pytest.mark.skipif(not PLAIN, reason="compiled kernels do not call the replaced function")
@pytest.mark.parametrize("fingers", [1, 2])
def test_a_contact_that_moves_in_steps_of_encoders_is_mostly_solved_in_two_rounds(fingers, monkeypatch):
    """The start of a tick takes the motion of all probes into account, not only the change of the last tick."""
    calls: list[Any] = []
    rigid = step.step_finger
    monkeypatch.setattr(step, "step_finger", lambda *arguments: (calls.append(1), rigid(*arguments))[1])
    angle, engine = 0.006 * np.arange(120), Engine(scene(True, fingers))
    slid = np.array([at(x, y, 0.001) for x, y in zip(0.008 * np.cos(angle), 0.008 * np.sin(angle), strict=True)])
    slid[:, :3] = np.round(slid[:, :3] / 1e-5) * 1e-5
    engine.run({"a": slid, "b": slid * [-1.0, -1.0, 1.0, 1.0, 1.0, 1.0, 1.0]} if fingers > 1 else slid)
    assert len(calls) < 2.3 * fingers * len(slid)


def test_an_expected_change_that_is_not_a_number_is_not_used() -> None:
    surface = start_state(Engine(scene()).scene).world.surfaces[0]
    for change, expected in ((np.nan, 0.0), (1.1, 0.0), (0.9, 0.9)):
        assert surfaces.expect(surface, (change, 0.0, 0.0), 1.0) == (expected, 0.0, 0.0)


def test_two_fingers_displace_each_other_through_the_body() -> None:
    engine = Engine(scene(fingers=2))
    pressed, pressing, away = at(-0.004, 0.0, 0.0015), at(0.005, 0.001, 0.0005), at(0.005, 0.001, -0.02)
    records = engine.run({"a": np.tile(pressed, (10, 1)), "b": np.array([away] * 5 + [pressing] * 5)})
    alone, together = records["a"]["force"][4], records["a"]["force"][9]
    single = Engine(scene()).run(np.tile(pressed, (5, 1)))["force"][4]
    assert alone == pytest.approx(single, abs=2e-8)  # each is solved to 1e-11 m, and the spring has 1000 N/m
    assert together[2] < alone[2] - 0.005
    single = Engine(scene()).run(np.tile(pressing, (5, 1)))["force"][4]
    assert records["b"]["force"][9][2] < single[2] - 0.005
    elastic, body = engine.scene.elastic, engine.scene.objects.body
    first, second = (
        make_spot(elastic, body, float(facet_below(engine, *point[:2])), (*point[:2], HEIGHT), (0.0, 0.0, 1.0))
        for point in (pressed, pressing)
    )
    forward = np.array(read_compliance(first, compute_node_rows(elastic, first, second)))
    back = np.array(read_compliance(second, compute_node_rows(elastic, second, first)))
    assert forward == pytest.approx(back.T, abs=1e-10 * abs(forward).max())


def test_the_strains_under_two_fingers_are_added() -> None:
    """One finger strains the pad by less than 10 %."""
    first, second = (np.tile(at(x, 0.0, 0.001), (4, 1)) for x in (-0.009, 0.009))
    assert Engine(scene()).run(first)["contact.nonlinear"][-1] == 0
    both = Engine(scene(fingers=2)).run({"a": first, "b": second})
    assert [both[name]["contact.nonlinear"][-1] for name in "ab"] == [LARGE_STRAIN, LARGE_STRAIN]


def test_the_work_across_facets_is_the_change_of_the_energy_of_springs_and_body() -> None:
    """The force jumps where the contact crosses an edge: steps are halved until each sum over two steps is exact."""
    engine = Engine(scene())

    def step(turn: float) -> tuple[Any, Any, float]:
        pose = at(0.003 * np.cos(turn), 0.003 * np.sin(turn), 0.001 + 0.0005 * np.sin(turn))
        result = engine.step(pose[:3], pose[3:])
        load = -result.normal_force * np.array(result.normal)
        energy = 0.5 * STIFFNESS * result.penetration**2 + 0.5 * load @ result.displacement
        return np.array(pose[:3]), np.array(result.force), energy

    def work(first: float, last: float, start: Any, end: Any, halvings: int = 22) -> Any:
        middle = 0.5 * (first + last)
        half = step(middle)
        whole, parts = trapezoid(start, end), trapezoid(start, half) + trapezoid(half, end)
        if abs(parts - whole) < 1e-10 or halvings == 0:
            return parts + (parts - whole) / 3.0  # Simpson's rule
        return work(first, middle, start, half, halvings - 1) + work(middle, last, half, end, halvings - 1)

    turns = np.linspace(0.0, 2.0 * np.pi, 51)
    ends = [step(turn) for turn in turns[-5:]][-1:] + [step(turn) for turn in turns[1:]]
    works = [work(*turns[k : k + 2], *ends[k : k + 2]) for k in range(50)]
    energies = np.array([end[2] for end in ends])
    assert np.abs(np.diff(energies)).sum() > 5e-4
    assert np.cumsum(works) == pytest.approx(energies[0] - energies[1:], abs=1e-9)


def test_the_forces_of_two_fingers_are_the_gradient_of_the_common_energy() -> None:
    """Without friction, with central differences of 1 um."""
    engine, step_m = Engine(scene(fingers=2)), 1e-6
    places = {"a": np.array(at(-0.0035, 0.001, 0.0015)), "b": np.array(at(0.0045, 0.002, 0.001))}

    def rendered(moved: str = "a", shift: Any = (0.0, 0.0, 0.0)) -> tuple[float, Any]:
        tracks = {name: np.tile(place, (4, 1)) for name, place in places.items()}
        tracks[moved][:, :3] += shift
        records, energy = engine.run(tracks), 0.0
        for rows in records.values():
            load = -rows["contact.normal_force"][-1] * rows["contact.normal"][-1]
            energy += 0.5 * STIFFNESS * rows["contact.penetration"][-1] ** 2
            energy += 0.5 * load @ rows["contact.displacement"][-1]
        return energy, {name: records[name]["force"][-1] for name in places}

    _, forces = rendered()
    for name in places:
        for axis, shift in enumerate(step_m * np.eye(3)):
            slope = (rendered(name, shift)[0] - rendered(name, -shift)[0]) / (2.0 * step_m)
            assert forces[name][axis] == pytest.approx(-slope, abs=1e-5)


def trapezoid(start: Any, end: Any) -> float:
    return float(0.5 * (start[1] + end[1]) @ (end[0] - start[0]))


def test_the_displacement_follows_the_load_with_the_time_constant_of_each_finger() -> None:
    """(1 + T / dt) u_k - T / dt u_k-1 = C f_k: at rest u = C f, of two fingers with different loads."""
    ratio, poses = 20.0, [np.tile(at(x, 0.002, depth), (200, 1)) for x, depth in ((-0.006, 0.001), (0.006, 0.0004))]
    records = Engine(scene(fingers=2, damping_s=ratio * 1e-3)).run(dict(zip("ab", poses, strict=True)))
    slow = Engine(scene(damping_s=ratio * 1e-3))
    single = slow.run(poses[0])
    still = Engine(scene(fingers=2)).run({name: track[:4] for name, track in zip("ab", poses, strict=True)})
    for name in "ab":
        # After 200 ticks 1e-6 of the first difference is left.
        assert records[name]["force"][-1] == pytest.approx(still[name]["force"][-1], abs=1e-6)
    alone = Engine(scene()).run(poses[0][:4])
    assert single["force"][-1] == pytest.approx(alone["force"][-1], abs=1e-6)
    assert np.linalg.norm(alone["force"][-1, :2]) > 0.002, alone["force"][-1]  # the force of the slope
    moved, force = single["contact.displacement"][:, 2], single["force"][:, 2]
    compliances = ((1.0 + ratio) * moved[1:40] - ratio * moved[:39]) / force[1:40]
    # The contact moves sideways with the surface, to where the compliance is a little different.
    assert compliances == pytest.approx(moved[-1] / force[-1], rel=0.02)
    lifted = np.tile(at(0.0, 0.0, -0.02), (10, 1))
    assert slow.run(np.concatenate([lifted, poses[0][:1]]))["force"][-1, 2] < force[0] - 0.05  # it has not come back


def test_forces_and_displacements_turn_with_the_object() -> None:
    turned = np.array([0.5, 0.5, 0.5, 0.5])  # x to y, y to z, z to x
    straight = scene(friction=True, fingers=2)
    upright = msgspec.structs.replace(straight.object[0], orientation_wxyz=tuple(turned.tolist()))
    tracks = {"a": path(80), "b": path(80) + np.array([0.004, 0.002, 0.0, 0.0, 0.0, 0.0, 0.0])}
    rows = np.tile(turned, (80, 1))
    rolled = {name: np.hstack([track[:, [2, 0, 1]], rows]) for name, track in tracks.items()}
    expected = Engine(straight).run(tracks)
    records = Engine(msgspec.structs.replace(straight, object=(upright,))).run(rolled)
    for name in tracks:
        for field, tolerance in (("force", 1e-7), ("contact.displacement", 1e-10), ("contact.point", 1e-10)):
            assert records[name][field] == pytest.approx(expected[name][field][:, [2, 0, 1]], abs=tolerance)
        assert abs(expected[name]["contact.displacement"][:, 2]).max() > 1e-4
