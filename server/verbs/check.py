"""`softfinger check`: check scenes, rigs and experiments, and summarise their contents.

The parts of a faulty scene or rig that are usable by themselves are checked too: files of its objects, its devices,
recordings and keys.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec

from softfinger.config.errors import ConfigError, DeviceError, HapticError, RecordingError
from softfinger.config.fields import is_complete, is_usable
from softfinger.config.load import FaultyConfig, attempt, describe, load_rig, load_scene
from softfinger.config.schema import DeviceConfig, Guard, Mesh, Object, Rig, Scene, Servo
from softfinger.config.sources import EXPERIMENTS, find, find_in, list_names, list_shipped, read_toml
from softfinger.config.words import format_value, suggest
from softfinger.proxy.kernels.jit.compiler.progress import COMPILE_PROGRESS
from softfinger.server.offline.summary import check_start, make_object_rows, report_mesh, summarize_rig, summarize_scene
from softfinger.server.progress import report_compilation, show_progress

RECORDING_DRIVERS: Final = ("replay", "simulated")
"""Drivers with an option `recording`, which they read when the device is opened."""


def check_parts(config: Any, file: str) -> list[str]:
    """Return the faults of the parts of a scene or rig; `file` is its name in messages."""
    checks = _iter_scene_checks(config) if isinstance(config, Scene) else _iter_rig_checks(config, file)
    faults = list[str]()
    for check in checks:
        attempt(check, faults)
    return faults


def _iter_scene_checks(scene: Scene) -> Iterator[Callable[[], object]]:
    for item in scene.object if is_usable(scene.object) else ():
        if (
            is_complete(item)
            and is_usable(item.shape)
            and not _has_complaint(item, "file")
            and not (isinstance(item, Mesh) and item.elastic is not None and any(item.elastic.faults()))
        ):
            yield partial(make_object_rows, item, has_patch=False)
    if scene.world is not None and is_complete(scene.world) and not _has_complaint(scene.world, "model"):
        from softfinger.config.mjcf import read_model

        yield partial(read_model, scene.world)


def _iter_rig_checks(rig: Any, file: str) -> Iterator[Callable[[], object]]:
    if not isinstance(rig, Rig):
        return
    if rig.security is not None and is_complete(rig.security):
        from softfinger.server.socket_process.allowed import list_key_folders

        yield partial(list_key_folders, rig.security)
    rate_hz = rig.servo.rate_hz if is_complete(rig.servo) else Servo().rate_hz
    tables = rig.tables if is_usable(rig.device, rig.devices) else {}
    for table, device in tables.items():
        if is_complete(device):
            yield partial(_check_device, device, rate_hz, table, file)


def _has_complaint(table: Any, key: str) -> bool:
    """Return True if the check of a table itself reports a key."""
    return any(name == key for name, *_ in table.faults())


def _check_device(device: DeviceConfig, rate_hz: float, table: str, file: str) -> None:
    """Raise ConfigError for an unknown driver, options or a rate that it refuses, or an unusable recording."""
    from softfinger.drivers import registry

    try:
        registry.load(device.driver)
    except HapticError as error:
        raise ConfigError(f"{file}: {table}.driver = {device.driver!r}: {error}") from error
    registry.check(device, rate_hz, f"{file} [{table}]")
    recording = device.options.get("recording")
    if device.driver not in RECORDING_DRIVERS or recording is None:
        return
    from softfinger.drivers.poses import load_poses

    try:
        load_poses(recording)
    except RecordingError as error:
        raise ConfigError(f"{file}: {table}.recording: {error}") from error


_SCENE_KEYS: Final = frozenset(Scene.__struct_fields__)
_RIG_KEYS: Final = frozenset(Rig.__struct_fields__)
_EXPERIMENT_KEYS: Final = frozenset(("task", "procedure"))


class FileReport(NamedTuple):
    """Result for one file: kind (scene, rig, experiment, or empty), summary rows, errors, content, meshes by object."""

    file: str
    kind: str
    summary: list[tuple[str, str]]
    errors: list[str]
    content: dict[str, Any]
    meshes: dict[str, Any]


def run(args: argparse.Namespace) -> int:
    """Check every file and print the results; return 0, or the exit code of ConfigError if any file is faulty."""
    findings = _add_start_errors([examine_file(file) for file in args.files])
    if args.explain:
        findings = [add_costs(finding) for finding in findings]
    if args.json:
        print(json.dumps([finding._asdict() | {"summary": dict(finding.summary)} for finding in findings], indent=2))
    else:
        for finding in findings:
            _show(finding)
    _draw_walls(findings, args.plot, quiet=args.json)
    return ConfigError.exit_code if any(finding.errors for finding in findings) else 0


def _add_start_errors(findings: list[FileReport]) -> list[FileReport]:
    """Return the findings, with an error for each scene whose [world] cannot start at the rate of a given rig."""
    usable = [finding for finding in findings if not finding.errors]
    rates = {load_rig(_locate(finding.file)).servo.rate_hz for finding in usable if finding.kind == "rig"}
    checked = []
    for finding in findings:
        try:
            world = load_scene(_locate(finding.file)).world if finding.kind == "scene" and not finding.errors else None
            for rate_hz in rates or {Servo().rate_hz}:
                if world is not None:
                    check_start(world, rate_hz)
        except ConfigError as error:
            finding = finding._replace(summary=[], errors=[str(error)])
        checked.append(finding)
    return checked


def _draw_walls(findings: list[FileReport], plot: Path | None, quiet: bool) -> None:
    """Print the soft wall of each rig around the objects of each scene, unless `quiet`, and save a picture as `plot`.

    Raises ConfigError if a plot is requested and there is not exactly one rig with a wall and one scene.
    """
    usable = [finding for finding in findings if not finding.errors]
    rigs = [(finding.file, load_rig(_locate(finding.file))) for finding in usable if finding.kind == "rig"]
    walls = [(name, rig, rig.guard.workspace) for name, rig in rigs if rig.guard.workspace is not None]
    scenes = [finding.file for finding in usable if finding.kind == "scene"]
    if plot is not None and len(walls) * len(scenes) != 1:
        raise ConfigError(
            f"--plot draws one rig with [guard.workspace] and one scene, but there are {len(walls)} and {len(scenes)}: "
            "select one of each"
        )
    if not walls or not scenes or (quiet and plot is None):
        return
    from softfinger.drivers.kinematics.subspace import read_subspace
    from softfinger.server.offline import workspace

    for name, rig, wall in walls:
        freedom = None if rig.device is None else read_subspace(rig.device)
        for scene in scenes:
            objects = workspace.place_objects(wall, load_scene(_locate(scene)))
            if plot is not None:
                workspace.plot(wall, objects, plot, freedom)
            if not quiet:
                print(f"the soft wall of {name} in {scene}")
                _print_rows(workspace.make_rows(wall, objects))
                print("\n".join(f"  {line}" for line in workspace.draw_text(wall, objects, freedom)))


def examine_file(file: str) -> FileReport:
    """Check a file for every fault that `run` finds before it opens the device, and summarise it if it has none."""
    kind = ""
    try:
        path = _locate(file)
        kind = find_kind(read_toml(path, file), file)
        if kind == "experiment":
            from softfinger.server.experiment.checks import load
            from softfinger.server.experiment.trial_order import describe_session

            experiment = load(path, {}, check_parts)[0]
            return FileReport(file, "experiment", describe_session(experiment), [], describe(experiment), {})
        with report_compilation("kernels that call the device") if kind == "rig" else nullcontext():
            config = load_scene(path) if kind == "scene" else load_rig(path)
            if faults := check_parts(config, file):
                return FileReport(file, kind, [], faults, {}, {})
            summary = summarize_scene(config) if isinstance(config, Scene) else summarize_rig(config)
    except FaultyConfig as error:
        faults = [*map(str, error.faults), *check_parts(error.config, file)]
        return FileReport(file, kind, [], faults, {}, {})
    except (ConfigError, DeviceError) as error:
        return FileReport(file, kind, [], [str(error)], {}, {})
    meshes = [mesh for mesh in config.object if isinstance(mesh, Mesh)] if isinstance(config, Scene) else []
    reports = {mesh.name: msgspec.to_builtins(report_mesh(mesh)) for mesh in meshes}
    return FileReport(file, kind, summary, [], describe(config), reports)


def add_costs(finding: FileReport) -> FileReport:
    """Add the measured cost of a tick and of its parts to the finding of a usable scene; return any other unchanged."""
    if finding.kind != "scene" or finding.errors:
        return finding
    from softfinger.server.loop.servo_thread import require_machine_code
    from softfinger.server.offline.cost import (
        estimate_kernels,
        iter_without_parts,
        keep_contact,
        make_touching_poses,
        measure,
    )

    scene = load_scene(_locate(finding.file))
    parts = list(iter_without_parts(scene))
    require_machine_code("--explain")
    COMPILE_PROGRESS.expect(estimate_kernels(scene, len(parts)))
    with show_progress(f"measuring {finding.file}", len(parts) + 2) as update:
        poses = make_touching_poses(scene)
        whole_ns = measure(scene, poses).median_ns
        rows = [("cost of a tick", f"{whole_ns:.0f} ns, back to back, pressed into the first object")]
        update(1)
        for number, (name, reduced_scene) in enumerate(parts):
            rows.append((f"  {name}", f"{whole_ns - measure(reduced_scene, poses).median_ns:+.0f} ns"))
            update(number + 2)
        rows.append(("  bare contact", f"{measure(keep_contact(scene), poses).median_ns:.0f} ns"))
    rows += [_make_stability_row(obj) for obj in scene.object]
    return finding._replace(summary=finding.summary + rows)


def _make_stability_row(item: Object) -> tuple[str, str]:
    """Return the stiffness of the normal force at the guard's default limit, and the device damping for passivity."""
    force, rate = Guard().force_max_n, Servo().rate_hz
    normal = item.material.normal
    crossed = 0.0 if normal is None else normal.damping_s_per_m or 0.0
    stiffness, damping = item.material.stiffness_under(force), item.material.damping_ns_per_m + crossed * force
    return (
        f"'{item.name}' at {force:g} N",
        f"{stiffness:.0f} N/m; passive at {rate:g} Hz on a device that damps more than "
        f"{0.5 * stiffness / rate + damping:.3g} N s/m by itself",
    )


def find_kind(mapping: dict[str, Any], where: str) -> str:
    """Return `scene`, `rig` or `experiment`, according to the tables of a file.

    Raises ConfigError if the tables belong to none of them, or to two.
    """
    if mapping.keys() >= _EXPERIMENT_KEYS:
        return "experiment"
    scene, rig = _SCENE_KEYS & mapping.keys(), _RIG_KEYS & mapping.keys()
    if scene and not rig:
        return "scene"
    if rig and not scene:
        return "rig"
    if rig and scene:
        raise ConfigError(
            f"{where}: both scene ({', '.join(sorted(scene))}) and rig ({', '.join(sorted(rig))}): use two files"
        )
    raise ConfigError(
        f"{where}: neither scene nor rig: a scene has [fingertip] or [[finger]], and [[object]], a rig has [device] or "
        f"[devices.NAME], an experiment [task] and [procedure]; "
        f"this has {', '.join(repr(key) for key in list(mapping)[:8]) or 'nothing'}"
    )


def _locate(file: str) -> Path:
    """Return the path of a file, or of a shipped scene, rig or experiment."""
    names = [*list_shipped(Scene), *list_shipped(Rig), *list_names(EXPERIMENTS)]
    if file not in names and "." not in file and "/" not in file and not _check_exists(file):
        raise ConfigError(
            f"no scene, rig or experiment is named {format_value(file)}{suggest(file, names)}; "
            "`softfinger scenes`, `rigs` and `experiments` list the shipped ones; name another file by its path with "
            "suffix .toml"
        )
    if file in list_names(EXPERIMENTS):
        return find_in(EXPERIMENTS, "experiment", file)
    return find(file, Rig if file in list_shipped(Rig) else Scene)


def _check_exists(file: str) -> bool:
    try:
        return Path(file).exists()
    except (OSError, ValueError):  # not a valid file name
        return False


def _show(finding: FileReport) -> None:
    if finding.errors:
        print(f"{finding.file}: not usable", file=sys.stderr)
        for error in finding.errors:
            print(f"  {error.removeprefix(f'{finding.file}: ')}", file=sys.stderr)
        return
    print(f"{finding.file}: {finding.kind}, usable")
    _print_rows(finding.summary)


def _print_rows(rows: list[tuple[str, str]]) -> None:
    width = max((len(label) for label, _ in rows), default=0)
    for label, text in rows:
        print(f"  {label:{width}}  {text}")
