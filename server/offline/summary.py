"""Summaries of a scene's model and of a rig, as rows of name and text."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from msgspec import Struct

from softfinger.config import schema
from softfinger.config.load import build
from softfinger.config.words import format_value
from softfinger.server.offline.library_texts import make_entry_rows

if TYPE_CHECKING:  # with the kernels behind them, which no rig needs
    from softfinger.proxy.meshes.report import MeshReport


OVERSHOOT_SHARE: Final = 0.02
"""Share of a map's height by which its surface may leave its pixels before the summary mentions it."""


def summarize_scene(scene: schema.Scene) -> list[tuple[str, str]]:
    """Return rows on the parts that the contact step models, and on the omitted ones."""
    tables = [scene.fingertip] if scene.fingertip is not None else scene.finger
    rows = []
    for finger, table in zip(scene.fingers, tables, strict=True):
        first, *others = _make_finger_rows(scene, finger)
        rows += [first, *make_entry_rows(table), *others]
    for item in scene.object:
        rows += make_object_rows(item, scene.soft)
    rows += [(f"effect {effect.kind}", _format_values(effect)) for effect in scene.effect]
    return rows + ([] if scene.world is None else _make_world_rows(scene.world))


def _make_finger_rows(scene: schema.Scene, finger: schema.FingerParts) -> list[tuple[str, str]]:
    coupling, probe = finger.coupling, finger.probe
    rolling = "absent: rotation does not move the contact"
    if scene.rolling is not None:
        own_stiffness = scene.rolling.torque_stiffness_n_per_m
        stiffness = coupling.stiffness_n_per_m if own_stiffness is None else own_stiffness
        rolling = f"{scene.rolling.method}, torque stiffness {stiffness:g} N/m"
    smoothing = f"low-pass {probe.velocity_time_constant_s:g} s" if probe.velocity_time_constant_s else "none"
    drags = "not used: no object has friction"
    if any(item.material.friction is not None for item in scene.object):
        drags = f"{coupling.stiffness_n_per_m:g} N/m, {coupling.damping_ns_per_m:g} N s/m"
        if coupling.torsional_damping_nms_per_rad:
            drags += f", torsion damped by {coupling.torsional_damping_nms_per_rad:g} N m s/rad"
    label, moved_text = (
        ("fingertip", "") if not finger.name else (f"finger '{finger.name}'", f", moved by {finger.device}")
    )
    within = "" if not finger.name else "  "
    return [
        (label, f"{_describe_form(finger)}{moved_text}"),
        (f"{within}patch", "absent" if finger.patch is None else _format_values(finger.patch)),
        (f"{within}rolling", rolling),
        (f"{within}coupling", drags),
        (f"{within}velocity filter", smoothing),
    ]


def _describe_form(finger: schema.FingerParts) -> str:
    if finger.radii_m is None:
        return f"sphere, radius {finger.radius_m:g} m"
    turn = (
        ""
        if finger.orientation_wxyz == (1.0, 0.0, 0.0, 0.0)
        else f", turned by {format_value(finger.orientation_wxyz)}"
    )
    return f"ellipsoid, radii {format_value(finger.radii_m)} m{turn}"


def _size(item: schema.ObjectBase) -> str:
    names = [name for name in item.__struct_fields__ if name not in (*schema.Textured.__struct_fields__, "elastic")]
    return "".join(f", {name} {format_value(getattr(item, name))}" for name in names if getattr(item, name) is not None)


def make_object_rows(item: schema.Object, has_patch: bool) -> list[tuple[str, str]]:
    """Return the rows of an object. Raises ConfigError for a file of it that cannot be used."""
    material = item.material
    friction, torsion = "absent: frictionless", "absent: no moment about the normal"
    if material.friction is not None:
        friction = _format_values(material.friction)
    if material.torsion is not None:
        torsion = f"of the patch, model {material.torsion.model}" if has_patch else _format_values(material.torsion)
    place = ", ".join(f"{value:g}" for value in item.position_m)
    damping = f"{material.damping_ns_per_m:g} N s/m" if material.damping_ns_per_m else "undamped"
    description = f"{item.shape} at ({place}) m{_size(item)}, {material.stiffness_n_per_m:g} N/m, {damping}"
    rows = [(f"object '{item.name}'", description), *make_entry_rows(material)]
    rows += [("  friction", friction), ("  torsion", torsion)]
    if material.normal is not None:
        rows.insert(-2, ("  normal force", _format_values(material.normal)))
    rows += [(f"  effect {effect.kind}", _format_values(effect)) for effect in item.effect]
    if item.motion is not None:
        rows.append((f"  motion {item.motion.kind}", _format_values(item.motion)))
    if isinstance(item, schema.Heightmap):
        rows += _make_heightmap_rows(item)
    if isinstance(item, schema.Textured) and item.texture is not None:
        rows += _make_texture_rows(item, item.texture)
    if isinstance(item, schema.Mesh):
        rows += [(f"  {name}", text) for name, text in report_mesh(item).rows(item.inside)]
        if item.elastic is not None:
            rows += _make_elastic_rows(item, item.elastic)
    return rows


def report_mesh(item: schema.Mesh) -> MeshReport:
    from softfinger.proxy.meshes.prepared import describe_mesh
    from softfinger.server.progress import show_progress

    if item.elastic is not None:
        from softfinger.proxy.elastic.prepared import prepare_body

        prepare_body(item)  # shows its own progress
    with show_progress(f"reading {item.file}"):
        return describe_mesh(item).report


def _make_elastic_rows(item: schema.Mesh, elastic: schema.Elastic) -> list[tuple[str, str]]:
    from softfinger.proxy.elastic.prepared import prepare_body

    report, force = prepare_body(item).report, schema.Guard().force_max_n
    softest = max(report.compliances) / elastic.youngs_pa
    error = "not estimated: the file has one mesh" if report.error is None else f"{100.0 * report.error:.2g} %"
    rows = [
        ("  elastic", _format_values(elastic)),
        ("  volume mesh",
         f"{report.tetrahedra:,} tetrahedra of {report.vertices:,} vertices, {report.nodes:,} compliant; "
         f"quality {report.worst_quality:.2g} at worst, {report.mean_quality:.2g} on average; estimated error {error}"),
        ("  largest displacement", f"{1000.0 * softest * force:.3g} mm at {force:g} N, of the points below"),
    ]  # fmt: skip
    for point, compliance in zip(report.points, report.compliances, strict=True):
        place = ", ".join(f"{round(1000.0 * value, 3) + 0.0:g}" for value in point)
        rows.append((f"  at ({place}) mm", f"{elastic.youngs_pa / compliance:.4g} N/m along the normal"))
    return rows


def _make_heightmap_rows(item: schema.Heightmap) -> list[tuple[str, str]]:
    from softfinger.proxy.heightmaps import bound_curvature, measure_overshoot, read_heights

    heights = read_heights(item)
    rows, columns = heights.shape
    size = f"{columns} x {rows} pixels, {columns * item.pitch_m:g} x {rows * item.pitch_m:g} m"
    low, high = float(heights.min()), float(heights.max())
    valley = bound_curvature(heights, item.pitch_m)
    bends = "no valley" if valley == 0.0 else f"valleys bend with {1.0 / valley:.3g} m or more"
    lines = [
        ("  map", f"{size}, heights {low:g} to {high:g} m"),
        ("    bends", f"{bends}; where that is less than the fingertip's radius it touches in several places"),
    ]
    if (over := measure_overshoot(heights)) > OVERSHOOT_SHARE * (high - low):
        beyond = f"the smooth surface is up to {over:.3g} m higher or lower than the neighbouring pixels"
        lines.append(("    steps", f"{beyond}; a step spread over more pixels has less"))
    return lines


def _make_texture_rows(item: schema.Textured, texture: schema.Texture) -> list[tuple[str, str]]:
    from softfinger.proxy.textures import FREQUENCY_MAX_HZ, REMAINING_SHARE, compute_bounds, compute_cutoff_m, make

    rows, columns = make(item).values.shape
    width, depth = texture.size_m
    lines = [
        ("  texture", f"{texture.file}, {columns} x {rows} on {width:g} x {depth:g} m, border {texture.border}"),
        (
            "    filter",
            f"Gaussian, {REMAINING_SHARE:g} left at a wavelength of {compute_cutoff_m(texture):g} m: "
            f"{texture.speed_m_per_s:g} m/s at {FREQUENCY_MAX_HZ:g} Hz",
        ),
    ]
    if texture.height_m is not None:
        rendered_height, slope, bend = compute_bounds(item)
        stiffness = item.material.stiffness_under(schema.Guard().force_max_n) * slope**2
        lines.append(
            (
                "    height",
                f"{texture.height_m:g} m, {rendered_height:.3g} m after the filter, slope at most {slope:.3g}; along "
                f"the surface at most as stiff as {stiffness:.3g} N/m, and {bend:.3g} N/m more for each N of load",
            )
        )
    if texture.friction_scale is not None:
        lines.append(("    friction", f"times {format_value(texture.friction_scale)}, lowest to highest"))
    return lines


def _format_values(table: Struct) -> str:
    """Format keys and values of a table, except None and nested tables."""
    pairs = ((name, getattr(table, name)) for name in table.__struct_fields__)
    return ", ".join(
        f"{name} {format_value(value)}" for name, value in pairs if value is not None and not isinstance(value, Struct)
    )


def summarize_rig(rig: schema.Rig) -> list[tuple[str, str]]:
    servo, guard, telemetry = rig.servo, rig.guard, rig.telemetry
    processor = "any processor" if servo.cpu is None else f"processor {servo.cpu}"
    heat = "no heat limit"
    if guard.continuous_force_n is not None:
        heat = f"{guard.continuous_force_n:g} N continuous, heated in {guard.heat_time_s:g} s"
    hand = f"handle up to {guard.handle_speed_max_m_per_s:g} m/s, {guard.energy_max_j:g} J given, {heat}"
    return [
        *(row for table, device in rig.tables.items() for row in _describe_device(table, device)),
        ("servo", f"{servo.rate_hz:g} Hz, real time {servo.realtime}, priority {servo.priority}, {processor}"),
        ("guard, force", f"{guard.force_max_n:g} N, {guard.force_slew_n_per_s:g} N/s, ramp {guard.ramp_s:g} s"),
        ("guard, torque", f"{guard.torque_max_nm:g} N m, {guard.torque_slew_nm_per_s:g} N m/s"),
        ("guard, hand", hand),
        ("guard, workspace", _describe_workspace(guard.workspace)),
        ("telemetry", telemetry.endpoint + (f", one tick in {telemetry.every}" if telemetry.every > 1 else "")),
        ("commands", rig.commands_endpoint or "off"),
        ("metrics", rig.metrics.endpoint or "off"),
    ]


def _describe_workspace(workspace: schema.Workspace | None) -> str:
    if workspace is None:
        return "no soft wall"
    form = (
        f"sphere of {workspace.radius_m} m"
        if workspace.size_m is None
        else f"box of {format_value(workspace.size_m)} m"
    )
    wall = f"soft wall of {workspace.stiffness_n_per_m:g} N/m up to {workspace.force_max_n:g} N"
    return f"{form} about {format_value(workspace.center_m)} m of the device, {wall}"


def _describe_device(table: str, device: schema.DeviceConfig) -> list[tuple[str, str]]:
    options, tool = ", ".join(f"{key} = {format_value(value)}" for key, value in device.options.items()), device.tool
    rows = [(table, device.driver + (f" ({options})" if options else "")), *_make_driver_rows(table, device)]
    if tool is not None:
        turned_text = f"turned by {format_value(tool.orientation_wxyz)}"
        rows.append(("  tool", f"tip at {format_value(tool.offset_m)} m of the handle, {turned_text}"))
    return rows


def _make_driver_rows(table: str, device: schema.DeviceConfig) -> list[tuple[str, str]]:
    """Return the rows of a driver (`rows`), such as the effect of a maker's service on forces."""
    from softfinger.drivers import registry

    driver = registry.load(device.driver)
    rows = getattr(driver, "rows", None)
    return [] if rows is None else list(rows(build(driver.Options, device.options, f"[{table}]")))


def _make_world_rows(world: schema.World) -> list[tuple[str, str]]:
    """Return rows of the model, its time step and start, and of the geoms that differ from MuJoCo's."""
    from softfinger.config.mjcf import compile_model
    from softfinger.config.mjcf_geoms import convert_geoms

    geoms = list(convert_geoms(world))
    touched = sum(geom.object is not None for geom in geoms)
    rows = [("world", f"{world.model}, {touched} of {len(geoms)} geoms touched, substeps {world.substeps}")]
    rows.append(
        ("  timestep", _format_timestep(world, float(compile_model(world.model, world.root).model.opt.timestep)))
    )
    if world.keyframe is not None:
        rows.append(("  keyframe", world.keyframe))
    return rows + [(f"  geom '{geom.name}'", geom.note) for geom in geoms if geom.note]


def check_start(world: schema.World, rate_hz: float = schema.Servo().rate_hz) -> None:
    """Raise ConfigError if the bodies of a world cannot begin at this rate."""
    from softfinger.proxy.bodies import RigidBodies

    RigidBodies(world).begin(1.0 / rate_hz)


def _format_timestep(world: schema.World, model_step: float) -> str:
    if world.timestep == "file":
        return f"{model_step:g} s, the model's own: a tick at servo.rate_hz = {1.0 / (model_step * world.substeps):g}"
    step = 1.0 / (schema.Servo().rate_hz * world.substeps)
    text = f"a tick's, {step:g} s at {schema.Servo().rate_hz:g} Hz; the model's own is {model_step:g} s"
    if model_step < 0.999 * step:
        text += f": substeps = {math.ceil(step * world.substeps / model_step - 1e-3)} would match it"
    return text
