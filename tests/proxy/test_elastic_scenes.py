"""Shipped scenes with an elastic object, which run from shipped solutions without mesher and solver."""

import contextlib
import sys
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import trimesh
from helpers.refusals import refusal

from softfinger.config.load import describe, load_rig, load_scene
from softfinger.config.schema import Elastic, Mesh, Scene
from softfinger.config.sources import FOLDERS
from softfinger.drivers.poses import SHIPPED, load_poses
from softfinger.proxy.elastic import solution
from softfinger.proxy.elastic.deformed import Deformed
from softfinger.proxy.elastic.loads import compute_contact_loads
from softfinger.proxy.elastic.prepared import prepare_body, solve
from softfinger.proxy.engine import Engine
from softfinger.proxy.meshes.reading import read_bytes
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.server.cli import main
from softfinger.server.loop.tuning import make_tuning
from softfinger.server.offline.simulate import simulate
from softfinger.server.wire.events import RecordEvents

pytestmark = pytest.mark.plain

SIZES_M = {"press-a-pad": (0.06, 0.06, 0.02), "bend-a-strip": (0.11, 0.02, 0.003), "squeeze-a-ball": (0.04,) * 3}
NAMES = list(SIZES_M)


def shipped(name: str) -> tuple[Mesh, Elastic]:
    mesh = load_scene(name).object[0]
    assert isinstance(mesh, Mesh) and mesh.elastic is not None and mesh.elastic.solution is not None
    return mesh, mesh.elastic


def identity(mesh: Mesh, elastic: Elastic) -> str:
    return solution.make_identity(mesh, elastic, read_bytes(mesh.file))


@pytest.mark.parametrize("name", NAMES)
def test_shipped_meshes_are_closed_boxes_and_a_ball(name: str) -> None:
    mesh = trimesh.load_mesh(shipped(name)[0].file)
    assert mesh.is_watertight and mesh.extents.tolist() == pytest.approx(SIZES_M[name], rel=1e-3)
    volume = np.prod(SIZES_M[name]) * (np.pi / 6.0 if name == "squeeze-a-ball" else 1.0)
    assert mesh.volume == pytest.approx(volume, rel=0.01)  # the ball of 1280 flat triangles is 0.86 % smaller


@pytest.mark.parametrize("name", NAMES)
def test_shipped_solutions_are_small_and_match_the_scene(name: str) -> None:
    mesh, elastic = shipped(name)
    assert Path(str(elastic.solution)).stat().st_size < 300_000
    body = solution.read(str(elastic.solution), identity(mesh, elastic))
    assert body.report.nodes == len(body.nodes) > 80


@pytest.mark.parametrize("name", NAMES)
def test_shipped_solutions_match_the_solver(name: str) -> None:
    pytest.importorskip("skfem")
    pytest.importorskip("gmsh")
    mesh, elastic = shipped(name)
    saved, solved = prepare_body(mesh).report, solve(mesh, elastic).report
    # Another version of gmsh fills the body with other tetrahedra.
    assert max(solved.compliances) == pytest.approx(max(saved.compliances), rel=0.1)


def test_a_damaged_or_foreign_solution_is_refused(tmp_path: Path) -> None:
    mesh, elastic = shipped("press-a-pad")
    key, data = identity(mesh, elastic), Path(str(elastic.solution)).read_bytes()
    for changes in ({"poisson": 0.3}, {"reach": ()}, {"fixed": ()}):
        with pytest.raises(ValueError, match="solution for other values"):
            solution.read(str(elastic.solution), identity(mesh, msgspec.structs.replace(elastic, **changes)))
    assert identity(mesh, msgspec.structs.replace(elastic, youngs_pa=1.0, damping_s=1.0, solution=None)) == key
    file, random = tmp_path / "pad.npz", np.random.default_rng(46)
    for at in random.integers(len(data), size=40):
        file.write_bytes(data[:at] + bytes([data[at] ^ 0x10]) + data[at + 1 :])
        with contextlib.suppress(ValueError):  # the archive's date and attributes may have any bits
            solution.read(str(file), key)
    for damaged in (data[: len(data) // 2], b"", b"\x80\x04K\x01.", data.replace(b"compliance", b"complianse")):
        file.write_bytes(damaged)
        with pytest.raises(ValueError, match="is "):
            solution.read(str(file), key)
    packed = tmp_path / "packed.npz"
    np.savez_compressed(packed, **{name: np.zeros(1, kind) for name, kind in solution.TYPES.items()})
    with pytest.raises(ValueError, match="is not a solution"):
        solution.read(str(packed), key)


def without(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("gmsh", "skfem", "meshio"):
        monkeypatch.setitem(sys.modules, name, None)


def test_a_missing_extra_is_named_in_one_line(monkeypatch, tmp_path, capsys):
    """`check`, `simulate` and `replay` of a scene that has to be solved; a shipped scene needs no extra."""
    without(monkeypatch)
    monkeypatch.setattr(sys.modules["softfinger.proxy.elastic.prepared"], "_bodies", {})
    assert main(["check", "press-a-pad"]) == 0
    assert "N/m along the normal" in capsys.readouterr().out
    text = (FOLDERS[Scene] / "press-a-pad.toml").read_text("utf-8").replace("poisson = 0.45 ", "poisson = 0.37 ")
    text = text.replace('"press-a-pad.', f'"{FOLDERS[Scene]}/press-a-pad.')
    file = tmp_path / "pad.toml"
    for content in (text, text.replace("solution =", "# solution =")):
        file.write_text(content, "utf-8")
        simulate = ["simulate", "--scene", str(file), "--poses", "tap", "--out", str(tmp_path / "out.csv")]
        replay = ["replay", "tap", "--scene", str(file), "--against", str(tmp_path / "out.csv")]
        for command in (["check", str(file)], simulate, replay):
            assert main(command) == 2
            printed = capsys.readouterr()
            lines = [line for line in printed.err.splitlines() if not line.endswith("not usable") and line.strip()]
            assert len(lines) == 1 and "pip install 'softfinger[elastic]'" in lines[0], printed.err
            assert ("solution for other values" in lines[0]) == (content is text)


def test_a_recording_is_replayed_to_the_bit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = (SHIPPED / "press-a-pad.csv").read_text("utf-8").splitlines(keepends=True)
    (tmp_path / "poses.csv").write_text("".join([lines[0], *lines[100:108]]), "utf-8")  # pressed, then dragged
    recording, scene = str(tmp_path / "a.mcap"), ["--scene", "press-a-pad"]
    assert main(["simulate", *scene, "--poses", str(tmp_path / "poses.csv"), "--out", recording]) == 0
    assert main(["replay", recording, *scene, "--against", recording, "--tolerance", "0"]) == 0
    assert "71 of 71 ticks compared, 0 differ" in capsys.readouterr().out


def test_check_prints_the_stiffness_at_five_points(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "press-a-pad"]) == 0
    printed = capsys.readouterr().out
    places = [line.split("at (")[1].split(") mm")[0] for line in printed.splitlines() if "along the normal" in line]
    assert places == ["0, 0, 20", "-30, -30, 20", "-30, 30, 20", "30, -30, 20", "30, 30, 20"]
    assert "estimated error 2.7 %" in printed and "largest displacement" in printed and "quality" in printed


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"object": [{"shape": "plane", "name": "table", "material": {"stiffness_n_per_m": 500.0}}]}, "single object"),
        ({"finger": [{"name": name, "radius_m": 0.01} for name in "abc"]}, "one or two fingers, but the scene has 3"),
        ({"effect": [{"kind": "viscosity", "damping_ns_per_m": 1.0}]}, "cannot be combined with [[effect]]"),
        ({"motion": {"kind": "driven"}}, "motion: cannot be combined with [object.elastic]"),
        ({"fixed": []}, "elastic.fixed: has no region"),
    ],
)
def test_an_elastic_object_that_does_not_fit_is_refused(more: dict[str, Any], words: str) -> None:
    scene = describe(load_scene("press-a-pad"))
    if "finger" in more:
        scene.pop("fingertip")
    for key, value in more.items():
        if key == "motion":
            scene["object"][0][key] = value
        elif key == "fixed":
            scene["object"][0]["elastic"][key] = value
        else:
            scene[key] = [*scene.get(key, []), *value]
    assert words in refusal(load_scene, scene)


def test_a_cantilever_is_as_stiff_as_a_beam_in_series_with_the_finger() -> None:
    engine, depth, length = Engine("bend-a-strip"), 0.004, 0.09
    poses = np.tile([0.0, 0.0, 0.01 - depth, 1.0, 0.0, 0.0, 0.0], (40, 1))  # until the damping has decayed
    force = engine.run(poses)["force"][-1, 2]
    _, elastic = shipped("bend-a-strip")
    beam = 3.0 * elastic.youngs_pa * 0.02 * 0.003**3 / 12.0 / length**3
    # The patch near the tip also dents the strip, and a plate of this width is 2 % stiffer than a beam.
    assert force == pytest.approx(depth / (1.0 / 1000.0 + 1.0 / beam), rel=0.04)


def test_a_squeeze_by_the_index_finger_loads_the_thumb() -> None:
    """Both recordings at two instants: touched at 1.1 s, squeezed at 1.9 s; each for some ticks of 40 ms at rest."""
    engine = Engine("squeeze-a-ball", rate_hz=25.0)
    tracks: dict[str, Any] = {}
    for finger in ("thumb", "index"):
        poses = load_poses(f"squeeze-{finger}")
        tracks[finger] = np.repeat(np.hstack([poses.position, poses.orientation])[[0, 110, 190]], (1, 8, 8), axis=0)
    records = engine.run(tracks)
    thumb, index = (records[finger]["force"][:, 0] for finger in ("thumb", "index"))
    assert index[16] > 4.0 * index[8] > 0.0
    assert thumb[16] < 1.5 * thumb[8] < 0.0


def pressed(name: str, depth: float, **values: float) -> Any:
    """Return the record after a scene's object was pressed at the origin until its damping has decayed."""
    engine = Engine(name)
    for key, value in values.items():
        engine.set(f"object.0.elastic.{key}", value)
    poses = np.tile([0.0, 0.0, 0.01, 1.0, 0.0, 0.0, 0.0], (45, 1))
    poses[:, 2] -= np.minimum(np.linspace(0.0, 1.5 * depth, 45), depth)  # a jump would end below a thin strip
    return engine.run(poses)


def test_limits_of_linear_elasticity_are_reported_once_each() -> None:
    """A cantilever under a load at its end turns there by F L^2 / 2 E I, and its root has the strain F L h / 2 E I."""
    _, elastic = shipped("bend-a-strip")
    length, height = 0.09, 0.003
    rigidity = elastic.youngs_pa * 0.02 * height**3 / 12.0
    events = RecordEvents()
    named = []
    for depth in (0.0, 0.008, 0.03, 0.03, 0.0, 0.03):
        records = pressed("bend-a-strip", depth)
        force, moved = records["force"][-1, 2], records["contact.displacement"][-1]
        turned, strained = force * length**2 / 2.0 / rigidity, force * length * height / 2.0 / rigidity
        assert strained < 0.1
        # The bound adds the components of the load, and the patch; 10 degrees lie between the two depths.
        expected = (np.linalg.norm(moved) > 0.1 * 0.11403 and 1) + (2 if turned > np.radians(10.0) else 0)
        assert int(records["contact.nonlinear"][-1]) == expected
        reported = events.observe(np.asarray(records)[-1:])
        named += [(event["name"], event["nonlinear"]) for event in reported if event["kind"] == "elastic"]
    assert named[-1] == ("nonlinear", 3) and len(named) == 1
    assert int(pressed("press-a-pad", 0.005, youngs_pa=1e4)["contact.nonlinear"][-1]) & 4
    assert int(pressed("press-a-pad", 0.0005)["contact.nonlinear"][-1]) == 0


TIPS = {
    "press-a-pad": {"": (0.004, 0.003, 0.007)},
    "squeeze-a-ball": {"thumb": (-0.0285, 0.0, 0.0), "index": (0.027, 0.0, 0.0)},
}


@pytest.mark.parametrize("friction", [True, False])
@pytest.mark.parametrize("name", TIPS)
def test_the_loads_displace_the_body_at_the_contacts_as_the_servo_does(name: str, friction: bool) -> None:
    """Without friction, the slope of the surface adds a force that does not load the body."""
    scene = describe(load_scene(name))
    scene["object"][0]["elastic"]["damping_s"] = 0.0
    if not friction:
        del scene["rolling"]
        for law in ("friction", "torsion"):
            scene["object"][0]["material"].pop(law, None)
    deformed = Deformed.of_scene(scene)
    still = {finger: np.tile([*tip, 1.0, 0.0, 0.0, 0.0], (4, 1)) for finger, tip in TIPS[name].items()}
    records = Engine(scene).run(still)
    rows = {finger: np.asarray(records[finger])[-1] for finger in TIPS[name]}
    mesh = load_scene(scene).object[0]
    loads = compute_contact_loads(mesh, rows)
    patches = [(load.finger, load.object, load.patch_radius) for load in loads]
    assert patches == [(finger, 0, mesh.elastic.radius_m) for finger in rows]
    moved = deformed.at(loads) - deformed.vertices
    for load, row in zip(loads, rows.values(), strict=True):
        displacement = row[AT.contact_displacement :][:3]
        near = ((deformed.vertices[deformed.triangles] - load.point) ** 2).sum(axis=(1, 2)).argsort()[:8]
        for facet in near:  # the one that contains the point
            corners = deformed.vertices[deformed.triangles[facet]]
            weights = np.linalg.lstsq(np.vstack([corners.T, np.ones(3)]), np.append(load.point, 1.0), rcond=None)[0]
            if weights.min() > -1e-6 and np.linalg.norm(weights @ corners - load.point) < 1e-7:
                break
        # The displacement is solved to 1e-11 m; the contact may be at an edge of the facet, to 1e-7 m.
        assert np.linalg.norm(displacement) > 2e-4
        assert weights @ moved[deformed.triangles[facet]] == pytest.approx(displacement, abs=1e-7)
    free = {finger: np.zeros(RECORD_SIZE) for finger in rows}
    assert compute_contact_loads(mesh, free) == [] and (deformed.at([]) == deformed.vertices).all()


@pytest.mark.parametrize("name", ["press-a-pad", "squeeze-a-ball"])
def test_the_servo_tick_records_the_pose_of_the_device(name: str) -> None:
    """Guard, passivity and replay need the pose in the world, not the one relative to the displaced surface."""
    names = [finger.name for finger in load_scene(name).fingers]
    tracks = [f"squeeze-{name}" for name in names] if len(names) > 1 else ["press-a-pad"]
    loaded = [load_poses(track) for track in tracks]
    poses = np.stack([np.hstack([recording.position, recording.orientation])[60:130:5] for recording in loaded], axis=1)
    records = simulate(make_tuning(load_scene(name), load_rig("replay").guard), poses, 1000.0)
    assert (np.linalg.norm(records[..., AT.contact_displacement : AT.contact_displacement + 3], axis=-1) > 0.0).any()
    assert (records[..., AT.probe_position : AT.probe_position + 3] == poses[..., :3]).all()
