"""Meshes and MuJoCo models of packages in the registry: each is loaded, or refused in a line.

    python tests/corpus_of_files.py FOLDER... > docs/measured/files.md

A folder is one of installed or unpacked packages; those of PACKAGES are looked for in it. Faces are counted by trimesh,
or for OBJ files by their lines; models by MuJoCo, without this program.
"""

from __future__ import annotations

import io
import re
import sys
import warnings
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, NamedTuple

from softfinger.config.errors import ConfigError
from softfinger.config.load import load_scene
from softfinger.proxy.meshes.reading import READERS, arrays_of, read_bytes
from softfinger.server.offline.worlds import check_start

PACKAGES: Final = ("robosuite", "gymnasium_robotics", "dm_control")
SIZE_MAX: Final = 30_000_000
"""Bytes of a mesh file that is read here."""


class Outcome(NamedTuple):
    """A file, the faces or geoms that an independent reader finds, those found here, and why it is refused here."""

    file: str
    expected: int
    found: int
    refusal: str


def folders() -> list[Path]:
    """Return the folders of the packages that are installed."""
    found = [find_spec(name) for name in PACKAGES]
    return [Path(spec.origin).parent for spec in found if spec is not None and spec.origin is not None]


def meshes(folder: Path) -> Iterator[Outcome]:
    """Yield the outcome of each mesh file of a package."""
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower().removeprefix(".") in READERS and path.stat().st_size < SIZE_MAX:
            try:
                found, refusal = len(arrays_of(path, read_bytes(path)).triangles), ""
            except ConfigError as error:
                found, refusal = 0, str(error).removeprefix(f"{path}: ")
            yield Outcome(str(path.relative_to(folder.parent)), _faces(path), found, refusal)


def models(folder: Path) -> Iterator[Outcome]:
    """Yield the outcome of each MJCF file of a package that MuJoCo compiles."""
    import mujoco

    for path in sorted(folder.rglob("*.xml")):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                model = mujoco.MjModel.from_xml_path(str(path))
        except ValueError:  # a part of a model, or none
            continue
        paired = {*model.pair_geom1.tolist(), *model.pair_geom2.tolist()}
        colliding = [
            geom
            for geom in range(model.ngeom)
            if model.geom_contype[geom] or model.geom_conaffinity[geom] or geom in paired
        ]
        found, refusal = _loaded(path, folder)
        yield Outcome(str(path.relative_to(folder.parent)), len(colliding), found, refusal)


def _loaded(path: Path, root: Path) -> tuple[int, str]:
    world: dict[str, Any] = {"model": str(path), "root": str(root), "material": {"stiffness_n_per_m": 500.0}}
    try:
        scene = load_scene({"fingertip": {"radius_m": 0.01}, "world": world})
        assert scene.world is not None
        check_start(scene.world)
    except ConfigError as error:
        return 0, str(error).partition(": ")[2]
    return len(scene.object), ""


def _faces(path: Path) -> int:
    """Return the number of triangles of a mesh file, by another reader; 0 for a file that it cannot read."""
    data = path.read_bytes()
    if path.suffix.lower() == ".obj":
        rows = [line.split() for line in data.decode("latin-1").replace("\\\n", " ").splitlines()]
        return sum(len(row) - 3 for row in rows if row[:1] == ["f"])
    import trimesh

    try:
        scene = trimesh.load_scene(io.BytesIO(data), file_type=path.suffix.lower()[1:], process=False)
    except Exception:
        return 0
    return sum(len(part.faces) for part in scene.geometry.values() if hasattr(part, "faces"))


def table(outcomes: dict[str, list[Outcome]]) -> str:
    """Return a table of counts, and of each refusal."""
    rows = ["| package | files | loaded | refused | loaded with another count |", "|---|---|---|---|---|"]
    refusals = []
    for name, each in outcomes.items():
        refused = [one for one in each if one.refusal]
        other = sum(one.found != one.expected for one in each if not one.refusal)
        rows.append(f"| {name} | {len(each)} | {len(each) - len(refused)} | {len(refused)} | {other} |")
        refusals += [f"| {one.file} | {_short(one.refusal)} |" for one in refused]
    return "\n".join([*rows, "", "| refused | reason |", "|---|---|", *refusals])


def _short(refusal: str) -> str:
    text = re.sub(r"\S*/", "", refusal)
    return text if len(text) < 160 else f"{text[:157]}..."


def main() -> None:
    """Print the page."""
    every: dict[str, list[Outcome]] = {}
    for base in map(Path, sys.argv[1:]):
        for name in PACKAGES:
            if (base / name).is_dir():
                every[f"{name}, meshes"] = list(meshes(base / name))
                every[f"{name}, models"] = list(models(base / name))
    print(
        "# Files of other projects\n\n"
        "Every mesh, and every MJCF file that MuJoCo compiles, of three packages: loaded, or refused with a reason.\n"
        "The triangles of a mesh are counted by trimesh, or in an OBJ file by its lines; the geoms of a model that\n"
        "collide, by MuJoCo. Each model is a `[world]` with `root` at its package and a material for all geoms.\n\n"
        "    python tests/corpus_of_files.py FOLDER > docs/measured/files.md\n\n"
        f"{table(every)}"
    )


if __name__ == "__main__":
    main()
