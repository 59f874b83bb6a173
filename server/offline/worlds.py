"""A scene's [world] for `softfinger check`: its rows, and whether `run` can begin with it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from softfinger.config.schema import Mesh, Servo, World

if TYPE_CHECKING:
    from softfinger.config.mjcf_geoms import Taken

COMPILE_BASE_AND_PER_GEOM_S: Final = (31.0, 7.0)
"""Compile time of a scene with bodies, and for each kind of touched geom, CPU seconds.

Measured with 2, 4 and 8 free bodies of five kinds, friction and rolling, on a busy machine.
"""
LONG_S: Final = 90.0
"""Estimated compile time from which the summary mentions it."""


def world_rows(world: World) -> list[tuple[str, str]]:
    """Return rows of the model, its time step and start, and of the geoms that differ from MuJoCo's."""
    from softfinger.config.mjcf import compiled
    from softfinger.config.mjcf_geoms import taken

    geoms = list(taken(world))
    touched = sum(geom.object is not None for geom in geoms)
    rows = [("world", f"{world.model}, {touched} of {len(geoms)} geoms touched, substeps {world.substeps}")]
    rows.append(("  timestep", _timestep(world, float(compiled(world.model, world.root).model.opt.timestep))))
    if world.keyframe is not None:
        rows.append(("  keyframe", world.keyframe))
    compiling = COMPILE_BASE_AND_PER_GEOM_S[0] + COMPILE_BASE_AND_PER_GEOM_S[1] * _compiled(geoms)
    if compiling >= LONG_S:
        few = "to touch fewer meshes give only these a material, by [[world.geom]]"
        rows.append(("  compiling", f"some {round(compiling, -1):g} s at the first start; {few}"))
    return rows + [(f"  geom '{geom.name}'", geom.note) for geom in geoms if geom.note]


def check_start(world: World, rate_hz: float = Servo().rate_hz) -> None:
    """Raise ConfigError if the bodies of a world cannot begin at this rate."""
    from softfinger.proxy.bodies import RigidBodies

    RigidBodies(world).begin(1.0 / rate_hz)


def _timestep(world: World, own: float) -> str:
    if world.timestep == "file":
        return f"{own:g} s, the model's own: a tick at servo.rate_hz = {1.0 / (own * world.substeps):g}"
    step = 1.0 / (Servo().rate_hz * world.substeps)
    text = f"a tick's, {step:g} s at {Servo().rate_hz:g} Hz; the model's own is {own:g} s"
    if own < 0.999 * step:
        text += f": substeps = {math.ceil(step * world.substeps / own - 1e-3)} would keep to it"
    return text


def _compiled(geoms: list[Taken]) -> int:
    """Return the number of separately compiled geoms: geoms of a kind share code, each mesh has separate code."""
    objects = [geom.object for geom in geoms if geom.object is not None]
    meshes = sum(isinstance(each, Mesh) for each in objects)
    return meshes + len({(each.shape, each.motion is None) for each in objects if not isinstance(each, Mesh)})
