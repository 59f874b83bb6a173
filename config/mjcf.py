"""MuJoCo models: reading, compiling, and what is taken from the compiled model: meshes and height fields.

MuJoCo finds and reads the files of a model. Only files below one folder are allowed; pictures are not read at all.
"""

from __future__ import annotations

import copy
import ctypes
import os
import threading
import warnings
from collections import OrderedDict
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.config import schema
from softfinger.config.arrays.grids import Grid
from softfinger.config.errors import ConfigError
from softfinger.config.mjcf_files import check_flexes, check_place, complete, resolve_files
from softfinger.config.mjcf_size import read_names, read_text

if TYPE_CHECKING:
    import mujoco

CACHED_MODELS: Final = 4
"""Compiled models that stay in memory."""


class CompiledModel(NamedTuple):
    """A model: its specification as in the file, the compiled model, and the state of each of its files."""

    spec: mujoco.MjSpec
    model: mujoco.MjModel
    files: Mapping[str, Any]


class _LogConfig(ctypes.Structure):
    """mjLogConfig of mjtype.h; with all fields zero, MuJoCo writes neither to the terminal nor to MUJOCO_LOG.TXT."""

    _fields_ = (
        ("logto_console", ctypes.c_uint8),
        ("logto_file", ctypes.c_uint8),
        ("logfile", ctypes.c_char * 1024),
        ("topics", ctypes.c_int),
    )


_compiled: Final = OrderedDict[tuple[str, str | None], CompiledModel]()
_lock: Final = threading.Lock()


def import_mujoco() -> Any:
    """Return the package, needed only for a scene with [world]. Raises ConfigError if it is not installed."""
    try:
        import mujoco
    except ImportError as error:
        raise ConfigError(f"[world] needs MuJoCo ({error}): pip install 'softfinger[world]'") from error
    return mujoco


@cache
def load_library(package: Any) -> ctypes.CDLL:
    """Load the library of the package, and disable its log: a model or a servo thread must not write files."""
    folder = Path(package.__file__).parent
    libraries = sorted(folder.glob("libmujoco.so*")) + sorted(folder.glob("libmujoco*.dylib"))
    if not libraries:
        raise ConfigError(f"[world]: {folder} has no libmujoco: reinstall the package mujoco-core")
    library = ctypes.CDLL(str(libraries[0]))
    library.mju_setLogConfig(_LogConfig())
    return library


def read_model(world: schema.World) -> mujoco.MjModel:
    """Return a compiled model of a world for the simulation, which the caller may change.

    Raises ConfigError with the file and its fault, or for a body that has no mass, or an unknown keyframe.
    """
    spec, shared, _ = compile_model(world.model, world.root)
    model = copy.copy(shared)
    try:
        _set_masses(spec, model, world.mass_kg)
    except (ValueError, import_mujoco().FatalError) as error:
        raise ConfigError(f"world.model {world.model}: {_format_line(error)}") from error
    find_key_number(model, world)
    return model


def find_key_number(model: mujoco.MjModel, world: schema.World) -> int | None:
    """Return the number of the keyframe at which a world begins, None for none. Raises ConfigError if it is unknown."""
    if world.keyframe is None:
        return None
    names = [model.key(number).name for number in range(model.nkey)]
    if world.keyframe not in names:
        listed = ", ".join(names) or "none"
        raise ConfigError(f"world.keyframe = {world.keyframe!r}: {world.model} has no such <key>; it has: {listed}")
    return names.index(world.keyframe)


def find_body_number(model: mujoco.MjModel, world: schema.World, body: str) -> int:
    """Return the number of a body from its name or, for an unnamed body, its number in text form.

    Raises ConfigError if the model has no such body.
    """
    package = import_mujoco()
    number = package.mj_name2id(model, package.mjtObj.mjOBJ_BODY, body)
    if number < 0 and body.isdecimal() and int(body) < model.nbody:
        number = int(body)
    if number < 0:
        names = [model.body(index).name or str(index) for index in range(1, model.nbody)]
        raise ConfigError(f"motion.body = {body!r} is not a body of {world.model}; it has {', '.join(names)}")
    return int(number)


def compile_model(path: str, root: str | None = None) -> CompiledModel:
    """Return a model as MuJoCo compiles it, from memory while its files stay the same. The caller must not change it.

    Parameters
    ----------
    path
        MJCF or URDF file.
    root
        Folder below which the files of the model must lie; by default the folder of `path`.

    Raises
    ------
    ConfigError
        With the file and its fault.
    """
    with _lock:
        cached = _compiled.get((path, root))
    if cached is not None and all(_stat_file(file) == state for file, state in cached.files.items()):
        return cached
    model = _compile(path, root)
    with _lock:
        _compiled[path, root] = model
        _compiled.move_to_end((path, root))
        while len(_compiled) > CACHED_MODELS:
            _compiled.popitem(last=False)
    return model


def _compile(path: str, root: str | None) -> CompiledModel:
    package, name = import_mujoco(), repr(path)[1:-1]
    load_library(package)
    text = read_text(path, name)
    home = Path(os.path.realpath(Path(path).parent if root is None else root))
    names = read_names(text, Path(path), name, home)
    path = os.path.abspath(path)  # MuJoCo puts a relative one in front of files of included models
    folder = os.path.dirname(path)
    try:
        listed = package.mju_getXMLDependencies(path)
        parts = [path, *(file for file in listed if os.path.basename(file) in names.parts)]
        for file in parts[1:]:
            check_place(file, home, f"{name}: the file {file}")
        check_flexes(folder, names.folders, names.flexes, home, name)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # MuJoCo's, of deprecated attributes
            spec = package.MjSpec.from_file(path)
            if path.lower().endswith(".urdf"):
                complete(spec, Path(folder), home, name)
            _remove_pictures(spec)
            files = [*parts, *resolve_files(spec, listed, bool(names.attaches), home, name)]
            states = {file: _stat_file(file) for file in files}
            package.mj_clearCache(package.mj_getCache())  # the cache does not notice changes within a second
            model = spec.compile()
    except (ValueError, package.FatalError) as error:
        raise ConfigError(f"world.model {name}: {_format_line(error)}") from error
    return CompiledModel(spec, model, states)


def _remove_pictures(spec: mujoco.MjSpec) -> None:
    """Replace textures by one pixel, and remove skins: contacts need neither."""
    for texture in spec.textures:
        texture.file, texture.width, texture.height, texture.gridsize = "", 1, 1, [1, 1]
        texture.builtin = import_mujoco().mjtBuiltin.mjBUILTIN_FLAT
        for side in range(len(texture.cubefiles)):
            texture.cubefiles[side] = ""
    for skin in list(spec.skins):
        spec.delete(skin)


def _stat_file(file: str) -> Any:
    """Return device, inode, size and modification time of a file, None if it is missing."""
    try:
        status = os.stat(file)
    except OSError:
        return None
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


def _format_line(error: Exception) -> str:
    return " ".join(str(error).split())


def _set_masses(spec: mujoco.MjSpec, model: mujoco.MjModel, mass_kg: Mapping[str, float]) -> None:
    """Set masses of the compiled model, regardless of their origin: geoms, <inertial>, densities, a total.

    The inertia is scaled as if the density had changed. MuJoCo then computes the quantities that depend on both, except
    the damping of actuators with `dampratio`: a drive stays tuned to the model's own mass.
    """
    package = import_mujoco()
    for name, mass in mass_kg.items():
        body = package.mj_name2id(model, package.mjtObj.mjOBJ_BODY, name)
        if body <= 0 or not model.body_mass[body] > 0.0:
            names = ", ".join(model.body(body).name for body in range(1, model.nbody) if model.body_mass[body] > 0.0)
            raise ValueError(f"mass_kg: {name!r} is not a body with a mass; it has {names or 'none'}")
        model.body_inertia[body] *= mass / model.body_mass[body]
        model.body_mass[body] = mass
    if mass_kg:
        package.mj_setConst(model, package.MjData(model))
        if model.nv and np.isnan(spec.stat.meaninertia):  # only the compiler computes it, unless the file gives it
            model.stat.meaninertia = model.dof_M0.mean()


def read_mesh(path: str, root: str | None, name: str) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return vertices (n, 3) and triangles (m, 3) of a model's mesh, m, in the frame of the geoms that have it.

    Raises ConfigError if no mesh has that name.
    """
    _, model, _ = compile_model(path, root)
    for number in range(model.nmesh):
        if model.mesh(number).name == name:
            first, face = model.mesh_vertadr[number], model.mesh_faceadr[number]
            vertices = model.mesh_vert[first : first + model.mesh_vertnum[number]]
            faces = model.mesh_face[face : face + model.mesh_facenum[number]]
            return vertices.astype(np.float64), faces.astype(np.int32)
    raise ConfigError(f"{path}: has no mesh {name!r}; it has: {_join_names(model.mesh, model.nmesh)}")


def read_hfield(path: str, root: str | None, name: str) -> Grid:
    """Return the elevations (rows, columns) of a model's height field, 0 to 1, as MuJoCo reads them from any file.

    Columns run along x, rows along y, lowest coordinate first. Raises ConfigError if no height field has that name.
    """
    _, model, _ = compile_model(path, root)
    for number in range(model.nhfield):
        if model.hfield(number).name == name:
            rows, columns = int(model.hfield_nrow[number]), int(model.hfield_ncol[number])
            first = int(model.hfield_adr[number])
            return np.array(model.hfield_data[first : first + rows * columns], np.float64).reshape(rows, columns)
    raise ConfigError(f"{path}: has no height field {name!r}; it has: {_join_names(model.hfield, model.nhfield)}")


def _join_names(elements: Any, count: int) -> str:
    return ", ".join(elements(number).name for number in range(count)) or "none"
