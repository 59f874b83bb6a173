"""Every mesh, MJCF and URDF file of some packages of the registry loads completely, or is refused with one line.

The triangles of a mesh are counted by trimesh, or in an OBJ file by its lines; the geoms of a model that collide by
MuJoCo, or in a URDF file by its elements. Each model is a `[world]` with `root` at its package. docs/measured/files.md
has the counts.
"""

import io
import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple
from xml.etree import ElementTree
from zipfile import ZipFile

import pytest

from softfinger.config.errors import ConfigError
from softfinger.config.load import load_scene
from softfinger.proxy.meshes.reading import READERS, parse_mesh, read_bytes
from softfinger.server.offline.summary import check_start

pytestmark = [pytest.mark.exhaustive, pytest.mark.plain]

PACKAGES: Final = {
    "robosuite": "robosuite==1.5.2",
    "gymnasium_robotics": "gymnasium-robotics==1.4.2",
    "dm_control": "dm-control==1.0.50",
    "metaworld": "metaworld==3.1.1",
    "myo_sim": "myo-sim==0.2.4",
    "cmeel.prefix/share/example-robot-data": "example-robot-data==6.0.0",
}
"""Folders with files, and the wheels that contain them."""
CACHE: Final = Path(__file__).resolve().parents[1] / "build" / "corpus"
SIZE_MAX: Final = 30_000_000
"""Bytes of a mesh file that is read here."""
OF_URDF = ("Error:", "is outside of its folder", "is not found", "several groups")
LIMITS = ("no geom can be touched", "at most", "fingers cannot touch", "not well-formed XML", *OF_URDF)
"""Reasons to refuse a model that MuJoCo accepts; and reasons of MuJoCo to refuse a URDF, of which only the elements are
counted."""


class Outcome(NamedTuple):
    """Result of one file.

    file      its path in the package
    expected  triangles or geoms that an independent reader finds; None if it refuses the file or finds no triangle
    loaded    triangles or geoms that are loaded here
    refusal   message of a file that is refused here
    """

    file: str
    expected: int | None
    loaded: int
    refusal: str


@pytest.fixture(scope="module", params=PACKAGES)
def folder(request: pytest.FixtureRequest) -> Path:
    """Folder of a package, downloaded once."""
    wheel_name = PACKAGES[request.param]
    target, wheels = CACHE / wheel_name, CACHE / "wheels" / wheel_name
    if not target.is_dir():
        options = ["--quiet", "--no-deps", "--only-binary=:all:", f"--dest={wheels}"]
        command = [sys.executable, "-m", "pip", "download", *options, wheel_name]
        if subprocess.run(command, check=False).returncode != 0:
            pytest.skip(f"the registry does not answer for {wheel_name}")
        (wheel,) = wheels.glob("*.whl")
        with ZipFile(wheel) as archive:
            archive.extractall(wheels / "content")
        (wheels / "content").rename(target)
    return target / str(request.param)


def meshes(folder: Path) -> Iterator[Outcome]:
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower().removeprefix(".") in READERS and path.stat().st_size < SIZE_MAX:
            try:
                count, refusal = len(parse_mesh(path, read_bytes(path)).triangles), ""
            except ConfigError as error:
                count, refusal = 0, str(error)
            yield Outcome(str(path.relative_to(folder)), count_triangles(path), count, refusal)


def models(folder: Path) -> Iterator[Outcome]:
    for path in sorted([*folder.rglob("*.xml"), *folder.rglob("*.urdf")]):
        if "<mujoco" not in (text := path.read_text(errors="replace")) and "<robot" not in text:
            continue
        world: dict[str, Any] = {"model": str(path), "root": str(folder), "material": {"stiffness_n_per_m": 500.0}}
        try:
            scene = load_scene({"fingertip": {"radius_m": 0.01}, "world": world})
            check_start(scene.world)
            count, refusal = len(scene.object), ""
        except ConfigError as error:
            count, refusal = 0, str(error)
        expected = count_collision_elements(text) if path.suffix == ".urdf" else count_colliding_geoms(path)
        yield Outcome(str(path.relative_to(folder)), expected, count, refusal)


def count_triangles(path: Path) -> int | None:
    data = path.read_bytes()
    if path.suffix.lower() == ".obj":
        text = data.decode("latin-1").replace("\r\n", "\n").replace("\\\n", " ")
        rows = [line.split() for line in text.splitlines()]
        # A face of one or two corners has no area; the loader counts it as one triangle, and drops it later.
        return sum(max(len(row) - 3, 1) for row in rows if row[:1] == ["f"]) or None
    import trimesh

    try:
        scene = trimesh.load_scene(io.BytesIO(data), file_type=path.suffix.lower()[1:], process=False)
    except Exception:
        return None
    return sum(len(part.faces) for part in scene.dump() if hasattr(part, "faces")) or None


def count_colliding_geoms(path: Path) -> int | None:
    import mujoco

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError:
        return None
    colliding = (model.geom_contype | model.geom_conaffinity).nonzero()[0]
    return len({*colliding.tolist(), *model.pair_geom1.tolist(), *model.pair_geom2.tolist()})


def count_collision_elements(text: str) -> int | None:
    try:
        return len(ElementTree.fromstring(text.strip("\0 \r\n")).findall("link/collision"))
    except ElementTree.ParseError:
        return None


def check_counts(outcomes: list[Outcome]) -> list[Outcome]:
    """Check that loaded files are complete, and refusals one line; return those refused here alone."""
    assert all("\n" not in outcome.refusal for outcome in outcomes)
    assert [outcome for outcome in outcomes if not outcome.refusal and outcome.loaded != outcome.expected] == []
    return [outcome for outcome in outcomes if outcome.refusal and outcome.expected is not None]


def test_meshes_have_as_many_triangles_as_another_reader_finds(folder: Path) -> None:
    assert check_counts(list(meshes(folder))) == []


def test_models_have_as_many_objects_as_geoms_that_collide(folder: Path) -> None:
    alone = check_counts(list(models(folder)))
    assert [outcome for outcome in alone if not any(limit in outcome.refusal for limit in LIMITS)] == []
