"""Cache of mesh trees on disk: loaded bit for bit, rejected when damaged, bounded in size."""

import os
from pathlib import Path

import numpy as np
import pytest
from helpers import meshes
from helpers.examples import examples
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from softfinger.config import schema
from softfinger.proxy.kernels.jit.cache import Folder
from softfinger.proxy.meshes import array_cache, prepared
from softfinger.proxy.meshes import tree as trees
from softfinger.proxy.meshes.prepared import describe_mesh, prepare_tree
from softfinger.proxy.meshes.tree import Tree

pytestmark = pytest.mark.plain
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
    assert array_cache.load(names[0], folder) is not None  # now the newest
    monkeypatch.setattr(array_cache, "BYTES_MAX", 3 * 9000)
    array_cache.save(names[3], some, folder)
    assert [array_cache.load(name, folder) is not None for name in names] == [True, False, True, True]
    monkeypatch.setattr(array_cache, "BYTES_MAX", 1)
    array_cache.save(names[1], some, folder)
    assert [array_cache.load(name, folder) is not None for name in names] == [False, True, False, False]
