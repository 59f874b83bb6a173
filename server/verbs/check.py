"""`softfinger check`: are these scene and rig files usable, and what do they model?"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
from msgspec import Struct

from softfinger.config.errors import ConfigError, DeviceError, HapticError, RecordingError
from softfinger.config.load import FaultyConfig, build, describe, find, load_rig, load_scene, read_toml, shipped
from softfinger.config.schema import (
    DeviceConfig,
    FingerParts,
    Guard,
    Heightmap,
    Mesh,
    Object,
    ObjectBase,
    Rig,
    Scene,
    Servo,
    Texture,
    Textured,
    Workspace,
    World,
)
from softfinger.config.words import near, shown
from softfinger.server.offline.feels import entry_rows
from softfinger.server.offline.figures import plot_file

if TYPE_CHECKING:  # with the kernels behind it, which no rig needs
    from softfinger.proxy.meshes.report import Report

_SCENE_KEYS: Final = frozenset(Scene.__struct_fields__)
_RIG_KEYS: Final = frozenset(Rig.__struct_fields__)


COMPILE_S: Final = (31.0, 7.0)
"""Of a scene with bodies, and of each geom that a finger touches: seconds of a processor, measured with 2, 4 and 8 free
bodies of five kinds, friction and rolling, on a busy machine."""
LONG_S: Final = 90.0
"""From here on a first start is worth a word."""


class Finding(NamedTuple):
    """What one file is: kind (scene, rig, or empty), summary rows, errors, its content as read; by object its mesh."""

    file: str
    kind: str
    summary: list[tuple[str, str]]
    errors: list[str]
    content: dict[str, Any]
    meshes: dict[str, Any]


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the verb."""
    parser.description = "Check scene and rig files. Exit code 0: all are usable; 2: at least one is not."
    parser.add_argument("files", nargs="+", metavar="FILE", help="scene or rig, as a file or a shipped name")
    parser.add_argument(
        "--explain", action="store_true", help="compile each scene and measure what a tick and each part of it cost"
    )
    parser.add_argument(
        "--plot", type=plot_file, metavar="FILE.png", help="draw the soft wall of a rig about the objects of a scene"
    )
    parser.add_argument("--json", action="store_true", help="print the findings as JSON")


def run(args: argparse.Namespace) -> int:
    """Check every file and print what it is; returns 0, or ConfigError's exit code if any is faulty."""
    findings = [examine_file(file) for file in args.files]
    if args.explain:
        findings = [with_costs(finding) for finding in findings]
    if args.json:
        print(json.dumps([finding._asdict() | {"summary": dict(finding.summary)} for finding in findings], indent=2))
    else:
        for finding in findings:
            _show(finding)
    _draw_walls(findings, args.plot, quiet=args.json)
    return ConfigError.exit_code if any(finding.errors for finding in findings) else 0


def _draw_walls(findings: list[Finding], plot: Path | None, quiet: bool) -> None:
    """Print each rig's soft wall about the objects of each scene, unless `quiet`, and save the only one as `plot`.

    Raises ConfigError for a plot of none, or of several.
    """
    usable = [finding for finding in findings if not finding.errors]
    rigs = [(each.file, load_rig(_locate(each.file)).guard.workspace) for each in usable if each.kind == "rig"]
    walls = [(name, wall) for name, wall in rigs if wall is not None]
    scenes = [each.file for each in usable if each.kind == "scene"]
    if plot is not None and len(walls) * len(scenes) != 1:
        raise ConfigError(
            f"--plot draws one rig with [guard.workspace] and one scene, and there are {len(walls)} and {len(scenes)}: "
            "name one of each"
        )
    if not walls or not scenes or (quiet and plot is None):
        return
    from softfinger.server.offline import workspace

    for name, wall in walls:
        for scene in scenes:
            objects = workspace.drawn(wall, load_scene(_locate(scene)))
            if plot is not None:
                workspace.plot(wall, objects, plot)
            if not quiet:
                print(f"the soft wall of {name} in {scene}")
                _print_rows(workspace.rows(wall, objects))
                print("\n".join(f"  {line}" for line in workspace.text(wall, objects)))


def examine_file(file: str) -> Finding:
    """Everything `run` would find wrong with a file before it touches the device, or what the file means."""
    kind = ""
    try:
        path = _locate(file)
        kind = kind_of(read_toml(path, file), file)
        config = load_scene(path) if kind == "scene" else load_rig(path)
        if isinstance(config, Scene):
            summary = scene_summary(config)
        else:
            if config.security is not None:
                from softfinger.server.gateway.allowed import key_folders

                key_folders(config.security)
            for table, device in config.tables.items():
                _check_driver(device, table, file)
                _check_recording(device, table, file)
            summary = rig_summary(config)
    except FaultyConfig as error:
        return Finding(file, kind, [], [str(fault) for fault in error.faults], {}, {})
    except (ConfigError, DeviceError) as error:
        return Finding(file, kind, [], [str(error)], {}, {})
    return Finding(file, kind, summary, [], describe(config), _reports(config))


def _reports(config: Scene | Rig) -> dict[str, Any]:
    """What was found of each mesh, by the name of its object."""
    meshes = [thing for thing in config.object if isinstance(thing, Mesh)] if isinstance(config, Scene) else []
    return {thing.name: msgspec.to_builtins(_report(thing)) for thing in meshes}


def with_costs(finding: Finding) -> Finding:
    """The finding of a usable scene with the measured cost of a tick and of each part; any other as it is."""
    if finding.kind != "scene" or finding.errors:
        return finding
    from softfinger.server.offline.cost import bare, measure, touching_poses, without_parts
    from softfinger.server.progress import progress

    scene = load_scene(_locate(finding.file))
    parts = list(without_parts(scene))
    with progress(f"measuring {finding.file}", len(parts) + 2) as done:
        poses = touching_poses(scene)
        whole = measure(scene, poses).median_ns
        rows = [("cost of a tick", f"{whole:.0f} ns, back to back, pressed into the first object")]
        done(1)
        for number, (name, rest) in enumerate(parts):
            rows.append((f"  {name}", f"{whole - measure(rest, poses).median_ns:+.0f} ns"))
            done(number + 2)
        rows.append(("  bare contact", f"{measure(bare(scene), poses).median_ns:.0f} ns"))
    rows += [_stability_row(thing) for thing in scene.object]
    return finding._replace(summary=finding.summary + rows)


def _stability_row(item: Object) -> tuple[str, str]:
    """Slope of the normal force at the guard's default largest force, and the device that is passive with it."""
    force, rate = Guard().force_max_n, Servo().rate_hz
    normal = item.material.normal
    crossed = 0.0 if normal is None else normal.damping_s_per_m or 0.0
    stiffness, damping = item.material.stiffness_under(force), item.material.damping_ns_per_m + crossed * force
    return (
        f"'{item.name}' at {force:g} N",
        f"{stiffness:.0f} N/m; passive at {rate:g} Hz on a device that damps more than "
        f"{0.5 * stiffness / rate + damping:.3g} N s/m by itself",
    )


def kind_of(mapping: dict[str, Any], where: str) -> str:
    """`scene` or `rig`, by the tables a file has. Raises ConfigError when it is neither, or both."""
    scene, rig = _SCENE_KEYS & mapping.keys(), _RIG_KEYS & mapping.keys()
    if scene and not rig:
        return "scene"
    if rig and not scene:
        return "rig"
    if rig and scene:
        raise ConfigError(
            f"{where}: both scene ({', '.join(sorted(scene))}) and rig ({', '.join(sorted(rig))}): "
            "put them into two files"
        )
    raise ConfigError(
        f"{where}: neither scene nor rig: a scene has [fingertip] or [[finger]], and [[object]], a rig has [device] or "
        f"[devices.NAME]; "
        f"this has {', '.join(repr(key) for key in list(mapping)[:8]) or 'nothing'}"
    )


def scene_summary(scene: Scene) -> list[tuple[str, str]]:
    """What the contact step models, and what is left out of it."""
    tables = [scene.fingertip] if scene.fingertip is not None else scene.finger
    rows = []
    for finger, table in zip(scene.fingers, tables, strict=True):
        first, *others = _finger_rows(scene, finger)
        rows += [first, *entry_rows(table), *others]
    for item in scene.object:
        rows += _object_rows(item, scene.soft)
    rows += [(f"effect {effect.kind}", _values(effect)) for effect in scene.effect]
    return rows + ([] if scene.world is None else _world_rows(scene.world))


def _world_rows(world: World) -> list[tuple[str, str]]:
    """The model, and how its geoms were taken where that is not as they are."""
    from softfinger.config.mjcf import taken

    geoms = list(taken(world))
    touched = sum(geom.object is not None for geom in geoms)
    rows = [("world", f"{world.model}, {touched} of {len(geoms)} geoms touched, substeps {world.substeps}")]
    compiling = COMPILE_S[0] + COMPILE_S[1] * touched
    if compiling >= LONG_S:
        few = "to touch fewer give a material to these alone, by [[world.geom]]"
        rows.append(("  compiling", f"some {round(compiling, -1):g} s at the first start; {few}"))
    return rows + [(f"  geom '{geom.name}'", geom.note) for geom in geoms if geom.note]


def _finger_rows(scene: Scene, finger: FingerParts) -> list[tuple[str, str]]:
    coupling, probe = finger.coupling, finger.probe
    rolling = "left out: rotation moves no contact"
    if scene.rolling is not None:
        given = scene.rolling.torque_stiffness_n_per_m
        stiffness = coupling.stiffness_n_per_m if given is None else given
        rolling = f"{scene.rolling.method}, torque stiffness {stiffness:g} N/m"
    smoothing = f"low-pass {probe.velocity_time_constant_s:g} s" if probe.velocity_time_constant_s else "none"
    drags = "left out: nothing sticks"
    if any(item.material.friction is not None for item in scene.object):
        drags = f"{coupling.stiffness_n_per_m:g} N/m, {coupling.damping_ns_per_m:g} N s/m"
        if coupling.torsional_damping_nms_per_rad:
            drags += f", torsion damped by {coupling.torsional_damping_nms_per_rad:g} N m s/rad"
    what, moved = ("fingertip", "") if not finger.name else (f"finger '{finger.name}'", f", moved by {finger.device}")
    within = "" if not finger.name else "  "
    return [
        (what, f"{_form(finger)}{moved}"),
        (f"{within}patch", "left out" if finger.patch is None else _values(finger.patch)),
        (f"{within}rolling", rolling),
        (f"{within}coupling", drags),
        (f"{within}velocity filter", smoothing),
    ]


def _form(finger: FingerParts) -> str:
    if finger.radii_m is None:
        return f"sphere, radius {finger.radius_m:g} m"
    turn = "" if finger.orientation_wxyz == (1.0, 0.0, 0.0, 0.0) else f", turned by {shown(finger.orientation_wxyz)}"
    return f"ellipsoid, radii {shown(finger.radii_m)} m{turn}"


def _size(item: ObjectBase) -> str:
    """The shape's own dimensions, as the file has them."""
    own = [name for name in item.__struct_fields__ if name not in Textured.__struct_fields__]
    return "".join(f", {name} {shown(getattr(item, name))}" for name in own if getattr(item, name) is not None)


def _object_rows(item: Object, has_patch: bool) -> list[tuple[str, str]]:
    material = item.material
    friction, torsion = "left out: frictionless", "left out: no moment about the normal"
    if material.friction is not None:
        friction = _values(material.friction)
    if material.torsion is not None:
        torsion = f"of the patch, model {material.torsion.model}" if has_patch else _values(material.torsion)
    place = ", ".join(f"{value:g}" for value in item.position_m)
    damping = f"{material.damping_ns_per_m:g} N s/m" if material.damping_ns_per_m else "undamped"
    what = f"{item.shape} at ({place}) m{_size(item)}, {material.stiffness_n_per_m:g} N/m, {damping}"
    rows = [(f"object '{item.name}'", what), *entry_rows(material)]
    rows += [("  friction", friction), ("  torsion", torsion)]
    if material.normal is not None:
        rows.insert(-2, ("  normal force", _values(material.normal)))
    rows += [(f"  effect {effect.kind}", _values(effect)) for effect in item.effect]
    if item.motion is not None:
        rows.append((f"  motion {item.motion.kind}", _values(item.motion)))
    if isinstance(item, Heightmap):
        rows += _heightmap_rows(item)
    if isinstance(item, Textured) and item.texture is not None:
        rows += _texture_rows(item, item.texture)
    if isinstance(item, Mesh):
        rows += [(f"  {name}", text) for name, text in _report(item).rows(item.inside)]
    return rows


def _report(item: Mesh) -> Report:
    from softfinger.proxy.meshes.prepared import about
    from softfinger.server.progress import progress

    with progress(f"reading {item.file}"):
        return about(item).report


def _heightmap_rows(item: Heightmap) -> list[tuple[str, str]]:
    from softfinger.proxy.heightmaps import read_heights, tightest

    heights = read_heights(item)
    rows, columns = heights.shape
    size = f"{columns} x {rows} pixels, {columns * item.pitch_m:g} x {rows * item.pitch_m:g} m"
    low, high = float(heights.min()), float(heights.max())
    valley = tightest(heights, item.pitch_m)
    bends = "no valley" if valley == 0.0 else f"valleys bend with {1.0 / valley:.3g} m or more"
    return [
        ("  map", f"{size}, heights {low:g} to {high:g} m"),
        ("    bends", f"{bends}; where that is less than the fingertip's radius it touches in several places"),
    ]


def _texture_rows(item: Textured, texture: Texture) -> list[tuple[str, str]]:
    from softfinger.proxy.textures import FREQUENCY_MAX_HZ, REST, bounds, cutoff_m, make

    rows, columns = make(item).values.shape
    width, depth = texture.size_m
    found = [
        ("  texture", f"{texture.file}, {columns} x {rows} on {width:g} x {depth:g} m, border {texture.border}"),
        (
            "    filter",
            f"Gaussian, {REST:g} left at a wavelength of {cutoff_m(texture):g} m: {texture.speed_m_per_s:g} m/s at "
            f"{FREQUENCY_MAX_HZ:g} Hz",
        ),
    ]
    if texture.height_m is not None:
        left, slope, bend = bounds(item)
        stiffness = item.material.stiffness_under(Guard().force_max_n) * slope**2
        found.append(
            (
                "    height",
                f"{texture.height_m:g} m, {left:.3g} m after the filter, slope at most {slope:.3g}; along the surface "
                f"at most as stiff as {stiffness:.3g} N/m, and {bend:.3g} N/m more for each N of load",
            )
        )
    if texture.friction_scale is not None:
        found.append(("    friction", f"times {shown(texture.friction_scale)}, lowest to highest"))
    return found


def _values(table: Struct) -> str:
    """Keys and values of a table, without those left out and the tables in it."""
    pairs = ((name, getattr(table, name)) for name in table.__struct_fields__)
    return ", ".join(
        f"{name} {shown(value)}" for name, value in pairs if value is not None and not isinstance(value, Struct)
    )


def rig_summary(rig: Rig) -> list[tuple[str, str]]:
    """Device, loop, guard and telemetry in a line each."""
    servo, guard, telemetry = rig.servo, rig.guard, rig.telemetry
    processor = "any processor" if servo.cpu is None else f"processor {servo.cpu}"
    return [
        *(row for table, device in rig.tables.items() for row in _device(table, device)),
        ("servo", f"{servo.rate_hz:g} Hz, real time {servo.realtime}, priority {servo.priority}, {processor}"),
        ("guard, force", f"{guard.force_max_n:g} N, {guard.force_slew_n_per_s:g} N/s, ramp {guard.ramp_s:g} s"),
        ("guard, torque", f"{guard.torque_max_nm:g} N m, {guard.torque_slew_nm_per_s:g} N m/s"),
        ("guard, hand", _hand_limits(guard)),
        ("guard, workspace", _workspace(guard.workspace)),
        ("telemetry", telemetry.endpoint + (f", one tick in {telemetry.every}" if telemetry.every > 1 else "")),
        ("commands", rig.commands_endpoint or "off"),
        ("metrics", rig.metrics.endpoint or "off"),
    ]


def _hand_limits(guard: Guard) -> str:
    heat = "no heat limit"
    if guard.continuous_force_n is not None:
        heat = f"{guard.continuous_force_n:g} N for ever, heated in {guard.heat_time_s:g} s"
    return f"handle up to {guard.handle_speed_max_m_per_s:g} m/s, {guard.energy_max_j:g} J given, {heat}"


def _workspace(workspace: Workspace | None) -> str:
    if workspace is None:
        return "no soft wall"
    form = f"sphere of {workspace.radius_m} m" if workspace.size_m is None else f"box of {shown(workspace.size_m)} m"
    wall = f"soft wall of {workspace.stiffness_n_per_m:g} N/m up to {workspace.force_max_n:g} N"
    return f"{form} about {shown(workspace.center_m)} m of the device, {wall}"


def _device(table: str, device: DeviceConfig) -> list[tuple[str, str]]:
    options, tool = ", ".join(f"{key} = {shown(value)}" for key, value in device.options.items()), device.tool
    rows = [(table, device.driver + (f" ({options})" if options else "")), *_driver_rows(table, device)]
    if tool is not None:
        turned = f"turned by {shown(tool.orientation_wxyz)}"
        rows.append(("  tool", f"tip at {shown(tool.offset_m)} m of the handle, {turned}"))
    return rows


def _driver_rows(table: str, device: DeviceConfig) -> list[tuple[str, str]]:
    """What a driver adds of its own (`rows`), such as what a maker's service does to every force."""
    from softfinger.drivers import registry

    driver = registry.load(device.driver)
    rows = getattr(driver, "rows", None)
    return [] if rows is None else list(rows(build(driver.Options, device.options, f"[{table}]")))


def _locate(file: str) -> Path:
    """Path of a file or of a shipped scene or rig."""
    names = [*shipped(Scene), *shipped(Rig)]
    if file not in names and "." not in file and "/" not in file and not _exists(file):
        raise ConfigError(
            f"no scene or rig is called {shown(file)}{near(file, names)}; shipped are {', '.join(names)}; "
            "a file of your own is named with its ending .toml"
        )
    return find(file, Rig if file in shipped(Rig) else Scene)


def _exists(file: str) -> bool:
    try:
        return Path(file).exists()
    except (OSError, ValueError):  # no name that a file can have
        return False


def _check_driver(device: DeviceConfig, table: str, file: str) -> None:
    """Raise if there is no such driver, or if it does not take the rig's options."""
    from softfinger.drivers import registry

    try:
        driver = registry.load(device.driver)
    except HapticError as error:
        raise ConfigError(f"{file}: {table}.driver = {device.driver!r}: {error}") from error
    build(driver.Options, device.options, f"{file} [{table}]")


def _check_recording(device: DeviceConfig, table: str, file: str) -> None:
    """Raise if the recording that a rig replays cannot be."""
    if device.driver != "replay":
        return
    from softfinger.drivers.poses import load_poses

    try:
        load_poses(device.options["recording"])
    except RecordingError as error:
        raise ConfigError(f"{file}: {table}.recording: {error}") from error


def _show(finding: Finding) -> None:
    if finding.errors:
        print(f"{finding.file}: not usable", file=sys.stderr)
        for error in finding.errors:
            print(f"  {error}", file=sys.stderr)
        return
    print(f"{finding.file}: {finding.kind}, usable")
    _print_rows(finding.summary)


def _print_rows(rows: list[tuple[str, str]]) -> None:
    width = max((len(label) for label, _ in rows), default=0)
    for label, text in rows:
        print(f"  {label:{width}}  {text}")
