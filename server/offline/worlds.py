"""A scene's [world] for `softfinger check`: its rows, and whether `run` can begin with it."""

from __future__ import annotations

import math

from softfinger.config.schema import Servo, World


def world_rows(world: World) -> list[tuple[str, str]]:
    """Return rows of the model, its time step and start, and of the geoms that differ from MuJoCo's."""
    from softfinger.config.mjcf import compile_model
    from softfinger.config.mjcf_geoms import convert_geoms

    geoms = list(convert_geoms(world))
    touched = sum(geom.object is not None for geom in geoms)
    rows = [("world", f"{world.model}, {touched} of {len(geoms)} geoms touched, substeps {world.substeps}")]
    rows.append(("  timestep", _timestep(world, float(compile_model(world.model, world.root).model.opt.timestep))))
    if world.keyframe is not None:
        rows.append(("  keyframe", world.keyframe))
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
