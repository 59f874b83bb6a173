"""Mesh files as other programs write them: each is read in full, or refused with its reason. Most are a box of 40 x 40
x 20 mm."""

import base64
import itertools
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from helpers.glb_files import Glb
from helpers.refusals import refusal

from softfinger.config import schema
from softfinger.proxy.meshes.formats import glb, text
from softfinger.proxy.meshes.prepared import describe_mesh
from softfinger.proxy.meshes.reading import OTHER_FILES, parse_mesh
from softfinger.proxy.meshes.report import MeshReport

pytestmark = pytest.mark.plain
CORNERS = np.array([(x, y, z) for z in (-0.01, 0.01) for y in (-0.02, 0.02) for x in (-0.02, 0.02)])
QUADS = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
FACES = [face for a, b, c, d in QUADS for face in ((a, b, c), (a, c, d))]
VOLUME = 0.04 * 0.04 * 0.02
FLOAT32 = 1e-6
"""Relative rounding: three float32 coordinates of 6e-8 each, and 0.01 is not exact in float32."""


def report(path: Path) -> MeshReport:
    return describe_mesh(
        schema.Mesh(name="m", file=str(path), material=schema.Material(stiffness_n_per_m=500.0))
    ).report


def check_box(path: Path, data: bytes, triangles: int = 12) -> None:
    path.write_bytes(data)
    result = report(path)
    assert (result.triangles, result.watertight, result.open_edges) == (triangles, True, 0)
    assert result.size_m == pytest.approx((0.04, 0.04, 0.02), rel=1e-4)  # quantized positions have 14 bits
    assert result.volume_m3 == pytest.approx(VOLUME, rel=2e-4)


def file_refusal(path: Path, data: bytes) -> str:
    path.write_bytes(data)
    return refusal(report, path)


def vertices(shift: float = 0.0) -> list[str]:
    return [f"v {x + shift!r} {y!r} {z!r}" for x, y, z in CORNERS.tolist()]


def faces(write: str = "{}", add: int = 1, of: Iterable[tuple[int, ...]] = FACES) -> list[str]:
    return ["f " + " ".join(write.format(corner + add) for corner in face) for face in of]


BLOCKS = [line for shift in (0.0, 0.1, 0.2) for line in (*vertices(shift), f"g box{shift}", *faces(add=-8))]
OBJS: dict[str, tuple[list[str], int]] = {
    "relative, in blocks of vertices and faces": (BLOCKS, 36),
    "relative and absolute": ([*vertices(), *faces(of=FACES[:6]), *faces(add=-8, of=FACES[6:])], 12),
    "faces before their vertices": ([*faces(), *vertices()], 12),
    "groups and materials in between": ([*vertices(), "g a", *faces(of=FACES[:6]), "o c", *faces(of=FACES[6:])], 12),
    "continued lines": ([*vertices(), *(line.replace(" ", " \\\n", 2) for line in faces())], 12),
    "quads": ([*vertices(), *faces(of=QUADS)], 12),
    "quads and triangles": ([*vertices(), *faces(of=QUADS[:3]), *faces(of=FACES[6:])], 12),
    "texture coordinates and normals": (["vt 0 0", "vn 0 0 1", *vertices(), *faces("{}/1/1")], 12),
    "normals alone, relative": ([*vertices(), "vn 0 0 1", *faces("{}//-1", -8)], 12),
    "colours of some vertices": ([line + " 1 0 0" * (k % 2) for k, line in enumerate(vertices())] + faces(), 12),
    "weights": ([line + " 1.0" for line in vertices()] + faces(), 12),
    "comments and blanks": ([*(f"  {line}  # {k}" for k, line in enumerate([*vertices(), *faces()])), "#f 1 2 3"], 12),
    "points and lines besides": ([*vertices(), "p 1", "l 1 2 3", *faces()], 12),
}  # fmt: skip


def read_by_line(lines: list[str]) -> list[list[tuple[float, ...]]]:
    """Return the corners of each face, by the definition of the format, line by line."""
    words = [line.partition("#")[0].split() for line in "\n".join(lines).replace("\\\n", " ").splitlines()]
    every = [tuple(map(float, line[1:4])) for line in words if line[:1] == ["v"]]
    polygons, before = list[list[tuple[float, ...]]](), 0
    for line in words:
        before += line[:1] == ["v"]
        if line[:1] == ["f"]:
            numbers = [int(word.partition("/")[0]) for word in line[1:]]
            polygons.append([every[number - 1 if number > 0 else before + number] for number in numbers])
    return polygons


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("name", OBJS)
def test_obj_files_are_read_in_full(tmp_path: Path, name: str, end: str) -> None:
    lines, triangles = OBJS[name]
    data = "\n".join([*lines, ""]).replace("\n", end).encode()
    read, expected = parse_mesh("a.obj", data), read_by_line(lines)
    fans = [(face[0], *pair) for face in expected for pair in itertools.pairwise(face[1:])]
    np.testing.assert_array_equal(read.vertices[read.triangles], fans)
    (tmp_path / "a.obj").write_bytes(data)
    result = report(tmp_path / "a.obj")
    assert (result.triangles, result.watertight, result.bodies) == (triangles, True, triangles // 12)
    assert result.volume_m3 == pytest.approx(VOLUME * triangles / 12)


def test_faces_of_many_corners_keep_their_area(tmp_path: Path) -> None:
    c = [(0, 0), (3, 0), (3, 1), (1, 1), (1, 2), (3, 2), (3, 3), (0, 3)]
    angles = np.arange(10) * np.pi / 5
    star = [(r * np.cos(a), r * np.sin(a)) for r, a in zip([3.0, 1.0] * 5, angles, strict=True)]
    for outline, area in ((c, 7.0), (star, 0.5 * 10 * 3.0 * np.sin(np.pi / 5))):
        n = len(outline)
        lines = [f"v {x / 100} {y / 100} {z / 100}" for z in (0, 1) for x, y in outline]
        sides = [(k, (k + 1) % n, (k + 1) % n + n, k + n) for k in range(n)]
        lines += faces(of=[tuple(range(n))[::-1], tuple(range(n, 2 * n)), *sides])
        (tmp_path / f"{n}.obj").write_text("\n".join(lines))
        result = report(tmp_path / f"{n}.obj")
        assert (result.triangles, result.watertight, result.turned_triangles) == (2 * (n - 2) + 2 * n, True, 0)
        assert result.volume_m3 == pytest.approx(area * 1e-6)
        read = parse_mesh("a.obj", (tmp_path / f"{n}.obj").read_bytes())
        lids = (read.vertices[read.triangles][:, :, 2] == 0.01).all(axis=1)
        a, b, d = (read.vertices[read.triangles[lids, k]] for k in range(3))
        assert np.linalg.norm(np.cross(b - a, d - a), axis=1).sum() / 2 == pytest.approx(area * 1e-4)


def test_unsupported_obj_files_are_refused(tmp_path: Path) -> None:
    path, box = tmp_path / "a.obj", "\n".join([*vertices(), *faces()])
    assert "has free-form surfaces (surf)" in file_refusal(path, f"{box}\nsurf 0 1 0 1 1 2 3 4\n".encode())
    assert "in another file (call)" in file_refusal(path, f"{box}\ncall more.obj\n".encode())
    assert "has the vertex 0" in file_refusal(path, f"{box}\nf 0 1 2\n".encode())
    assert "has the vertex -9 with only 8 before it" in file_refusal(path, f"{box}\nf -9 -1 -2\n".encode())
    assert "decimal commas" in file_refusal(path, box.replace(".", ",").encode())
    assert "'1.5' is not a number" in file_refusal(path, f"{box}\nf 1.5 2 3\n".encode())
    assert "UTF-16" in file_refusal(path, box.encode("utf-16"))


def stl(head: bytes = b"made by hand", tail: bytes = b"", attribute: int = 0, count: int = 12) -> bytes:
    body = b"".join(struct.pack("<12fH", 0, 0, 0, *CORNERS[list(face)].ravel(), attribute) for face in FACES)
    return head.ljust(80, b"\0")[:80] + struct.pack("<I", count) + body + tail


def stl_text(name: str = "box", end: str = "\n") -> str:
    facets = [
        ["facet normal 0 0 0", "outer loop", *("vertex {:.6e} {:.6e} {:.6e}".format(*CORNERS[k]) for k in face)]
        for face in FACES
    ]
    lines = [line for facet in facets for line in (*facet, "endloop", "endfacet")]
    return end.join([f"solid {name}", *lines, f"endsolid {name}", ""])


TEXT = stl_text()
STLS = {
    "binary": stl(),
    "solid in a binary head": stl(b"solid part1 facet endsolid"),
    "colours": stl(b"COLOR=\x80\x80\x80\xff,MATERIAL=", attribute=0x8001),
    "zeros up to a block of 512": stl(tail=b"\0" * 340),
    "new line at the end": stl(tail=b"\r\n"),
    "text": TEXT.encode(),
    "two solids": (stl_text("a") + stl_text("b")).encode(),
    "carriage returns": stl_text(end="\r\n").encode(),
    "capitals": TEXT.upper().encode(),
    "blanks in front": b" \n " + TEXT.encode(),
    "byte order mark": b"\xef\xbb\xbf" + TEXT.encode(),
    "long name": stl_text("x" * 5000).encode(),
    "words of the format in the name": stl_text("vertex facet").encode(),
    "a name in Latin 1": stl_text("Gehäuse").encode("latin-1"),
    "one line": stl_text(end=" ").encode(),
    "zeros behind a text": TEXT.encode() + b"\0" * 9,
}


@pytest.mark.parametrize("name", STLS)
def test_stl_files_are_read_in_full(tmp_path: Path, name: str) -> None:
    check_box(tmp_path / "a.stl", STLS[name])


def test_incomplete_stl_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.stl"
    assert "has 15 bytes, fewer than the head of an STL file" in file_refusal(path, b"<!doctype html>")
    assert "states 10 triangles, but 85 bytes follow" in file_refusal(path, stl(count=10))
    assert "decimal commas" in file_refusal(path, TEXT.replace(".", ",").encode())
    assert "declares 12 faces, but has 11" in file_refusal(path, TEXT.replace("outer loop\n", "", 1).encode())


XYZ = ["float x", "float y", "float z"]
INDICES = "list uchar int vertex_indices"


def ply(kind: str, face: list[str], rows: bytes, count: int = 12, more: str = "", name: str = "face") -> bytes:
    order = ">" if "big" in kind else "<"
    points = b"".join(struct.pack(order + "fff", *corner) for corner in CORNERS.tolist())
    if kind == "ascii":
        points = "".join("{} {} {}\n".format(*corner) for corner in CORNERS.tolist()).encode()
    head = ["ply", f"format {kind} 1.0", "comment by hand", "element vertex 8", *(f"property {axis}" for axis in XYZ)]
    head += [f"element {name} {count}", *(f"property {key}" for key in face)]
    return "\n".join([*head, f"{more}end_header\n"]).encode() + points + rows


LITTLE, BIG = "binary_little_endian", "binary_big_endian"
ROWS = b"".join(struct.pack("<B3i", 3, *face) for face in FACES)
LINES = "".join("3 {} {} {}\n".format(*face) for face in FACES)
MIXED = [*QUADS[:5], *FACES[10:]]
STRIPS = [0, 2, 1, 3, -1, 4, 5, 6, 7, -1, 0, 1, 4, 5, -1, 1, 3, 5, 7, -1, 3, 2, 7, 6, -1, 2, 0, 6, 4]
PLYS = {
    "text": ply("ascii", [INDICES], LINES.encode()),
    "carriage returns": ply("ascii", [INDICES], LINES.encode()).replace(b"\n", b"\r\n"),
    "carriage returns alone": ply("ascii", [INDICES], LINES.encode()).replace(b"\n", b"\r"),
    "little endian": ply(LITTLE, [INDICES], ROWS),
    "padded": ply(LITTLE, [INDICES], ROWS.ljust(512, b"\0")),
    "text, padded": ply("ascii", [INDICES], LINES.encode().ljust(512, b"\0")),
    "big endian": ply(BIG, [INDICES], b"".join(struct.pack(">B3i", 3, *face) for face in FACES)),
    "new line at the end": ply(LITTLE, [INDICES], ROWS + b"\n"),
    "another name": ply(LITTLE, [INDICES.replace("indices", "index")], ROWS),
    "flags and quality": ply(LITTLE, ["int flags", INDICES, "float quality"],
                             b"".join(struct.pack("<iB3if", 7, 3, *face, 0.5) for face in FACES)),
    "texture coordinates": ply(LITTLE, [INDICES, "list uchar float texcoord"],
                               b"".join(struct.pack("<B3iB6f", 3, *face, 6, *range(6)) for face in FACES)),
    "edges behind": ply(LITTLE, [INDICES], ROWS + struct.pack("<2i", 0, 1), 12,
                        "element edge 1\nproperty int vertex1\nproperty int vertex2\n"),
    "quads": ply(LITTLE, [INDICES], b"".join(struct.pack("<B4i", 4, *quad) for quad in QUADS), 6),
    "quads and triangles": ply(LITTLE, [INDICES],
                               b"".join(struct.pack(f"<B{len(face)}i", len(face), *face) for face in MIXED), 7),
    "quads and triangles, big endian, with flags": ply(
        BIG, [INDICES, "uchar flags"],
        b"".join(struct.pack(f">B{len(face)}iB", len(face), *face, 1) for face in MIXED), 7),
    "quads and triangles as text": ply(
        "ascii", [INDICES], "".join(" ".join(map(str, (len(face), *face))) + "\n" for face in MIXED).encode(), 7),
    "strips": ply("ascii", ["list int int vertex_indices"], " ".join(map(str, (29, *STRIPS))).encode(), 1,
                  name="tristrips"),
    "strips in binary": ply(LITTLE, ["list int int vertex_indices"], struct.pack("<30i", 29, *STRIPS), 1,
                            name="tristrips"),
}  # fmt: skip


@pytest.mark.parametrize("name", PLYS)
def test_ply_files_are_read_in_full(tmp_path: Path, name: str) -> None:
    check_box(tmp_path / "a.ply", PLYS[name])
    assert report(tmp_path / "a.ply").turned_triangles == 0


def test_incomplete_ply_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    assert "has other rows than its header declares" in file_refusal(path, ply(LITTLE, [INDICES], ROWS, 11))
    assert "has other rows than its header declares: 4 numbers" in file_refusal(
        path, ply("ascii", [INDICES], LINES.encode(), 11)
    )
    # The first quad as a triangle: the lists no longer fit.
    wrong = ply(LITTLE, [INDICES], b"".join(struct.pack("<B4i", 3, *quad) for quad in QUADS), 6)
    assert "has other rows than its header declares" in file_refusal(path, wrong)
    assert "its vertices have no x" in file_refusal(path, PLYS["text"].replace(b"float x", b"float u"))
    assert "faces without vertex_indices; they have corners" in file_refusal(
        path, PLYS["text"].replace(b"vertex_indices", b"corners")
    )
    assert "a list has -1 entries" in file_refusal(path, PLYS["strips"].replace(b"29 0 2", b"-1 0 2"))
    assert "has the corner -2" in file_refusal(path, PLYS["strips"].replace(b"29 0 2", b"29 -2 2"))
    for start, reason in OTHER_FILES.items():
        assert reason in file_refusal(path, start + PLYS["little endian"])


TEXTS = {
    **{f"obj, {name}": (".obj", "\n".join(lines)) for name, (lines, _) in OBJS.items()},
    "stl": (".stl", TEXT),
    "ply": (".ply", PLYS["text"].decode()),
}


@pytest.mark.parametrize("name", TEXTS)
def test_texts_are_read_in_blocks(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A call of numpy or re with a large text would hold the interpreter lock, and forces of some drivers need it."""
    suffix, content = TEXTS[name]
    whole, parse, sizes = parse_mesh(f"a{suffix}", content.encode()), np.fromstring, list[int]()
    monkeypatch.setattr(
        np, "fromstring", lambda part, *more, **keys: sizes.append(len(part)) or parse(part, *more, **keys)
    )
    for size in (1, 40):
        monkeypatch.setattr(text, "BLOCK_BYTES", size)
        read = parse_mesh(f"a{suffix}", content.encode())
        np.testing.assert_array_equal(read.vertices, whole.vertices)
        np.testing.assert_array_equal(read.triangles, whole.triangles)
        assert max(sizes) < size + 40 and not sizes.clear()


SOME = np.array(FACES, np.uint16).ravel()


def box_glb(points: np.ndarray, node: dict[str, Any] | None = None, stride: int = 0, **more: Any) -> bytes:
    made = Glb()
    at = made.add(points, stride, **more)
    return made.data([{"attributes": {"POSITION": at}, "indices": made.add(SOME)}], node)


def test_glb_strips_and_fans_are_read(tmp_path: Path) -> None:
    """The bottom as triangles, the sides as a strip, the top as a fan of four about its middle."""
    made, ring = Glb(), [0, 1, 3, 2]
    sides = np.array([CORNERS[k + up] for k in [*ring, 0] for up in (4, 0)], np.float32)
    lid = np.array([[0, 0, 0.01], *CORNERS[[4, 5, 7, 6, 4]]], np.float32)
    bottom = made.add(CORNERS[:4].astype(np.float32))
    parts = [
        {"attributes": {"POSITION": bottom}, "indices": made.add(np.array([0, 2, 3, 0, 3, 1], np.uint8)), "mode": 4},
        {"attributes": {"POSITION": made.add(sides)}, "mode": 5},
        {"attributes": {"POSITION": made.add(lid)}, "mode": 6},
        {"attributes": {"POSITION": bottom}, "mode": 0},  # points have no surface
    ]
    check_box(tmp_path / "a.glb", made.data(parts), 14)
    assert report(tmp_path / "a.glb").turned_triangles == 0


@pytest.mark.parametrize(("mode", "corners", "count"), [(4, 12, 4), (5, 12, 10), (6, 12, 10), (5, 2, 0), (6, 1, 0)])
def test_glb_triangle_count_is_that_of_its_accessors(mode: int, corners: int, count: int) -> None:
    """The count covers each node of the mesh and does not come from the triangles that were read."""
    made = Glb()
    at = made.add(np.random.default_rng(0).random((12, 3)).astype(np.float32))
    part = {"attributes": {"POSITION": at}, "indices": made.add(np.arange(corners).astype(np.uint8)), "mode": mode}
    twice = {"nodes": [{"mesh": 0}, {"mesh": 0}], "scenes": [{"nodes": [0, 1]}]}
    faces = glb.read(made.data([part, part], **twice))
    assert faces.promised == len(faces.counts) == 4 * count
    made.accessors[1]["count"] += 1
    with pytest.raises(ValueError, match="is damaged"):
        glb.read(made.data([part], **twice))


def test_glb_positions_of_every_type_give_the_same_box(tmp_path: Path) -> None:
    """Covers floats with a stride, and integers scaled by the node as gltfpack writes them, normalized or not."""
    unit = CORNERS / 0.02
    kinds = {
        "float": box_glb(CORNERS.astype(np.float32)),
        "stride": box_glb(CORNERS.astype(np.float32), stride=20),
        "integer": box_glb(((unit + 1.0) / 2.0 * 16383).round().astype(np.uint16), stride=8,
                           node={"scale": [0.04 / 16383] * 3, "translation": [-0.02] * 3}),
        "normalized": box_glb((unit * 32767).round().astype(np.int16), {"scale": [0.02] * 3}, 8, normalized=True),
        "bytes": box_glb((unit * 126).astype(np.int8), {"scale": [0.02 * 127 / 126] * 3}, 4, normalized=True),
        "turned": box_glb(CORNERS[:, [2, 0, 1]].astype(np.float32), {"rotation": [-0.5, -0.5, -0.5, 0.5]}),
        "matrix": box_glb(CORNERS[:, [2, 0, 1]].astype(np.float32),
                          {"matrix": [0, 0, 1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 1]}),
    }  # fmt: skip
    for name, data in kinds.items():
        check_box(tmp_path / f"{name}.glb", data)
        ours = parse_mesh("a.glb", data)
        if name in ("float", "stride", "turned", "matrix"):  # cases that trimesh reads correctly
            theirs = trimesh.load_mesh(trimesh.util.wrap_as_stream(data), file_type="glb", process=False)
            np.testing.assert_allclose(ours.vertices, theirs.vertices, atol=1e-9)


def test_glb_sparse_accessors_are_read(tmp_path: Path) -> None:
    for base in (CORNERS.astype(np.float32) * [1, 1, 0], None):
        made = Glb()
        places = np.arange(4 if base is not None else 0, 8).astype(np.uint8)
        at = made.add((CORNERS if base is None else np.vstack([CORNERS[:4], base[4:]])).astype(np.float32))
        sparse = {
            "count": len(places),
            "indices": {"bufferView": made.view(places), "componentType": 5121},
            "values": {"bufferView": made.view(CORNERS[places].astype(np.float32))},
        }
        made.accessors[at]["sparse"] = sparse
        if base is None:
            del made.accessors[at]["bufferView"]
        part = {"attributes": {"POSITION": at}, "indices": made.add(SOME)}
        check_box(tmp_path / f"{len(places)}.glb", made.data([part]))


def test_a_glb_without_scenes_uses_its_root_nodes(tmp_path: Path) -> None:
    """glTF permits this; a child is placed once, by its parent."""
    made = Glb()
    part = {"attributes": {"POSITION": made.add(CORNERS.astype(np.float32))}, "indices": made.add(SOME)}
    nodes = [{"mesh": 0, "scale": [0.5] * 3}, {"children": [0], "scale": [2.0] * 3}]
    check_box(tmp_path / "a.glb", made.data([part], nodes=nodes, scenes=[]))


def test_unsupported_glb_features_are_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    made = Glb()
    parts = [{"attributes": {"POSITION": made.add(CORNERS.astype(np.float32))}, "indices": made.add(SOME)}]
    copies = {"EXT_mesh_gpu_instancing": {"attributes": {}}}
    assert "deformed by a skeleton" in file_refusal(path, made.data(parts, {"skin": 0}))
    assert "EXT_mesh_gpu_instancing" in file_refusal(path, made.data(parts, {"extensions": copies}))
    assert "morph targets" in file_refusal(path, made.data(parts, {"weights": [0.0, 0.5]}))
    assert "needs an unsupported extension (VND_bend)" in file_refusal(
        path, made.data(parts, extensionsRequired=["KHR_materials_unlit", "VND_bend"])
    )
    loop = [{"mesh": 0, "children": [1]}, {"children": [0]}]
    assert "is its own ancestor" in file_refusal(path, made.data(parts, nodes=loop))
    check_box(path, made.data(parts, extensionsRequired=["KHR_mesh_quantization", "KHR_materials_unlit"]))
    address = "data:application/octet-stream;base64," + base64.b64encode(made.blob).decode()
    check_box(path, made.data(parts, buffers=[{"byteLength": len(made.blob), "uri": address}]))
    made.accessors.append({"componentType": 5126, "count": 8, "type": "VEC3"})
    missing = made.data([{"attributes": {"POSITION": 2}, "indices": 1}])
    assert "has no data for accessor 2" in file_refusal(path, missing)


def test_a_suspicious_size_is_reported_with_a_scale(tmp_path: Path) -> None:
    path = tmp_path / "a.stl"
    path.write_bytes(stl())

    def noted(scale: float) -> str:
        material = schema.Material(stiffness_n_per_m=500.0)
        return describe_mesh(schema.Mesh(name="m", file=str(path), material=material, scale=scale)).report.noted[0]

    assert "in size" not in noted(1.0) + noted(0.03) + noted(20.0)
    path.write_bytes(TEXT.replace("e-02", "e+01").encode())  # a box of 40 x 40 x 20
    assert noted(1.0) == (
        "it is 40 m in size: if that is not intended, give scale = 0.001 (millimetres, 0.04 m), or scale = 0.01 "
        "(centimetres, 0.4 m)"
    )
    assert "give scale = 0.001 (a thousand times larger, 0.04 m)" in noted(1e-6)
    asset = '<asset><mesh name="a" file="b.stl" scale="1000 1000 1000"/></asset>'
    (tmp_path / "a.xml").write_text(f'<mujoco>{asset}<worldbody><geom type="mesh" mesh="a"/></worldbody></mujoco>')
    (tmp_path / "b.stl").write_bytes(stl())
    of_model = schema.Mesh(
        name="m", file=str(tmp_path / "a.xml"), mesh="a", material=schema.Material(stiffness_n_per_m=1.0)
    )
    assert (
        "it is 40 m in size: if that is not intended, multiply the scale of its <mesh> by 0.001 (millimetres"
        in (describe_mesh(of_model).report.noted[0])
    )
