"""Completion of a URDF model for MuJoCo: names of its geoms, and mesh files of packages.

Geoms of a URDF seldom have names. They get the name of their link, which a scene uses for the geom. MuJoCo cannot find
the files of a package; they are searched here, from the folder of the URDF upwards.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from softfinger.config.errors import ConfigError
from softfinger.config.mjcf_files import check_place

PACKAGES: Final = ("package://", "model://")


def locate(uri: str, folder: Path, home: Path) -> Path:
    """Return the path of a file that a URDF in `folder` names; of a package, the first that exists.

    `package://NAME/FILE` is NAME/FILE or FILE in `folder`, or in a folder above it up to `home`. If there is none, the
    path is that in `folder`.
    """
    if not uri.startswith(PACKAGES):
        return folder / uri.removeprefix("file://")
    candidates = list(_iter_candidates(uri, folder))
    inside = (
        candidate
        for _, candidate in candidates
        if candidate.is_file() and Path(os.path.realpath(candidate)).is_relative_to(home)
    )
    return next(inside, candidates[0][1])


def _iter_candidates(file_name: str, folder: Path) -> Iterator[tuple[Path, Path]]:
    """Yield folders that may have the package of a file, upwards from `folder`, and the path of the file in each."""
    within = file_name.partition("://")[2].lstrip("/")
    start = Path(os.path.abspath(folder))
    for above in (start, *start.parents):
        yield above, above / within
        yield above, above / within.partition("/")[2]


def complete(spec: Any, folder: Path, home: Path, model: str) -> None:
    """Name the colliding geoms after their links, the second of a link `NAME 2`, and find the mesh files.

    Raises ConfigError for a file of a package that is not found, or not below `home`.
    """
    names = {geom.name for geom in spec.geoms}
    for geom in spec.geoms:
        if not geom.name and (geom.contype or geom.conaffinity):
            link, number = geom.parent.name, 1
            while (name := link if number == 1 else f"{link} {number}") in names:
                number += 1
            geom.name = name
            names.add(name)
    for mesh in spec.meshes:
        if spec.strippath or not mesh.file.startswith((*PACKAGES, "file://")):
            continue
        path = locate(mesh.file, folder, home)
        check_place(path, home, f"{model}: the file {mesh.file}")
        if not path.is_file():
            higher = next(
                (above for above, candidate in _iter_candidates(mesh.file, folder) if candidate.is_file()),
                folder.parent,
            )
            raise ConfigError(
                f"world.model {model}: {mesh.file} is in no folder from that of the model up to {home}: set one that "
                f'contains the package: [world] root = "{os.path.relpath(higher, folder)}"'
            )
        mesh.file = str(path)
