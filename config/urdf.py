"""Completion of a URDF model for MuJoCo: names of its geoms, and mesh files of packages.

Geoms of a URDF seldom have names. They get the name of their link, which a scene uses for the geom. Mesh files are
named relative to a package; they are searched in the folder of the URDF, like the files of any model.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

PACKAGE: Final = "package://"


def is_urdf(path: str) -> bool:
    return path.lower().endswith(".urdf")


def places(given: str) -> tuple[str, ...]:
    """Return the possible paths of a file, relative to the model's folder: with the package as a folder, or without."""
    if not given.startswith(PACKAGE):
        return (given,)
    within = given.removeprefix(PACKAGE)
    return within, within.partition("/")[2]


def complete(spec: Any, folder: Path) -> None:
    """Name the colliding geoms after their links, the second of a link `NAME 2`, and find the mesh files."""
    taken = {geom.name for geom in spec.geoms}
    for geom in spec.geoms:
        if not geom.name and (geom.contype or geom.conaffinity):
            link, number = geom.parent.name, 1
            while (name := link if number == 1 else f"{link} {number}") in taken:
                number += 1
            geom.name = name
            taken.add(name)
    for mesh in spec.meshes:
        ways = places(mesh.file)
        mesh.file = next((way for way in ways if (folder / way).is_file()), ways[0])
