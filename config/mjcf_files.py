"""Files of a MuJoCo or URDF model: where MuJoCo looks for them, so that none outside of one folder is read.

MuJoCo's own list of a model's files (`mju_getXMLDependencies`, 4.0.1) ignores `strippath`, and the `meshdir` that
included files set. Therefore each file gets an absolute path here, by MuJoCo's rule, and MuJoCo reads that.

Geoms of a URDF seldom have names. They get the name of their link, which a scene uses for the geom. MuJoCo cannot find
the files of a package; they are searched here, from the folder of the URDF upwards.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from softfinger.config import limits
from softfinger.config.errors import ConfigError
from softfinger.config.files import read_input

if TYPE_CHECKING:
    import mujoco


def check_place(file: str | Path, home: Path, requester: str) -> None:
    """Raise ConfigError if a file of a model is not below `home`; `requester` names the element that refers to it."""
    real = os.path.realpath(file)
    if not Path(real).is_relative_to(home):
        above = os.path.relpath(os.path.commonpath([home, real]), home)
        raise ConfigError(
            f"world.model {requester} is outside of its folder: move the file next to the model, or set a common "
            f'folder: [world] root = "{above}"'
        )


def check_flexes(folder: str, folders: Iterable[str], flexes: Iterable[str], home: Path, model: str) -> None:
    """Check the files of flexes, which MuJoCo reads while it parses, in each folder where it may look for them."""
    for file in flexes:
        for below in ("", *folders):
            check_place(os.path.join(folder, below, file), home, f"{model}: <flexcomp file={file!r}>")


def resolve_files(spec: mujoco.MjSpec, files: list[str], attaches: bool, home: Path, model: str) -> Iterator[str]:
    """Give every mesh and height field of a model that has a file its absolute path, and yield the paths.

    `files` are those that MuJoCo reports as dependencies of the model; files of attached models are found in their
    folders.
    """
    strips, spec.strippath = spec.strippath, False
    for asset in (*spec.meshes, *spec.hfields):
        if asset.file:
            file_name = os.path.basename(asset.file) if strips else asset.file
            path = os.path.abspath(os.path.join(spec.modelfiledir, spec.meshdir or "", file_name))
            if attaches:
                path = _find_attached(asset, path, files, model)
            check_place(path, home, f"{model}: the file {path}")
            asset.file = path
            yield path


def _find_attached(asset: Any, path: str, files: list[str], model: str) -> str:
    name = os.path.basename(asset.file)
    matching = {os.path.abspath(file) for file in files if os.path.basename(file) == name and os.path.exists(file)}
    if path in matching or not matching:
        matching = {path}
    if len(matching) > 1:
        choices = ", ".join(sorted(matching))
        raise ConfigError(f"world.model {model}: {asset.name!r} is ambiguous, it matches {choices}: rename the files")
    return matching.pop()


def has_groups(path: str) -> bool:
    """Return whether an OBJ file has faces in several groups or objects; MuJoCo (4.0.1) reads only the first."""
    try:
        data = read_input(path, int(limits.MESH_BYTES.high))
    except OSError:
        return False
    statements = b"".join(re.findall(rb"^[ \t]*([fgo])(?=\s)", data, re.MULTILINE))
    return re.search(rb"f[go]+f", statements) is not None


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
