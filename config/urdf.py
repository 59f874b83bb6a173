"""What a URDF file has not as a model of MuJoCo needs it: names of its geoms, and files of packages.

Geoms of a URDF seldom have names. The link has one, which is what a scene calls its geom. Files are named by the
package that they are in; they are looked for in the folder of the URDF, as those of any model.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

PACKAGE: Final = "package://"


def is_urdf(path: str) -> bool:
    return path.lower().endswith(".urdf")


def places(given: str) -> tuple[str, ...]:
    """Where a file may be, from the model's folder: with the package's name as a folder, or without."""
    if not given.startswith(PACKAGE):
        return (given,)
    within = given.removeprefix(PACKAGE)
    return within, within.partition("/")[2]


def complete(spec: Any, folder: Path) -> None:
    """Name the geoms that collide after their links, the second of a link `NAME 2`, and find the meshes' files."""
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
