"""Mesh repair: which defects are repaired, which are only reported; meshes from formulas are the reference."""

import math

import numpy as np
import pytest
from helpers import meshes
from helpers.meshes import Mesh

from softfinger.proxy.meshes.mending import MERGE_DISTANCE_SHARE, mend
from softfinger.proxy.meshes.pieces import find_pieces, list_edges
from softfinger.proxy.meshes.reading import Arrays
from softfinger.proxy.meshes.report import MeshReport, make_report
from softfinger.proxy.meshes.thinning import thin_mesh

BALL = meshes.icosphere(2)
TURNED = Mesh(BALL.vertices, BALL.triangles[:, ::-1])


def mended(mesh: Mesh, loose: bool = False) -> tuple[Arrays, MeshReport]:
    result = mend(Arrays(np.ascontiguousarray(mesh.vertices), np.ascontiguousarray(mesh.triangles)), loose)
    return result.arrays, make_report(result, loose, None)


def soup(mesh: Mesh) -> Mesh:
    corners = mesh.vertices[mesh.triangles].reshape(-1, 3)
    return Mesh(corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3))


@pytest.mark.parametrize(
    ("mesh", "euler", "volume", "share"),
    [
        (meshes.icosphere(0), 2, 2.5361507101204097, 1e-12),
        (meshes.icosphere(4), 2, 4.0 / 3.0 * math.pi, 3e-3),
        (meshes.geodesic(7, 0.5), 2, 4.0 / 3.0 * math.pi * 0.125, 3e-2),
        (meshes.torus(1.0, 0.4, 128, 64), 0, 2.0 * math.pi**2 * 0.16, 3e-3),
        (meshes.cylinder(1.0, 2.0, 128, 5), 2, 2.0 * math.pi, 1e-3),
        (meshes.bumpy_sphere(30, 1.0, 0.02), 2, 4.0 / 3.0 * math.pi, 1e-2),
    ],
    ids=["icosahedron", "ball", "geodesic", "torus", "cylinder", "bumpy"],
)
def test_closed_meshes_are_unchanged(mesh: Mesh, euler: int, volume: float, share: float) -> None:
    (vertices, triangles), report = mended(mesh)
    assert triangles.tobytes() == mesh.triangles.tobytes() and vertices.tobytes() == mesh.vertices.tobytes()
    assert report.watertight and report.bodies == 1 and report.mended == ()
    assert len(vertices) - len(triangles) * 3 // 2 + len(triangles) == euler
    assert report.volume_m3 == pytest.approx(volume, rel=share)  # polyhedra are smaller, by the square of an edge


@pytest.mark.parametrize(
    ("mesh", "edges"),
    [
        (meshes.sheet(columns=8, rows=5), 26),
        (meshes.cylinder(around=32, along=3, ends=False), 64),
        (Mesh(BALL.vertices, BALL.triangles[1:]), 3),
    ],
    ids=["sheet", "tube", "ball with a hole"],
)
def test_open_meshes_report_their_border_edges_and_stay_open(mesh: Mesh, edges: int) -> None:
    (_, triangles), report = mended(mesh)
    assert len(triangles) == len(mesh.triangles)
    assert report.open_edges == edges and not report.watertight and report.volume_m3 is None
    assert f"open, {edges} edges of one" in dict(report.rows())["surface"]


def test_a_moebius_strip_is_reported_and_not_rewound() -> None:
    (_, triangles), report = mended(meshes.moebius())
    assert triangles.tobytes() == meshes.moebius().triangles.tobytes()
    assert (
        "bodies with a single side, such as a Moebius strip, which have no consistent winding: 1" in report.noted
        and report.turned_triangles == 0
    )


@pytest.mark.parametrize("loose", [False, True])
def test_coincident_vertices_are_merged(loose: bool) -> None:
    mesh = soup(BALL)
    mesh.vertices[mesh.vertices == 0.0] = -0.0
    (vertices, triangles), report = mended(mesh, loose)
    assert report.watertight and len(vertices) == len(BALL.vertices) and report.merged_vertices == 960 - 162
    np.testing.assert_array_equal(vertices[triangles], BALL.vertices[BALL.triangles])


def test_vertices_of_stl_are_merged_within_a_tolerance() -> None:
    rng = np.random.default_rng(3)
    mesh = soup(BALL)
    near = Mesh(mesh.vertices + rng.uniform(-0.1, 0.1, mesh.vertices.shape) * MERGE_DISTANCE_SHARE, mesh.triangles)
    far = Mesh(mesh.vertices + rng.uniform(-20, 20, mesh.vertices.shape) * MERGE_DISTANCE_SHARE, mesh.triangles)
    assert mended(near, loose=True)[1].watertight and mended(near)[1].bodies == 320
    assert not mended(far, loose=True)[1].watertight
    assert "vertices merged that coincide within 1e-09 of its size: 798" in mended(near, loose=True)[1].mended[0]


def test_duplicate_and_degenerate_triangles_are_dropped() -> None:
    a, b, c = BALL.triangles[0]
    middle = 0.5 * (BALL.vertices[a] + BALL.vertices[b])
    vertices = np.concatenate([BALL.vertices, [middle, [9.0, 9.0, 9.0]]])
    more = [[b, c, a], [c, b, a], [a, a, b], [a, b, 162]]
    (remaining, triangles), report = mended(Mesh(vertices, np.concatenate([BALL.triangles, more]).astype(np.int32)))
    assert (report.duplicate_triangles, report.degenerate_triangles, report.unused_vertices) == (2, 2, 1)
    assert triangles.tobytes() == BALL.triangles.tobytes() and len(remaining) == 162 and report.watertight


@pytest.mark.parametrize("thinness", [1e-3, 1e-6])
def test_thin_triangles_are_preserved(thinness: float) -> None:
    for size in (1e-6, 1e3):
        vertices = size * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, thinness, 0.0]])
        (_, triangles), report = mended(Mesh(vertices, np.array([[0, 1, 2]], np.int32)))
        assert len(triangles) == 1 and report.degenerate_triangles == 0


def test_an_edge_of_three_triangles_is_reported() -> None:
    a, b, _ = BALL.triangles[0]
    fin = np.concatenate([BALL.triangles, [[a, b, 162]]]).astype(np.int32)
    _, report = mended(Mesh(np.concatenate([BALL.vertices, [[0.0, 0.0, 3.0]]]), fin))
    assert report.non_manifold_edges == 1 and not report.watertight and report.bodies == 2


def test_a_sphere_inside_out_is_turned() -> None:
    (_, triangles), report = mended(TURNED)
    assert report.turned_triangles == 320 and report.volume_m3 == pytest.approx(meshes.volume(BALL))
    wound = BALL.triangles.copy()
    some = np.random.default_rng(1).random(320) < 0.3
    wound[some] = wound[some][:, ::-1]
    (_, triangles), report = mended(Mesh(BALL.vertices, wound))
    assert report.turned_triangles == some.sum() and report.watertight
    assert meshes.volume(Mesh(BALL.vertices, triangles)) == pytest.approx(meshes.volume(BALL))


def test_a_sheet_gets_the_winding_of_its_majority() -> None:
    mesh = meshes.sheet()
    wound = mesh.triangles.copy()
    wound[:20] = wound[:20][:, ::-1]
    (_, triangles), report = mended(Mesh(mesh.vertices, wound))
    assert report.turned_triangles == 20
    assert list_edges(triangles).counts.max() == 2 and not find_pieces(list_edges(triangles)).turned.any()


def test_inward_winding_is_preserved_only_for_hollows() -> None:
    small = meshes.icosphere(2, 0.5)
    inward = Mesh(small.vertices, small.triangles[:, ::-1])
    _, report = mended(meshes.joined(BALL, inward))
    assert report.turned_triangles == 0 and report.bodies == 2 and report.watertight
    assert report.volume_m3 == pytest.approx(0.875 * meshes.volume(BALL))
    _, report = mended(meshes.joined(BALL, meshes.moved(inward, (3.0, 0.0, 0.0))))
    assert report.turned_triangles == 320 and report.volume_m3 == pytest.approx(1.125 * meshes.volume(BALL))


def test_thinned_meshes_preserve_the_shape() -> None:
    ball = meshes.geodesic(60)
    thin = thin_mesh(Arrays(*ball), 5000)
    assert 1000 < len(thin.triangles) <= 5000
    # A cell is at most a twentieth of the radius: vertices inside it are off by the square of half of it.
    assert np.abs(np.linalg.norm(thin.vertices, axis=1) - 1.0).max() < 0.02
    assert meshes.volume(Mesh(*thin)) == pytest.approx(meshes.volume(ball), rel=0.05)
    assert thin_mesh(Arrays(*BALL), 320).triangles is BALL.triangles
    for width in (1.0, 1e-3, 1e-9):  # the narrower the strip, the fewer cells
        assert len(thin_mesh(Arrays(*meshes.sheet(width, 1.0, columns=100, rows=100)), 500).triangles) <= 500
    assert len(thin_mesh(Arrays(*meshes.sheet(columns=100, rows=100)), 500).triangles) > 100
