"""Mesh files: formats are read back unchanged; damaged or malicious files raise one error or give a valid mesh; the
cache of mesh trees on disk: loaded bit for bit, rejected when damaged, bounded in size."""

import itertools
import json
import os
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from helpers import meshes
from helpers.examples import examples
from helpers.glb_files import Glb
from helpers.meshes import Mesh
from helpers.refusals import refusal
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from softfinger.config import schema
from softfinger.config.errors import ConfigError
from softfinger.proxy.kernels.jit.cache import Folder
from softfinger.proxy.meshes import array_cache, prepared
from softfinger.proxy.meshes import tree as trees
from softfinger.proxy.meshes.prepared import describe_mesh, load_latest_picture, prepare_tree
from softfinger.proxy.meshes.reading import Arrays, parse_mesh, read_bytes
from softfinger.proxy.meshes.tree import Tree
from softfinger.server.cli import main

pytestmark = pytest.mark.plain
BALL = meshes.geodesic(3)
FLOAT32 = 1.2e-7
"""Relative rounding of STL and of trimesh's binary formats."""


def mesh_entry(path: Path | str, **keys: Any) -> schema.Mesh:
    return schema.Mesh(name="part", file=str(path), material=schema.Material(stiffness_n_per_m=1000.0), **keys)


def mesh_refusal(path: Path, **keys: Any) -> str:
    """Return the error for an unusable file, without its prefix: one line that names object and file."""
    text = refusal(describe_mesh, mesh_entry(path, **keys))
    assert "\n" not in text and text.startswith(f"object 'part': file: {path}: ") and len(text) < 600
    return text.removeprefix(f"object 'part': file: {path}: ")


def corners(mesh: Arrays | Mesh) -> np.ndarray:
    """Coordinates of all corners (m, 3, 3) in a canonical order of triangles and corners."""
    points = mesh.vertices[mesh.triangles]
    keys = np.round(points, 6)
    least = np.array([min(range(3), key=lambda k: tuple(triple[k])) for triple in keys])
    turned = np.array([np.roll(triangle, -start, axis=0) for triangle, start in zip(points, least, strict=True)])
    return turned[np.lexsort(np.round(turned, 6).reshape(len(turned), -1).T[::-1])]


def ply_text(mesh: Mesh) -> bytes:
    """Return an ASCII PLY file, not written by trimesh."""
    rows = [" ".join(map(repr, map(float, vertex))) for vertex in mesh.vertices]
    faces = [" ".join(map(str, (3, *triangle))) for triangle in mesh.triangles]
    head = [
        "ply", "format ascii 1.0", "comment by hand",
        f"element vertex {len(rows)}", *(f"property double {axis}" for axis in "xyz"),
        f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header",
    ]  # fmt: skip
    return "\n".join([*head, *rows, *faces, ""]).encode()


def stl_binary(mesh: Mesh) -> bytes:
    """Return a binary STL file, not written by trimesh; its normals are zero, as from many programs."""
    body = b"".join(struct.pack("<12fH", 0, 0, 0, *mesh.vertices[triangle].ravel(), 0) for triangle in mesh.triangles)
    return b"by hand".ljust(80) + struct.pack("<I", len(mesh.triangles)) + body


def glb_binary(mesh: Mesh, changes: Callable[[dict[str, Any]], None] = lambda head: None) -> bytes:
    made = Glb()
    places = {"POSITION": made.add(mesh.vertices.astype(np.float32))}
    indices = made.add(mesh.triangles.astype(np.uint32).ravel())
    return made.data([{"attributes": places, "indices": indices}], changes=changes)


def encode_mesh(mesh: Mesh, kind: str) -> bytes:
    made = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)
    if kind == "ply text":
        return trimesh.exchange.ply.export_ply(made, encoding="ascii")
    data = made.export(file_type={"stl text": "stl_ascii"}.get(kind, kind))
    return data if isinstance(data, bytes) else data.encode()


FILES: dict[str, tuple[str, bytes]] = {
    "ply": (".ply", encode_mesh(BALL, "ply")),
    "ply text": (".ply", encode_mesh(BALL, "ply text")),
    "stl": (".stl", encode_mesh(BALL, "stl")),
    "stl text": (".stl", encode_mesh(BALL, "stl text")),
    "obj": (".obj", encode_mesh(BALL, "obj")),
    "glb": (".glb", encode_mesh(BALL, "glb")),
    "ply by hand": (".ply", ply_text(BALL)),
    "stl by hand": (".stl", stl_binary(BALL)),
    "glb by hand": (".glb", glb_binary(BALL)),
}


@pytest.mark.parametrize("name", FILES)
def test_every_format_is_read_back_unchanged(tmp_path: Path, name: str) -> None:
    ending, data = FILES[name]
    path = tmp_path / f"ball{ending}"
    path.write_bytes(data)
    report, picture = describe_mesh(mesh_entry(path))
    assert (report.triangles, report.vertices, report.bodies, report.watertight) == (180, 92, 1, True)
    assert report.turned_triangles == report.duplicate_triangles == report.degenerate_triangles == 0
    # Text by trimesh has eight digits; the other files are float32 or exact.
    np.testing.assert_allclose(corners(picture), corners(BALL), atol=1e-7)
    # Rounding of the volume: three float32 coordinates.
    assert report.volume_m3 == pytest.approx(meshes.volume(BALL), rel=3 * FLOAT32)


def test_text_files_preserve_all_digits(tmp_path: Path) -> None:
    (tmp_path / "ball.ply").write_bytes(ply_text(BALL))
    read = parse_mesh("ball.ply", read_bytes(tmp_path / "ball.ply"))
    assert read.vertices.tobytes() == BALL.vertices.tobytes() and read.triangles.tobytes() == BALL.triangles.tobytes()


def test_glb_nodes_place_their_meshes(tmp_path: Path) -> None:
    def two(head: dict[str, Any]) -> None:
        head["nodes"] = [{"mesh": 0, "translation": [5, 0, 0]}, {"mesh": 0, "scale": [-0.5, 0.5, 0.5]}]
        head["scenes"] = [{"nodes": [0, 1]}]

    (tmp_path / "two.glb").write_bytes(glb_binary(BALL, two))
    report, picture = describe_mesh(mesh_entry(tmp_path / "two.glb"))
    assert report.bodies == 2 and report.watertight and report.turned_triangles == 0
    assert report.volume_m3 == pytest.approx(1.125 * meshes.volume(BALL), rel=3 * FLOAT32)
    np.testing.assert_allclose(picture.vertices[:, 0].max(), 5.0 + BALL.vertices[:, 0].max(), rtol=FLOAT32)


def test_scale_converts_to_metres(tmp_path: Path) -> None:
    (tmp_path / "ball.stl").write_bytes(stl_binary(meshes.geodesic(3, 20.0)))
    report = describe_mesh(mesh_entry(tmp_path / "ball.stl", scale=0.001)).report
    assert report.volume_m3 == pytest.approx(meshes.volume(BALL) * 0.02**3, rel=3 * FLOAT32)
    assert "m in size, must be 1e-06 to 1000" in mesh_refusal(tmp_path / "ball.stl", scale=100.0)
    (tmp_path / "far.ply").write_bytes(ply_text(Mesh(1e300 * BALL.vertices, BALL.triangles)))
    assert "is inf m in size" in mesh_refusal(tmp_path / "far.ply", scale=1e9)


def with_bad_vertices(value: float) -> Mesh:
    return Mesh(np.where(BALL.vertices > 0.9, value, BALL.vertices), BALL.triangles)


def test_check_prints_the_mesh_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "ball.stl").write_bytes(stl_binary(BALL))
    scene = tmp_path / "scene.toml"
    scene.write_text(
        '[fingertip]\nradius_m = 0.01\n[[object]]\nname = "part"\nshape = "mesh"\nfile = "ball.stl"\n'
        "[object.material]\nstiffness_n_per_m = 1000.0\n"
    )
    assert main(["check", str(scene)]) == 0
    output = capsys.readouterr().out
    assert re.search(r"triangles +180 on 92 vertices\n", output)
    assert re.search(r"surface +watertight, 3\.9\d+ m\^3\n", output)
    assert re.search(r"mended +vertices merged that coincide within 1e-09 of its size: 448\n", output)
    assert main(["check", "--json", str(scene)]) == 0
    (summary,) = json.loads(capsys.readouterr().out)
    assert summary["meshes"]["part"]["triangles"] == 180 and summary["meshes"]["part"]["open_edges"] == 0
    scene.write_text(scene.read_text().replace('"ball.stl"\n', '"ball.stl"\ninside = true\n'))
    assert main(["check", str(scene)]) == 0 and "does nothing" not in capsys.readouterr().out
    (tmp_path / "ball.stl").write_bytes(stl_binary(Mesh(BALL.vertices, BALL.triangles[1:])))
    assert main(["check", str(scene)]) == 0
    assert re.search(r"inside +inside = true has no effect: it has 3 open edges, .*close", capsys.readouterr().out)
    (tmp_path / "ball.stl").write_bytes(stl_binary(BALL)[:-7])
    assert main(["check", str(scene)]) == 2
    assert "object 'part': file:" in (output := capsys.readouterr().err) and "it is truncated" in output


def test_missing_files_raise_a_one_line_error(tmp_path: Path) -> None:
    assert "No such file" in mesh_refusal(tmp_path / "none.ply")
    (tmp_path / "folder.stl").mkdir()
    assert "Is a directory" in mesh_refusal(tmp_path / "folder.stl")
    assert "must be one of .ply, .stl, .obj, .glb" in mesh_refusal(tmp_path / "part.step")


UNUSABLE: list[tuple[str, bytes, str]] = [
    ("a.ply", b"", "is not a PLY file: it starts with b''"),
    ("a.ply", FILES["stl"][1], "is not a PLY file"),
    ("a.stl", FILES["ply"][1], "it is truncated or not an STL file"),
    ("a.glb", FILES["obj"][1], "not a GLB file"),
    ("a.obj", FILES["stl by hand"][1], "has no triangles: it is damaged"),
    ("a.obj", b"hello\n", "has no triangles: it is damaged"),
    ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "has no triangles"),
    ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "face 1 has the vertex 9, but there are 1 to 3"),
    ("a.ply", ply_text(Mesh(BALL.vertices, BALL.triangles[:0])), "has no triangles"),
    ("a.ply", ply_text(Mesh(BALL.vertices, BALL.triangles + 60)), "there are vertices 0 to 91"),
    ("a.ply", ply_text(Mesh(BALL.vertices, BALL.triangles - 1)), "there are vertices 0 to 91"),
    ("a.obj", b"v 0\nv 1\nv 2\nf 1 2 3\n", "must have three coordinates"),
    ("a.ply", ply_text(with_bad_vertices(np.nan)), "must be finite"),
    ("a.ply", ply_text(with_bad_vertices(np.inf)), "must be finite"),
    ("a.ply", ply_text(Mesh(0.0 * BALL.vertices, BALL.triangles)), "is 0 m in size, must be 1e-06 to 1000"),
    ("a.ply", ply_text(Mesh(4e-7 * BALL.vertices, BALL.triangles)), "set `scale` to the metres per unit"),
    ("a.ply", ply_text(Mesh(600.0 * BALL.vertices, BALL.triangles)), "must be 1e-06 to 1000"),
    ("a.ply", ply_text(Mesh(1e300 * BALL.vertices, BALL.triangles)), "must be 1e-06 to 1000"),
    ("a.ply", ply_text(Mesh(BALL.vertices + 2e3, BALL.triangles)), "move it to the origin"),
    ("a.ply", ply_text(Mesh(BALL.vertices[:3] * [1, 0, 0], np.array([[0, 1, 2]]))), "has no triangle with an area"),
    ("a.ply", FILES["ply by hand"][1][:-30], "it is truncated or damaged"),
    ("a.ply", FILES["ply"][1][:-1], "it is truncated or damaged"),
    ("a.stl", FILES["stl"][1][:-1], "it is truncated"),
    ("a.stl", FILES["stl text"][1][:-500], "has no endsolid at its end: it is truncated"),
    ("a.glb", FILES["glb"][1][:-1], "is damaged or not a GLB file"),
    ("a.ply", FILES["ply"][1].replace(b"face 180", b"face 19999999"), "declares 19,999,999 entries of face"),
    ("a.ply", ply_text(BALL).replace(b"face 180", b"face 1800000"), "declares 1,800,000 entries of face, but has 180"),
    ("a.ply", ply_text(BALL).replace(b"face 180", b"face 181"), "declares 181 entries of face, but has 180"),
    ("a.ply", FILES["ply"][1].replace(b"face 180", b"face -5"), "is damaged or not a PLY file"),
    ("a.ply", FILES["ply"][1].replace(b"face 180", b"face 9" + 30 * b"9"), "is damaged or not a PLY file"),
    ("a.stl", stl_binary(BALL)[:80] + b"\xff\xff\xff\xff" + stl_binary(BALL)[84:], "states 4,294,967,295"),
    ("a.glb", glb_binary(BALL, lambda head: head["accessors"][0].update(count=1 << 40)), "or not a GLB file"),
    ("a.glb", glb_binary(BALL, lambda head: head.update(extensionsRequired=["KHR_draco_mesh_compression"])),
     "is compressed (KHR_draco_mesh_compression)"),
    ("a.glb", glb_binary(BALL, lambda head: head["buffers"][0].update(uri="../../etc/passwd")), "in another file"),
    ("a.glb", glb_binary(BALL, lambda head: head["buffers"][0].update(uri="http://example.org/x")), "in another file"),
    ("a.glb", glb_binary(BALL, lambda head: head.update(nodes=None)), "is damaged or not a GLB file"),
    ("a.glb", glb_binary(BALL, lambda head: head.update(nodes=[{"children": [0]}])), ""),
]  # fmt: skip


@pytest.mark.parametrize(("name", "data", "text"), UNUSABLE, ids=range(len(UNUSABLE)))
def test_unusable_files_raise_a_one_line_error(tmp_path: Path, name: str, data: bytes, text: str) -> None:
    (tmp_path / name).write_bytes(data)
    assert text in mesh_refusal(tmp_path / name)


def test_a_changed_file_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "ball.ply"
    path.write_bytes(ply_text(BALL))
    first = describe_mesh(mesh_entry(path))
    assert describe_mesh(mesh_entry(path)) is first
    path.write_bytes(ply_text(meshes.geodesic(4)))
    assert load_latest_picture(mesh_entry(path)) is first  # the rendered mesh does not change with the file
    assert describe_mesh(mesh_entry(path)).report.triangles == 320
    path.unlink()
    assert load_latest_picture(mesh_entry(path)).report.triangles == 320


NUMBERS = itertools.count()
"""Numbers of files: a file with the same name, size and time as another would be taken from the cache."""


def sound_or_refused(ending: str, data: bytes, folder: Path) -> None:
    path = folder / f"{next(NUMBERS)}{ending}"
    path.write_bytes(data)
    message = ""
    try:
        report, (vertices, triangles) = describe_mesh(mesh_entry(path))
    except ConfigError as error:
        message = str(error)
    if message:
        assert "\n" not in message
        return
    assert report.triangles == len(triangles) > 0 and report.vertices == len(vertices)
    assert np.isfinite(vertices).all() and np.abs(vertices).max() <= 1e3
    assert triangles.min() >= 0 and triangles.max() == len(vertices) - 1
    a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
    assert (np.linalg.norm(np.cross(b - a, c - a), axis=1) > 0.0).all()
    assert len({tuple(sorted(triangle)) for triangle in triangles.tolist()}) == len(triangles)
    assert len(np.unique(vertices, axis=0)) == len(vertices)


@settings(examples(80, 200), suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(name=st.sampled_from(sorted(FILES)), data=st.data())
def test_damaged_files_are_refused_or_repaired(tmp_path: Path, name: str, data: st.DataObject) -> None:
    ending, whole = FILES[name]
    at = data.draw(st.integers(0, len(whole) - 1), "at")
    kind = data.draw(st.sampled_from(["bit", "bytes", "without", "cut", "doubled", "head"]), "kind")
    few = data.draw(st.binary(min_size=1, max_size=8), "few")
    near = at % 300
    damaged = {
        "bit": whole[:at] + bytes([whole[at] ^ (1 << few[0] % 8)]) + whole[at + 1 :],
        "bytes": whole[:at] + few + whole[at + len(few) :],
        "without": whole[:at] + whole[at + few[0] :],
        "cut": whole[:at],
        "doubled": whole[: at + few[0]] + whole[at:],
        "head": whole[:near] + few + whole[near + len(few) :],
    }[kind]
    sound_or_refused(ending, damaged, tmp_path)


BUILT: list[int] = []
build_tree = trees.build_tree


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    os.chmod(tmp_path, 0o700)
    return Folder(tmp_path / "kept", "nothing is kept")


def part(folder: Path, frequency: int = 3, **keys: float) -> schema.Mesh:
    ball, path = meshes.geodesic(frequency), folder / f"ball{frequency}.obj"
    rows = [f"v {x!r} {y!r} {z!r}" for x, y, z in ball.vertices.tolist()]
    path.write_text("\n".join([*rows, *(f"f {a} {b} {c}" for a, b, c in (ball.triangles + 1).tolist())]) + "\n")
    return schema.Mesh(name="ball", file=str(path), material=schema.Material(stiffness_n_per_m=1000.0), **keys)


def forget(monkeypatch: pytest.MonkeyPatch) -> None:
    """Clear the in-memory caches, as in a new process."""
    monkeypatch.setattr(prepared, "_trees", prepared._Memory(4))
    monkeypatch.setattr(prepared, "_abouts", prepared._Memory(4))

    def build(vertices: np.ndarray, triangles: np.ndarray) -> Tree:
        BUILT.append(len(triangles))
        return build_tree(vertices, triangles)

    monkeypatch.setattr(trees, "build_tree", build)
    BUILT.clear()


@pytest.fixture
def mesh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> schema.Mesh:
    """Return a mesh of which nothing is in memory."""
    forget(monkeypatch)
    return part(tmp_path)


def are_equal(a: Tree, b: Tree) -> bool:
    return all(
        (x.dtype, x.shape, x.tobytes()) == (y.dtype, y.shape, y.tobytes())
        if isinstance(x, np.ndarray)
        else (type(x), x) == (type(y), y)
        for x, y in zip(a, b, strict=True)
    )


def test_a_tree_is_built_once(mesh: schema.Mesh, folder: Folder, monkeypatch: pytest.MonkeyPatch) -> None:
    first = prepare_tree(mesh, folder)
    description = describe_mesh(mesh)
    assert prepare_tree(mesh, folder) is first and BUILT == [180]
    forget(monkeypatch)
    loaded = prepare_tree(mesh, folder)
    assert BUILT == [] and are_equal(first, loaded) and not loaded.corners.flags.writeable
    monkeypatch.setattr(prepared, "_read_and_mend", None)  # loaded results must not read the mesh again
    assert describe_mesh(mesh).report == description.report
    assert describe_mesh(mesh).picture.vertices.tobytes() == description.picture.vertices.tobytes()


def test_another_file_or_scale_is_another_tree(mesh: schema.Mesh, tmp_path: Path, folder: Folder) -> None:
    prepare_tree(mesh, folder)
    assert prepare_tree(part(tmp_path, scale=0.5), folder).size == 1.0 * prepare_tree(mesh, folder).size / 2
    prepare_tree(part(tmp_path, 4), folder)
    assert BUILT == [180, 180, 320]
    (tmp_path / "copy.obj").write_bytes(Path(mesh.file).read_bytes())
    copy = schema.Mesh(name="copy", file=str(tmp_path / "copy.obj"), material=mesh.material)
    assert are_equal(prepare_tree(copy, folder), prepare_tree(mesh, folder)) and len(BUILT) == 3


def test_other_sources_make_other_trees(mesh: schema.Mesh, folder: Folder, monkeypatch: pytest.MonkeyPatch) -> None:
    prepare_tree(mesh, folder)
    forget(monkeypatch)
    monkeypatch.setattr(prepared, "SOURCE_HASH", "another")
    prepare_tree(mesh, folder)
    assert BUILT == [180]


def only_file(folder: Folder) -> Path:
    (file,) = folder.path.iterdir()
    return file


ARRAYS = {"a": np.arange(100.0), "b": np.arange(30, dtype=np.int32).reshape(-1, 3), "c": np.zeros((0, 3), np.float32)}
KEY = "ab" * 32


def test_arrays_are_restored_unchanged(folder: Folder) -> None:
    array_cache.save(KEY, array_cache.CachedArrays(ARRAYS, {"size": 0.1, "count": 3}), folder)
    entry = array_cache.load(KEY, folder)
    assert entry is not None and entry.values == {"size": 0.1, "count": 3}
    for name, array in ARRAYS.items():
        loaded = entry.arrays[name]
        assert (loaded.dtype, loaded.shape, loaded.tobytes()) == (array.dtype, array.shape, array.tobytes())
        assert loaded.ctypes.data % 64 == 0
    assert array_cache.load("cd" * 32, folder) is None and only_file(folder).stat().st_mode & 0o777 == 0o600


@settings(examples(100, 300), suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damage_is_detected(folder: Folder, data: st.DataObject) -> None:
    array_cache.save(KEY, array_cache.CachedArrays(ARRAYS, {"size": 0.1}), folder)
    file = only_file(folder)
    whole = file.read_bytes()
    at = data.draw(st.integers(0, len(whole) - 1), "at")
    bit = data.draw(st.integers(0, 7), "bit")
    damaged = {
        "bit": whole[:at] + bytes([whole[at] ^ (1 << bit)]) + whole[at + 1 :],
        "cut": whole[:at],
        "more": whole + bytes(bit + 1),
    }[data.draw(st.sampled_from(["bit", "cut", "more"]), "kind")]
    file.write_bytes(damaged)
    entry = array_cache.load(KEY, folder)
    if entry is not None:  # between two arrays lie bytes that mean nothing
        assert all(entry.arrays[name].tobytes() == array.tobytes() for name, array in ARRAYS.items())
        assert entry.values == {"size": 0.1}


def test_a_damaged_tree_is_built_again(mesh, folder, monkeypatch, caplog):
    first = prepare_tree(mesh, folder)
    file = only_file(folder)
    whole = bytearray(file.read_bytes())
    whole[len(whole) // 2] ^= 1
    file.write_bytes(whole)
    forget(monkeypatch)
    assert are_equal(prepare_tree(mesh, folder), first) and BUILT == [180]
    assert "its numbers are damaged" in caplog.text
    forget(monkeypatch)
    assert are_equal(prepare_tree(mesh, folder), first) and BUILT == []


def test_a_folder_writable_by_others_is_not_used(mesh, tmp_path, monkeypatch):
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    for folder in (Folder(tmp_path / "open" / "kept"), Folder(tmp_path / "open"), Folder(None)):
        forget(monkeypatch)
        assert prepare_tree(mesh, folder).corners.shape == (180, 3) and BUILT == [180]
    assert list((tmp_path / "open").iterdir()) == []


def test_the_least_recently_used_file_is_removed(folder: Folder, monkeypatch: pytest.MonkeyPatch) -> None:
    some = array_cache.CachedArrays({"a": np.zeros(1000)}, {})
    names = [f"{number:02d}" * 32 for number in range(4)]
    for age, name in enumerate(names[:3]):
        array_cache.save(name, some, folder)
        os.utime(folder.path / f"{name}{array_cache.ENDING}", (age, age))
    assert array_cache.load(names[0], folder) is not None  # now the latest
    monkeypatch.setattr(array_cache, "BYTES_MAX", 3 * 9000)
    array_cache.save(names[3], some, folder)
    assert [array_cache.load(name, folder) is not None for name in names] == [True, False, True, True]
    monkeypatch.setattr(array_cache, "BYTES_MAX", 1)
    array_cache.save(names[1], some, folder)
    assert [array_cache.load(name, folder) is not None for name in names] == [False, True, False, False]
