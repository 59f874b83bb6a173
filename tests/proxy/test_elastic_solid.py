"""Displacements of elastic bodies compared with closed forms, and refused bodies."""

import logging
from math import log2, pi
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

skfem = pytest.importorskip("skfem")
gmsh = pytest.importorskip("gmsh")

from skfem.models.elasticity import lame_parameters, linear_elasticity  # noqa: E402

from softfinger.config.errors import ConfigError  # noqa: E402
from softfinger.config.load import load_scene  # noqa: E402
from softfinger.proxy.elastic import compliance  # noqa: E402
from softfinger.proxy.elastic.factors import Factors  # noqa: E402
from softfinger.proxy.elastic.prepared import make_solid, make_volume, prepare_body  # noqa: E402
from softfinger.proxy.elastic.solid import Solid  # noqa: E402
from softfinger.proxy.elastic.volume import Volume, check_volume, compute_quality, fill, find_boundary, read_volume  # noqa: E402
from softfinger.proxy.kernels.elastic.response import compute_node_rows, read_compliance  # noqa: E402
from softfinger.proxy.kernels.elastic.spots import make_spot  # noqa: E402
from softfinger.proxy.kernels.numerics import mat3  # noqa: E402
from softfinger.proxy.meshes.prepared import describe_mesh  # noqa: E402
from softfinger.proxy.scene import build_scene  # noqa: E402

pytestmark = pytest.mark.plain

NU = 0.3


def box(x: float, y: float, z: float) -> tuple[Any, Any]:
    corners = np.array([[i, j, k] for i in (0.0, x) for j in (0.0, y) for k in (0.0, z)])
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corners, np.array([t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))])


def on_face(value: float, axis: int) -> Any:
    return lambda x: np.isclose(x[axis], value).astype(float)


def traction(solid: Solid, pressure: Any, direction: Any) -> Any:
    """Return the nodal forces (N,) of a traction `pressure`, N/m^2, at positions (3, ...) along `direction`."""

    @skfem.LinearForm
    def work(v: Any, w: Any) -> Any:
        return pressure(w.x) * sum(component * v[axis] for axis, component in enumerate(direction))

    return work.assemble(skfem.FacetBasis(solid.basis.mesh, solid.basis.elem, intorder=8))


def displacement(solid: Solid, load: Any, point: Any) -> Any:
    nearest = ((solid.volume.vertices - point) ** 2).sum(axis=1).argmin()
    return solid.solve(load[:, None])[solid.basis.nodal_dofs[:, nearest], 0]


def test_a_block_under_uniform_load_shortens_by_its_length_over_e_a() -> None:
    length, width = 0.03, 0.02
    solid = Solid(fill(*box(width, width, length), 0.01), NU, lambda x: np.isclose(x, 0.0))  # symmetry planes
    load = traction(solid, on_face(length, 2), (0.0, 0.0, -1.0))
    shift = displacement(solid, load, (width, width, length))
    assert shift == pytest.approx([NU * width, NU * width, -length], rel=1e-9)


def test_a_cantilever_bends_as_a_beam_with_shear() -> None:
    length, width, height, load = 0.1, 0.02, 0.005, 2.0
    solid = Solid(fill(*box(length, width, height), 0.005), NU, lambda x: np.repeat(x[:, :1] < 1e-9, 3, axis=1))
    end = traction(solid, on_face(length, 0), (0.0, 0.0, -load / (width * height)))
    inertia, shear = width * height**3 / 12.0, 5.0 / 6.0 / (2.0 * (1.0 + NU))
    beam = load * length**3 / (3.0 * inertia) + load * length / (shear * width * height)
    deflection = -displacement(solid, end, (length, 0.5 * width, 0.5 * height))[2]
    assert deflection == pytest.approx(beam, rel=0.02)


def test_a_simply_supported_plate_sags_by_naviers_solution() -> None:
    side, height = 0.1, 0.005

    def held(x: Any) -> Any:
        ends = [np.isclose(x[:, axis], 0.0) | np.isclose(x[:, axis], side) for axis in (0, 1)]
        return np.stack([ends[1], ends[0], ends[0] | ends[1]], axis=1)

    solid = Solid(fill(*box(side, side, height), 0.006), NU, held)
    load = traction(solid, on_face(height, 2), (0.0, 0.0, -1.0))
    bending = height**3 / (12.0 * (1.0 - NU**2))
    shear = 5.0 / 6.0 * height / (2.0 * (1.0 + NU))
    plate = 0.0040624 * side**4 / bending + 0.07367 * side**2 / shear  # Timoshenko, table 8; Mindlin's shear term
    centre = ((solid.volume.vertices - (0.5 * side, 0.5 * side, height)) ** 2).sum(axis=1)
    near = solid.volume.vertices[centre.argmin()]
    shape = np.sin(pi * near[0] / side) * np.sin(pi * near[1] / side)
    assert -displacement(solid, load, near)[2] / shape == pytest.approx(plate, rel=0.03)


def half_space(radius: float, edge: float, far: float) -> Volume:
    """Return a quarter of a block under z = 0 with elements of length `edge` at a disc about the origin."""
    gmsh.initialize([], False, False, False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        block, disc = gmsh.model.occ.addBox(0, 0, -far, far, far, far), gmsh.model.occ.addDisk(0, 0, 0, radius, radius)
        gmsh.model.occ.fragment([(3, block)], [(2, disc)])
        gmsh.model.occ.synchronize()
        field = gmsh.model.mesh.field.add("MathEval")
        gmsh.model.mesh.field.setString(field, "F", f"{edge} + 0.6 * max(0, sqrt(x*x + y*y + z*z) - {1.2 * radius})")
        gmsh.model.mesh.field.setAsBackgroundMesh(field)
        for name in ("MeshSizeExtendFromBoundary", "MeshSizeFromPoints"):
            gmsh.option.setNumber(f"Mesh.{name}", 0)
        gmsh.model.mesh.generate(3)
        tags, points, _ = gmsh.model.mesh.getNodes()
        _, corners = gmsh.model.mesh.getElementsByType(4)
    finally:
        gmsh.finalize()
    place = np.zeros(int(tags.max()) + 1, np.int64)
    place[tags.astype(np.int64)] = np.arange(len(tags))
    return check_volume(points.reshape(-1, 3), place[corners.astype(np.int64)].reshape(-1, 4))


def deflection_under_a_disc(elements: float) -> float:
    """Return the centre deflection under unit pressure on a disc of radius 1, with that many elements a radius."""
    far = 60.0

    def held(x: Any) -> Any:
        rim = (np.isclose(x[:, 0], far) | np.isclose(x[:, 1], far) | np.isclose(x[:, 2], -far))[:, None]
        return np.concatenate([np.isclose(x[:, :2], 0.0), np.zeros((len(x), 1), bool)], axis=1) | rim

    solid = Solid(half_space(1.0, 1.0 / elements, far), NU, held)

    def inside(x: Any) -> Any:
        return ((x[0] ** 2 + x[1] ** 2 < 1.0) & np.isclose(x[2], 0.0)).astype(float)

    return float(-displacement(solid, traction(solid, inside, (0.0, 0.0, -1.0)), (0.0, 0.0, 0.0))[2])


@pytest.mark.exhaustive
def test_a_half_space_under_a_disc_converges_to_boussinesq() -> None:
    coarse, middle, fine = (deflection_under_a_disc(elements) for elements in (2.5, 5.0, 10.0))
    exact = 2.0 * (1.0 - NU**2)
    assert fine == pytest.approx(exact, rel=0.03) and log2(abs((middle - coarse) / (fine - middle))) > 1.5


def test_reciprocity_of_two_patches_before_it_is_imposed() -> None:
    volume = fill(*box(0.03, 0.03, 0.012), 0.006)
    solid = Solid(volume, 0.45, lambda x: np.repeat(x[:, 2:] < 1e-9, 3, axis=1))
    tops = np.array([[0.01, 0.012, 0.012], [0.021, 0.017, 0.012]])
    loads = compliance.make_patch_loads(solid, tops, np.tile([0.0, 0.0, 1.0], (2, 1)), 0.006)
    first, second = (np.stack([load[:, k].toarray()[:, 0] for load in loads], axis=1) for k in (0, 1))
    forward, back = second.T @ solid.solve(first), first.T @ solid.solve(second)
    assert forward == pytest.approx(back.T, rel=1e-10, abs=1e-10 * abs(forward).max())
    assert compliance.solve_patches(solid, loads).compliance[1, 0] == pytest.approx(
        forward, rel=1e-9, abs=1e-9 * abs(forward).max()
    )


def test_every_part_of_a_body_is_solved_separately() -> None:
    """Two blocks that do not touch, as a file of tetrahedra may have; one of them not fixed is refused."""
    single = fill(*box(0.03, 0.02, 0.03), 0.008)
    count = len(single.vertices)
    far = Volume(
        np.concatenate([single.vertices, single.vertices + np.array([0.05, 0.0, 0.0])]),
        np.concatenate([single.tetrahedra, single.tetrahedra + count]),
    )
    solid, both = (Solid(volume, NU, lambda x: np.repeat(x[:, 2:] < 1e-9, 3, axis=1)) for volume in (single, far))
    load = traction(solid, on_face(0.03, 2), (0.0, 0.0, -1.0))
    alone, shifts = solid.solve(load[:, None]), both.solve(traction(both, on_face(0.03, 2), (0.0, 0.0, -1.0))[:, None])
    for part in (0, count):
        nodes = slice(part, part + count)
        assert shifts[both.basis.nodal_dofs[:, nodes], 0] == pytest.approx(
            alone[solid.basis.nodal_dofs, 0], rel=1e-9, abs=1e-9 * abs(alone).max()
        )
    with pytest.raises(ValueError, match="fixed: the body can still move"):
        Solid(far, NU, lambda x: np.repeat((x[:, 2:] < 1e-9) & (x[:, :1] < 0.04), 3, axis=1))


def test_rotation_and_strain_of_the_surface_are_those_of_known_displacements() -> None:
    """Of a small turn by 1 mrad about an axis, and of a stretch by 0.002 along x: one part each, the other is 0."""
    solid = Solid(fill(*box(0.03, 0.03, 0.004), 0.006), NU, lambda x: np.repeat(x[:, 2:] < 1e-9, 3, axis=1))
    turn, places = 1e-3 * np.array([2.0, -1.0, 2.0]) / 3.0, solid.basis.mesh.p.T
    moved = np.zeros((solid.basis.N, 2))
    moved[solid.basis.nodal_dofs.T, 0] = np.cross(turn, places)
    moved[solid.basis.nodal_dofs[0], 1] = 0.002 * places[:, 0]
    largest = compliance.find_largest_rotation_and_strain(compliance.make_surface_gradient(solid), moved)
    assert largest == pytest.approx(np.array([[1e-3, 0.0], [0.0, 0.002]]), abs=1e-12)


def test_the_load_of_a_patch_is_one_newton_at_its_centre() -> None:
    """On a body thinner than the radius of the patch: the lower face bears none of the load."""
    volume = fill(*box(0.03, 0.03, 0.004), 0.006)
    solid = Solid(volume, 0.45, lambda x: np.repeat(x[:, 2:] < 1e-9, 3, axis=1))
    (load, _, _) = compliance.make_patch_loads(
        solid, np.array([[0.014, 0.016, 0.004]]), np.array([[0.0, 0.0, 1.0]]), 0.006
    )
    nodal = load.toarray()[:, 0]
    assert nodal.sum() == pytest.approx(1.0, rel=1e-12)
    # The quadrature of the disc, which the facets cut, has an error of some per cent of its radius.
    assert solid.basis.doflocs @ nodal == pytest.approx([0.014, 0.016, 0.004], abs=0.0003)
    assert solid.basis.doflocs[2] @ nodal == pytest.approx(0.004, rel=1e-9)


def test_the_boundary_is_closed_and_faces_outward() -> None:
    volume = fill(*box(0.03, 0.02, 0.01), 0.006)
    a, b, c = (volume.vertices[find_boundary(volume)[:, i]] for i in range(3))
    assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0 == pytest.approx(0.03 * 0.02 * 0.01, rel=1e-6)
    assert compute_quality(volume).min() > 0.1


def pad_scene(folder: Path, triangles: Any = None, **changes: Any) -> Any:
    vertices, faces = box(0.03, 0.03, 0.012)
    lines = [f"v {x} {y} {z}" for x, y, z in vertices]
    lines += ["f " + " ".join(str(i + 1) for i in face) for face in (faces if triangles is None else faces[triangles])]
    (folder / "pad.obj").write_text("\n".join(lines))
    elastic = {"youngs_pa": 1e5, "poisson": 0.4, "fixed": [{"region": "below", "z_m": 1e-6}], "resolution_m": 0.006}
    block = {"shape": "mesh", "name": "pad", "file": str(folder / "pad.obj"), "material": {"stiffness_n_per_m": 1000.0}}
    return load_scene({"fingertip": {"radius_m": 0.008}, "object": [block | {"elastic": elastic | changes}]})


def pad(folder: Path, **changes: Any) -> Any:
    return pad_scene(folder, **changes).object[0]


@pytest.mark.parametrize("youngs_pa", [1e4, 1e5])
def test_a_block_sags_under_gravity_by_its_weight(tmp_path: Path, youngs_pa: float) -> None:
    """Without lateral strain, each height z of a column of height h sinks by rho g (h z - z^2 / 2) / E."""
    still, sagged = (
        prepare_body(pad(tmp_path, poisson=0.0, youngs_pa=youngs_pa, **more)).surface.vertices
        for more in ({}, {"density_kg_per_m3": 1000.0})
    )
    z = still[:, 2]
    sag = 1000.0 * 9.80665 / youngs_pa * (0.012 * z - 0.5 * z**2)
    assert sagged == pytest.approx(still - sag[:, None] * (0.0, 0.0, 1.0), abs=1e-8 * sag.max())


def test_a_hundred_contacts_displace_the_surface_as_a_direct_solution_does(tmp_path: Path) -> None:
    from scipy.sparse.linalg import spsolve

    config = pad_scene(tmp_path)
    block, kernel = config.object[0], build_scene(config)
    volume = make_volume(block, block.elastic.resolution_m)
    solid = make_solid(volume, block.elastic)
    mesh = kernel.objects.body.shape.row[0]
    vertices, corners = mesh.vertices.array.reshape(-1, 3), mesh.corners.array.reshape(-1, 3)
    normals = compliance.compute_vertex_normals(volume.vertices, find_boundary(volume))
    random = np.random.default_rng(46)
    facets = random.choice(np.flatnonzero((kernel.elastic.nodes.array[corners] >= 0).all(axis=1)), 100)
    loads, spots, forces = [], [], random.normal(size=(100, 3))
    for facet in facets:
        weights, places = random.dirichlet([1.0, 1.0, 1.0]), vertices[corners[facet]]
        normal = np.cross(places[1] - places[0], places[2] - places[0])
        own = [((volume.vertices - place) ** 2).sum(axis=1).argmin() for place in places]
        patches = compliance.make_patch_loads(solid, volume.vertices[own], normals[own], block.elastic.radius_m)
        loads.append(np.stack([patch @ weights for patch in patches], axis=1))
        up = tuple((normal / np.linalg.norm(normal)).tolist())
        spots.append(make_spot(kernel.elastic, kernel.objects.body, float(facet), tuple(weights @ places), up))
    nodal = np.stack([load @ force for load, force in zip(loads, forces, strict=True)], axis=1)
    basis = skfem.Basis(solid.basis.mesh, solid.basis.elem, intorder=2)
    stiffness = linear_elasticity(*lame_parameters(block.elastic.youngs_pa, block.elastic.poisson)).assemble(basis)
    fixed = basis.get_dofs(lambda x: np.isclose(x[2], 0.0))
    free, direct = np.setdiff1d(np.arange(basis.N), fixed), np.zeros(nodal.shape)
    direct[free] = spsolve(stiffness.tocsc()[free][:, free], nodal[free])
    for load, spot, force, moved in zip(loads, spots, forces, direct.T, strict=True):
        shift = mat3.times(read_compliance(spot, compute_node_rows(kernel.elastic, spot, spot)), tuple(force))
        assert shift == pytest.approx(load.T @ moved, rel=1e-8, abs=1e-8 * max(map(abs, shift)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"triangles": slice(1, None)}, "open at 3 edges"),
        ({"fixed": [{"region": "below", "z_m": -1.0}]}, "fixed: the regions contain 0 nodes, at least 3"),
        ({"fixed": []}, "has no region"),
        ({"poisson": 0.5}, "poisson"),
        ({"resolution_m": 1e-5}, "tetrahedra, at most 100,000"),
        ({"reach": [{"region": "below", "z_m": -1.0}]}, "no vertex of the surface"),
    ],
)
def test_bad_bodies_are_refused_in_one_line(tmp_path, caplog, changes, message):
    caplog.set_level(logging.INFO)
    with pytest.raises(ConfigError, match=message) as refused:
        prepare_body(pad(tmp_path, **changes))
    assert "\n" not in str(refused.value)
    assert [record.message for record in caplog.records if record.name.startswith("skfem")] == []


def test_inverted_missing_and_too_many_tetrahedra_are_refused(tmp_path: Path) -> None:
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    with pytest.raises(ValueError, match="tetrahedron 1 is inverted, with 1 in all"):
        check_volume(corners, np.array([[0, 1, 2, 3], [0, 2, 1, 3]]))
    with pytest.raises(ValueError, match="1,000,000 tetrahedra: at most 100,000 can be solved"):
        check_volume(np.zeros((1_000_000, 3)), np.zeros((1_000_000, 4), np.int64))
    meshio = pytest.importorskip("meshio")
    meshio.Mesh(corners, [("triangle", [[0, 1, 2]])]).write(tmp_path / "flat.vtu")
    with pytest.raises(ValueError, match="has no tetrahedra, only triangle"):
        read_volume(str(tmp_path / "flat.vtu"), 1.0)
    meshio.Mesh(corners, [("tetra", [[0, 1, 2, 3]])]).write(tmp_path / "one.vtu")
    assert read_volume(str(tmp_path / "one.vtu"), 0.1).vertices == pytest.approx(0.1 * corners)


def test_tetrahedra_of_second_order_are_read_by_their_corners(tmp_path: Path) -> None:
    meshio = pytest.importorskip("meshio")
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    middle = [0.5 * (corners[a] + corners[b]) for a, b in ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))]
    cells = [("triangle", [[0, 2, 1]]), ("tetra10", [list(range(10))])]
    meshio.Mesh(np.concatenate([corners, middle]), cells).write(tmp_path / "ten.vtu")
    volume = read_volume(str(tmp_path / "ten.vtu"), 1.0)
    assert volume.vertices == pytest.approx(corners) and volume.tetrahedra.tolist() == [[0, 1, 2, 3]]


@pytest.mark.parametrize("ending", [".msh", ".vtu"])
def test_a_file_that_is_no_mesh_is_refused_without_other_output(tmp_path, capfd, ending):
    """As git-lfs leaves it in a clone; meshio prints its own message and exits."""
    pytest.importorskip("meshio")
    file = tmp_path / f"pointer{ending}"
    file.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:4cc3\nsize 5570\n")
    with pytest.raises(ValueError, match="meshio cannot read it: it is damaged or has another format"):
        read_volume(str(file), 1.0)
    assert capfd.readouterr() == ("", "")


def test_a_file_in_millimetres_is_refused_with_its_size(tmp_path: Path) -> None:
    block = msgspec.structs.replace(pad(tmp_path), scale=1000.0)
    with pytest.raises(ConfigError, match=r"tetrahedra, at most.* change `scale` if the body is not 30 x 30 x 12 m"):
        prepare_body(block)


def test_a_full_disk_is_named_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def write(*front: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Factors, "_write", write)
    with pytest.raises(
        ConfigError, match=r"no temporary file in .*: No space left on device: make room, or set TMPDIR"
    ):
        prepare_body(pad(tmp_path, poisson=0.41))


def test_a_tetrahedral_mesh_file_is_used_as_the_body(tmp_path: Path) -> None:
    meshio = pytest.importorskip("meshio")
    volume = fill(*box(0.03, 0.03, 0.012), 0.008)
    meshio.Mesh(volume.vertices, [("tetra", volume.tetrahedra)]).write(tmp_path / "pad.vtu")
    block = msgspec.structs.replace(pad(tmp_path, resolution_m=0.008), file=str(tmp_path / "pad.vtu"))
    report = prepare_body(block).report
    assert report.tetrahedra == len(volume.tetrahedra) and report.error is None
    assert describe_mesh(block).report.watertight


def test_a_body_of_too_many_compliant_vertices_is_refused_before_it_is_solved(tmp_path: Path) -> None:
    meshio = pytest.importorskip("meshio")
    sides = np.linspace(0.0, 0.03, 41)
    mesh = skfem.MeshTet.init_tensor(sides, sides, np.array([0.0, 0.001])).oriented()
    meshio.Mesh(mesh.p.T, [("tetra", mesh.t.T)]).write(tmp_path / "plate.vtu")
    end = [{"region": "half_space", "point_m": [1e-6, 0.0, 0.0], "normal": [1.0, 0.0, 0.0]}]
    block = msgspec.structs.replace(pad(tmp_path, fixed=end), file=str(tmp_path / "plate.vtu"))
    with pytest.raises(ConfigError, match="3,280 compliant surface vertices, at most 2,500 are supported") as refused:
        prepare_body(block)
    assert "\n" not in str(refused.value)
