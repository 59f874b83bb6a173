"""Scene and rig files: accepted values, and the message of every fault."""

import itertools
import json
import math
import os
import re
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import msgspec
import pytest
from helpers.called import called
from helpers.examples import examples
from helpers.refusals import faults_in, refusal
from hypothesis import given, settings
from hypothesis import strategies as st

from softfinger.config import limits, schema
from softfinger.config.errors import ConfigError
from softfinger.config.load import build, describe, load_rig, load_scene
from softfinger.config.schema import Faults, Rig, Scene, make_commands_address
from softfinger.config.schema.pairing import find_single_device, pair_devices
from softfinger.config.sources import list_shipped
from softfinger.config.words import PATTERNS, suggest
from softfinger.drivers.haply import options as haply_options
from softfinger.drivers.serial.options import CHECKS
from softfinger.proxy.record import FIELDS
from softfinger.proxy.scene import build_scene
from softfinger.server.experiment.schema import ExperimentFile
from softfinger.server.verbs import schema as schema_verb
from softfinger.server.wire.commands import METHODS

pytestmark = pytest.mark.plain

ROOT = Path(__file__).resolve().parents[2]
ANY_SHAPE = "one of 'plane', 'sphere', 'cylinder', 'capsule', 'box', 'ellipsoid', 'torus', 'heightmap', 'mesh'"


def scene() -> dict[str, Any]:
    """Return a small valid scene with every table, as parsed from a file."""
    torsion = {"stiffness_nm_per_rad": 0.05, "friction_length_m": 0.004}
    material = {"stiffness_n_per_m": 1000, "friction": {"static": 0.6, "kinetic": 0.5}, "torsion": torsion}
    pose = {"position_m": [0, 0, 0], "orientation_wxyz": [1, 0, 0, 0]}
    return {
        "fingertip": {"radius_m": 0.01},
        "rolling": {"method": "euler_zxz"},
        "coupling": {"stiffness_n_per_m": 1000.0, "damping_ns_per_m": 1.0},
        "probe": {"velocity_time_constant_s": 0.002, "position_resolution_m": 0.0},
        "object": [{"name": "table", "shape": "plane", **pose, "material": material}],
    }


def rig() -> dict[str, Any]:
    return {
        "device": {"driver": "replay", "recording": "x"},
        "servo": {"rate_hz": 1000},
        "guard": {"force_max_n": 12},
        "telemetry": {"every": 1},
        "commands": {},
    }


def set_key(mapping: dict[str, Any], key: str, value: Any) -> dict[str, Any]:
    """Set the value at a dotted key and return the mapping; `...` removes the key."""
    *path, last = [int(part) if part.isdigit() else part for part in re.split(r"[.\[\]]+", key) if part]
    at: Any = mapping
    for part in path:
        at = at[part]
    if value is ...:
        del at[last]
    else:
        at[last] = value
    return mapping


def faults_of(struct_type: type[msgspec.Struct], mapping: object) -> list[str]:
    return [str(fault) for fault in faults_in(build, struct_type, mapping, "f.toml")]


def refusal_or_none(call: Callable[..., object], *args: Any) -> str | None:
    """Return the message of the ConfigError that a call raises, or None; other errors propagate."""
    try:
        call(*args)
    except ConfigError as error:
        return str(error)
    return None


def test_paper_scene_has_the_values_of_the_paper() -> None:
    paper = load_scene("paper-plane")
    (table,) = paper.object
    assert paper.fingertip.radius_m == 0.01 and paper.rolling == schema.Rolling(method="euler_zxz")
    assert paper.coupling == schema.Coupling(stiffness_n_per_m=1000.0, damping_ns_per_m=1.0)
    assert (table.shape, table.position_m, table.orientation_wxyz) == ("plane", (0, 0, 0), (1, 0, 0, 0))
    assert (table.material.stiffness_n_per_m, table.material.damping_ns_per_m) == (1000.0, 0.0)
    assert table.material.friction == schema.Friction(static=0.6, kinetic=0.5)
    assert table.material.torsion == schema.Torsion(stiffness_nm_per_rad=0.05, friction_length_m=0.004)


def test_default_rig_replays_the_shipped_recording_and_has_the_default_limits() -> None:
    replay = load_rig("replay")
    assert replay.device.driver == "replay"
    assert replay.device.options == {"recording": "press-roll-spin-drag", "loop": True}
    assert (replay.servo, replay.guard, replay.telemetry) == (schema.Servo(), schema.Guard(), schema.Telemetry())


@pytest.mark.parametrize("kind", [Scene, Rig])
def test_every_shipped_file_loads_and_survives_a_round_trip(kind: type[Scene | Rig]) -> None:
    names = list_shipped(kind)
    assert names
    for name in names:
        config: msgspec.Struct = load_scene(name) if kind is Scene else load_rig(name)
        assert build(kind, describe(config), name) == config


@pytest.mark.parametrize("path", sorted((ROOT / "config").glob("*/*.toml")), ids=lambda path: path.stem)
def test_shipped_values_have_a_reason(path: Path) -> None:
    for line in path.read_text("utf-8").splitlines():
        match = re.match(r'(\w+) = ((?:"[^"]*"|[^#"])*?)\s*(#.*)?$', line)
        if match is None or match[2].startswith('"'):
            continue
        assert match[3], f"{path.name}: no reason beside: {line}"
        expected = schema.find_unit(match[1])
        assert match[3].startswith(f"# {expected}: " if expected else "# "), f"{path.name}: {line}"


@given(st.lists(st.floats(-1000, 1000), min_size=4, max_size=4).filter(any))
@settings(max_examples=200, deadline=None)
def test_any_quaternion_but_zero_is_normalised_once(quaternion: list[float]) -> None:
    built = build(Scene, set_key(scene(), "object[0].orientation_wxyz", quaternion), "f.toml")
    turned, norm = built.object[0].orientation_wxyz, math.hypot(*quaternion)
    tiny = max(abs(part) for part in quaternion) < 1e-300  # subnormals have few bits
    assert turned == pytest.approx([part / norm for part in quaternion], abs=0.5 if tiny else 4e-16)
    assert tiny or build(Scene, describe(built), "f.toml").object[0].orientation_wxyz == turned


SCENE_FAULTS = [
    ("fingertip.radius_m", 0, ["fingertip.radius_m = 0:", "from 1e-05 to 1000 m", "tested between these"]),
    ("fingertip.radius_m", "10 mm", ["fingertip.radius_m = '10 mm':", "a number from 1e-05 to 1000 m"]),
    ("fingertip.radius_m", True, ["fingertip.radius_m = true:", "a number"]),
    ("fingertip.radius_m", math.nan, ["fingertip.radius_m = nan:", "a number"]),
    ("fingertip.radius_m", math.inf, ["fingertip.radius_m = inf:", "a number"]),
    ("fingertip.radius_m", 10**400, ["fingertip.radius_m = an integer of 1329 bits:"]),
    ("fingertip.radius_m", 10**6000, ["fingertip.radius_m = an integer of 19932 bits: must be a number from 1e-05"]),
    ("fingertip.radius_m", ..., ["fingertip.radius_m: is missing", "to 1000 m", "such as radius_m = 0.01"]),
    ("fingertip", ..., ["fingertip: is missing: add the table [fingertip], or a table [[finger]]"]),
    ("fingertip", 0.01, ["fingertip = 0.01: must be a table"]),
    ("fingertip.radius_mm", 10, ["fingertip.radius_mm is not a key here (did you mean 'radius_m'?)"]),
    ("fingertop", {}, ["fingertop is not a key here (did you mean 'fingertip'?)", "keys are fingertip, finger, "]),
    ("rolling.method", "euler_zx", ["rolling.method = 'euler_zx': must be one of", "(did you mean 'euler_z"]),
    ("rolling.method", 5, ["rolling.method = 5: must be one of 'euler_zxz', 'euler_zyx'"]),
    ("rolling.method", ..., ["rolling.method is missing: give one of 'euler_zxz'", 'such as method = "euler_zxz"']),
    ("rolling.torque_stiffness_n_per_m", 2000.0, ["must be at most coupling.stiffness_n_per_m = 1000 N/m"]),
    ("rolling.torque_stiffness_n_per_m", 0, ["rolling.torque_stiffness_n_per_m = 0:", "from 0.001 to 1e+06 N/m"]),
    ("object[0].material.friction", ..., ["rolling: needs friction", "remove [rolling]"]),
    ("object[0].material.friction.kinetic", 0.7, ["friction.kinetic = 0.7: must be at most static = 0.6"]),
    ("object[0].material.friction.static", -1, ["object[0].material.friction.static = -1:", "from 0 to 1000"]),
    ("object[0].material", ..., ["object[0].material is missing: add the table [object.material]"]),
    ("object[0].shape", "plain", [f"object[0].shape = 'plain': must be {ANY_SHAPE} (did you mean 'plane'?)"]),
    ("object[0].shape", ["plane"], [f"object[0].shape = ['plane']: must be {ANY_SHAPE}"]),
    ("object[0].shape", ..., [f"object[0].shape is missing: give {ANY_SHAPE}, such as shape = 'plane'"]),
    ("object[0].radius_m", 1.0, ["object[0].radius_m is not a key here", "keys are shape, name, position_m"]),
    ("object[0].name", "", ["object[0].name = '': must be text of 1 to 64 characters"]),
    ("object[0].name", "a\nb", [r"object[0].name = 'a\nb': must have printable characters"]),
    ("object[0].name", 7, ["object[0].name = 7: must be text"]),
    ("object[0].name", "1", ["object[0].name = '1': starts with a digit, but object.1 selects the second object"]),
    ("object[0].name", "01.top", ["object[0].name = '01.top': starts with a digit"]),
    ("object[0].position_m", [1, 2], ["object[0].position_m = [1, 2]: must be a list of 3 numbers", "this has 2"]),
    ("object[0].position_m", 1, ["object[0].position_m = 1: must be a list of 3 numbers from -1000 to 1000 m"]),
    ("object[0].position_m", [0, math.nan, 0], ["object[0].position_m[1] = nan:", "from -1000 to 1000 m"]),
    ("object[0].orientation_wxyz", [0, 0, 0, 0], ["object[0].orientation_wxyz = [0.0, 0.0, 0.0, 0.0]: all zero"]),
    ("object[0]", 5, ["object[0] = 5: must be a table"]),
    ("object", [], ["object = []: must be a list of 1 to 256 tables, this has 0"]),
    ("object", {}, ["object = a table: must be a list of 1 to 256 tables: write [[object]]"]),
    ("object", 2 * scene()["object"], ["object[1].name = 'table': is already the name of object[0]: choose another"]),
    ("object", ..., ["object: is missing: add at least one table [[object]]"]),
]

RIG_FAULTS = [
    ("device", ..., ["device: is missing: add the table [device], or a table [devices.NAME]"]),
    ("device.driver", ..., ["device.driver is missing", 'such as driver = "replay"']),
    ("servo.rate_hz", 99, ["servo.rate_hz = 99: must be a number from 100 to 8000 Hz", "walls chatter"]),
    ("servo.rate_hz", 8000.5, ["servo.rate_hz = 8000.5: must be a number from 100 to 8000 Hz"]),
    ("servo.rate", 1000, ["servo.rate is not a key here (did you mean 'rate_hz'?)"]),
    ("servo.realtime", "on", ["servo.realtime = 'on': must be one of 'auto', 'off', 'require'"]),
    ("servo.priority", 100, ["servo.priority = 100: must be an integer from 1 to 99"]),
    ("servo.priority", -(10**6000), ["servo.priority = an integer of 19932 bits: must be an integer from 1 to 99"]),
    ("servo.cpu", 1.0, ["servo.cpu = 1.0: must be an integer from 0 to 1023"]),
    ("servo.cpu", True, ["servo.cpu = true: must be an integer"]),
    ("guard.force_max_n", 41, ["guard.force_max_n = 41: must be a number from 0 to 40 N"]),
    ("guard.torque_max_nm", 2.1, ["guard.torque_max_nm = 2.1: must be a number from 0 to 2 N m"]),
    ("guard.force_slew_n_per_s", 1e5, ["guard.force_slew_n_per_s = 100000.0:", "to 20000 N/s"]),
    ("guard.torque_slew_nm_per_s", 1e5, ["guard.torque_slew_nm_per_s = 100000.0:", "to 1000 N m/s"]),
    ("guard.ramp_s", 0, ["guard.ramp_s = 0: must be a number from 0.01 to 10 s"]),
    ("telemetry.every", 0, ["telemetry.every = 0: must be an integer from 1 to 10000"]),
    ("telemetry.endpoint", "tcp://*:5555", ["telemetry.endpoint = 'tcp://*:5555': is open to the network"]),
    ("telemetry.endpoint", "tcp://127.evil.org:5555", ["is open to the network"]),
    ("telemetry.endpoint", "tcp://localhost.evil.org:5555", ["is open to the network"]),
    ("telemetry.endpoint", "tcp://127.0.0.1.evil.org:5555", ["is open to the network"]),
    ("telemetry.endpoint", "tcp://127.0.0.1", ["telemetry.endpoint = 'tcp://127.0.0.1': must be tcp://HOST:PORT"]),
    ("telemetry.endpoint", "tcp://127.0.0.1:65536", ["port 0 to 65535"]),
    ("telemetry.endpoint", "udp://127.0.0.1:5555", ["must be tcp://HOST:PORT"]),
    ("telemetry.endpoint", "ipc://", ["must have a path of 1 to 107 bytes"]),
    ("telemetry.endpoint", "ipc:///tmp/\udcff", ["must have a path in UTF-8"]),
    (
        "telemetry.endpoint",
        "ipc:///" + 99 * "x",
        ["commands.endpoint: ipc:///xxx", "must have a path of 1 to 107 bytes: set another"],
    ),
    ("commands.endpoint", "tcp://0.0.0.0:5556", ["commands.endpoint = 'tcp://0.0.0.0:5556': is open to the network"]),
    ("commands.endpoint", "tcp://127.0.0.1:5555", ["is also the telemetry endpoint"]),
    ("commands.endpoint", "none", ["must be tcp://HOST:PORT", "or off"]),
    ("commands.heartbeat_s", 0.0, ["must be a number from 0.05 to 60 s"]),
    ("commands", {"endpoint": "off", "heartbeat_s": 1.0}, ["no client can send a heartbeat while commands are off"]),
    ("devices", {"thumb": rig()["device"]}, ["cannot be combined with [devices]"]),
]


def rig_of_two() -> dict[str, Any]:
    return {key: value for key, value in rig().items() if key != "device"} | {"devices": {"thumb": rig()["device"]}}


FINGERS: list[dict[str, Any]] = [{"name": "thumb", "radius_m": 0.01}, {"name": "index", "radius_m": 0.008}]
"""Two fingers, as parsed from a file."""


def pinch_scene(**changes: Any) -> dict[str, Any]:
    """Return a scene with two fingers, the second changed by `changes`."""
    return {
        **{k: v for k, v in scene().items() if k != "fingertip"},
        "finger": [dict(FINGERS[0]), FINGERS[1] | changes],
    }


FINGER_FAULTS = [
    ("name", "thumb", "finger[1].name = 'thumb': overlaps with the name of finger[0], 'thumb'"),
    ("name", "thumb-2", "finger[1].name = 'thumb-2': overlaps with the name of finger[0], 'thumb'"),
    ("name", "th", "finger[1].name = 'th': overlaps with the name of finger[0], 'thumb'"),
    ("name", "a/b", "finger[1].name = 'a/b': must be text of 1 to 32 characters with only A to Z, a to z, 0"),
    ("name", "index\n", r"finger[1].name = 'index\n': must be text"),
    ("device", "thumb", "finger[1].device = 'thumb': already moves finger[0]"),
    ("radius_m", -1.0, "finger[1].radius_m = -1.0: must be a number from 1e-05 to 1000 m"),
    ("coupling", {"damping": 1.0}, "finger[1].coupling.damping is not a key here"),
]
FAULTS = [
    *((Scene, scene, *fault) for fault in SCENE_FAULTS),
    *((Rig, rig, *fault) for fault in RIG_FAULTS),
    *((Scene, pinch_scene, f"finger[1].{key}", value, [f"f.toml: {fault}"]) for key, value, fault in FINGER_FAULTS),
    (Scene, pinch_scene, "fingertip", {"radius_m": 0.01}, ["cannot be combined with [[finger]]"]),
    (Scene, lambda: pinch_scene(coupling={"stiffness_n_per_m": 100.0}), "rolling.torque_stiffness_n_per_m", 500.0,
     ["must be at most finger[1].coupling.stiffness_n_per_m = 100 N/m"]),
    (Scene, pinch_scene, "finger[0].device", "index", ["finger[1].device = 'index': already moves finger[0]"]),
    (Rig, rig_of_two, "devices", {"a.b": rig()["device"]}, ["must be text of 1 to 32 characters"]),
    (Rig, rig_of_two, "devices.thumb.driver", ..., ["f.toml: devices.thumb.driver is missing"]),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "make", "key", "value", "fragments"), FAULTS, ids=itertools.count())
def test_a_fault_names_file_key_value_and_range(kind, make, key, value, fragments):
    (fault,) = faults_of(kind, set_key(make(), key, value))
    assert fault.startswith("f.toml: ")
    assert [part for part in fragments if part not in fault] == [], fault


@pytest.mark.parametrize(
    "endpoint",
    ["tcp://127.0.0.1:5555", "tcp://localhost:*", "tcp://[::1]:0", "tcp://127.1.2.3:65535", "ipc:///run/softfinger"],
)
def test_local_endpoints_are_accepted(endpoint: str) -> None:
    assert build(Rig, set_key(rig(), "telemetry.endpoint", endpoint), "f.toml").telemetry.endpoint == endpoint


@pytest.mark.parametrize(
    ("telemetry", "endpoint", "expected"),
    [
        ("tcp://127.0.0.1:5555", None, "ipc:///run/user/7/softfinger/5555.commands"),
        ("tcp://[::1]:65535", None, "ipc:///run/user/7/softfinger/65535.commands"),
        ("ipc:///run/t", None, "ipc:///run/t.commands"),
        ("ipc:///run/t", "tcp://127.0.0.1:9", "tcp://127.0.0.1:9"),
        ("tcp://127.0.0.1:*", "tcp://127.0.0.1:*", "tcp://127.0.0.1:*"),
        ("ipc:///run/t", "off", None),
    ],
)
def test_command_endpoint_follows_from_the_telemetry_endpoint(telemetry, endpoint, expected, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/run/user/7")
    commands = {"commands": {"endpoint": endpoint}} if endpoint else {}
    mapping = set_key(rig(), "telemetry.endpoint", telemetry) | commands
    assert build(Rig, mapping, "f.toml").commands_endpoint == expected


@pytest.mark.parametrize(
    ("telemetry", "expected"),
    [
        ("tcp://rig.lab:5555", "tcp://rig.lab:5556"),
        ("tcp://0.0.0.0:65535", "tcp://0.0.0.0:65534"),
        ("tcp://0.0.0.0:*", "tcp://0.0.0.0:*"),
    ],
)
def test_commands_of_public_telemetry_are_on_the_next_port(telemetry: str, expected: str) -> None:
    """Other machines cannot reach a Unix socket, so public telemetry has its commands on a neighbouring port."""
    assert make_commands_address(telemetry) == expected


def test_commands_without_a_runtime_folder_are_in_the_temp_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    folder = Path(tempfile.gettempdir()) / f"softfinger-{os.geteuid()}"
    assert make_commands_address("tcp://127.0.0.1:5555") == f"ipc://{folder}/5555.commands"
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/" + 90 * "x")
    (fault,) = faults_of(Rig, set_key(rig(), "telemetry.endpoint", "tcp://127.0.0.1:5555"))
    assert "commands.endpoint: ipc:///xxx" in fault and "107 bytes" in fault and "set one" in fault


def test_a_fingers_coupling_and_probe_replace_those_of_the_scene() -> None:
    built = build(Scene, pinch_scene(coupling={"stiffness_n_per_m": 700.0}, device="left"), "f.toml")
    thumb, index = built.fingers
    assert (thumb.coupling, thumb.probe, thumb.device) == (built.coupling, built.probe, "thumb")
    assert (index.coupling.stiffness_n_per_m, index.probe, index.device) == (700.0, built.probe, "left")
    assert [finger.torque_stiffness for finger in build_scene(built).fingers] == [1000.0, 700.0]
    assert build(Scene, describe(built), "f.toml") == built


def pair_fingers(fingers: list[dict[str, Any]] | None, devices: list[str] | None) -> list[tuple[str, str]]:
    """Return finger and table pairs of a scene and a rig; None is [fingertip] or [device]."""
    scene_mapping = scene() if fingers is None else {**pinch_scene(), "finger": fingers}
    drivers = {name: {"driver": "replay", "recording": "tap"} for name in devices or []}
    tables = rig_of_two() | {"devices": drivers} if drivers else rig()
    moved = pair_devices(build(Scene, scene_mapping, "s.toml"), build(Rig, tables, "r.toml"))
    return [(move.finger, move.table) for move in moved]


def test_each_finger_is_moved_by_its_device() -> None:
    both = [("thumb", "[devices.thumb]"), ("index", "[devices.index]")]
    assert pair_fingers(FINGERS, ["index", "other", "thumb"]) == both
    assert pair_fingers([FINGERS[0] | {"device": "left"}], ["left", "right"]) == [("thumb", "[devices.left]")]
    assert pair_fingers(FINGERS[:1], None) == [("thumb", "[device]")]
    assert pair_fingers(None, None) == [("", "[device]")]


@pytest.mark.parametrize(
    ("fingers", "devices", "messages"),
    [
        (FINGERS, None, ["'thumb', 'index'", "the rig has [device]", "add [devices.thumb] and [devices.index]"]),
        (FINGERS, ["thumb"], ["the rig has [devices.thumb]", "add [devices.index]", "a scene with [fingertip]"]),
        (None, ["thumb"], ["the scene has [fingertip]", "the rig has [devices.thumb]", "use a rig with [device]"]),
    ],
)
def test_a_finger_without_a_device_is_one_error_for_both_files(fingers: Any, devices: Any, messages: list[str]) -> None:
    message = refusal(pair_fingers, fingers, devices)
    assert [part for part in messages if part not in message] == [] and "\n" not in message


def test_a_rig_has_device_or_devices() -> None:
    built = build(Rig, rig_of_two(), "f.toml")
    assert build(Rig, describe(built), "f.toml") == built
    with pytest.raises(ConfigError, match=r"\[devices.thumb\], but this command needs a single device"):
        find_single_device(built)
    loops = [device.options["loop"] for device in load_rig("simulated-pinch", {"device.loop": False}).devices.values()]
    assert loops == [False, False]
    replaced = load_rig("simulated-pinch", {"device.driver": "replay", "device.recording": "tap"})
    assert {device.driver: device.options for device in replaced.devices.values()} == {"replay": {"recording": "tap"}}


def test_suggestions_include_all_names_with_the_given_prefix() -> None:
    assert suggest("crc16", CHECKS) == " (did you mean 'crc16-ccitt' or 'crc16-modbus'?)"


def test_all_faults_are_reported_at_once() -> None:
    bad = scene()
    set_key(bad, "fingertip.radius_m", -1)
    set_key(bad, "rolling.torque_stiffness_n_per_m", 5000)
    set_key(bad, "coupling.damping", 1)
    set_key(bad, "object[0].material.friction.kinetic", 0.9)
    set_key(bad, "object[0].material.torsion.friction_length_m", math.nan)
    bad["object"].append({"name": "table", "shape": "plane", "position_m": 3, "material": {}})
    first, *lines = refusal(build, Scene, bad, "bad.toml").splitlines()
    assert first == "8 faults:" and ConfigError.exit_code == 2
    assert [re.split(r" (?:=|is) ", line.removeprefix("  bad.toml: "))[0] for line in lines] == [
        *("fingertip.radius_m", "coupling.damping", "object[0].material.friction.kinetic"),
        *("object[0].material.torsion.friction_length_m", "object[1].position_m"),
        *("object[1].material.stiffness_n_per_m", "rolling.torque_stiffness_n_per_m", "object[1].name"),
    ]


def test_faults_behind_an_unknown_kind_are_reported_too() -> None:
    bad = scene()
    bad["object"] = [
        {"name": "a", "shape": "spher", "radius_m": -2, "colour": 3, "material": {"stiffness_n_per_m": -5}},
        {"name": "b", "radius_m": 0.1, "size_m": 7, "position_m": [0, 1], "material": {"stiffness_n_per_m": "x"}},
        {"name": "c", "shape": "plane", "material": {"name": "steell", "damping_ns_per_m": -1}},
        {"name": "d", "shape": 7, "radius_m": "?", "material": "wood", "effect": [{"kind": "magnt", "force_n": 1}]},
    ]
    assert [fault.key for fault in faults_in(build, Scene, bad, "scene.toml")] == [
        *("object[0].shape", "object[0].colour", "object[0].material.stiffness_n_per_m", "object[0].radius_m"),
        *("object[1].shape", "object[1].position_m", "object[1].material.stiffness_n_per_m", "object[1].size_m"),
        *("object[2].material.name", "object[2].material.damping_ns_per_m"),
        *("object[3].shape", "object[3].effect[0].kind", "object[3].radius_m"),
    ]


def test_an_object_of_unknown_shape_is_still_checked() -> None:
    material = {"stiffness_n_per_m": 500.0}
    bad = scene() | {
        "object": [
            {"name": "a", "shape": "cube", "material": material, "motion": {"kind": "body", "body": "x"}},
            {"name": "a", "shape": "spher", "radius_m": 0.1, "material": material | {"torsion": {}}},
            {"name": "1", "shape": "thing"},
        ],
        "rolling": {"method": "rotation_vector"},
    }
    assert sorted(fault.key for fault in faults_in(build, Scene, bad, "scene.toml")) == [
        "object[0].motion", "object[0].shape", "object[1].material.torsion.friction_length_m",
        "object[1].material.torsion.stiffness_nm_per_rad", "object[1].name", "object[1].shape", "object[2].material",
        "object[2].name", "object[2].shape",
    ]  # fmt: skip


def test_ceilings_cannot_be_raised_by_a_file() -> None:
    for key in set(schema.Guard.__struct_fields__) - {"arm", "workspace"}:
        span = getattr(limits, key.upper())
        assert getattr(build(Rig, set_key(rig(), f"guard.{key}", span.high), "f.toml").guard, key) == span.high
        above = set_key(rig(), f"guard.{key}", math.nextafter(span.high, math.inf))
        assert span.reason in faults_of(Rig, above)[0]


@pytest.mark.parametrize(
    ("content", "fragments"),
    [
        (b"[fingertip\nradius_m = 1", ["not TOML", "line 1, column 11"]),
        (b"a = 1\na = 2\n", ["not TOML", "line 2"]),
        (b"a = 1\n# caf\xe9\n", ["not UTF-8", "0xe9", "line 2"]),
        (b"a = " + b"9" * 5000, ["not usable", "4300"]),
        (b"a = " + b"[" * 5000, ["bad.toml"]),
        (b"#" * (1 << 20) + b"#", ["larger than 1048576 bytes"]),
        (b"", ["fingertip: is missing", "object: is missing"]),
    ],
    ids=["syntax", "twice", "latin-1", "huge", "deep", "large", "empty"],
)
def test_unreadable_files_name_the_position(tmp_path: Path, content: bytes, fragments: list[str]) -> None:
    path = tmp_path / "bad.toml"
    path.write_bytes(content)
    message = refusal(load_scene, path)
    assert str(path) in message
    assert [part for part in fragments if part not in message] == [], message


def test_missing_file_suggests_a_similar_one(tmp_path: Path) -> None:
    (tmp_path / "bench.toml").write_text("")
    assert "bnech.toml: no such file (did you mean 'bench.toml'?)" in refusal(load_rig, str(tmp_path / "bnech.toml"))
    assert "is a folder" in refusal(load_rig, tmp_path)
    assert re.search(r"cannot be read: .*embedded null", refusal(load_rig, "a\0b.toml"))


def test_misspelt_shipped_name_lists_the_shipped_ones() -> None:
    message = refusal(load_scene, "paper-plan")
    assert "no scene is called 'paper-plan' (did you mean 'paper-plane'?)" in message
    assert all(name in message for name in list_shipped(Scene))


def test_byte_order_mark_and_nan_in_a_file(tmp_path: Path) -> None:
    path = tmp_path / "marked.toml"
    path.write_bytes(b"\xef\xbb\xbf[fingertip]\nradius_m = nan\n[coupling]\nstiffness_n_per_m = +inf\n")
    text = refusal(load_scene, path)
    assert "fingertip.radius_m = nan" in text and "coupling.stiffness_n_per_m = inf" in text
    assert "marked.toml: object: is missing" in text


def test_overrides_replace_values_and_faults_name_the_most_specific_source() -> None:
    assert load_rig("replay", {"servo.rate_hz": 4000, "servo.realtime": "off"}).servo.rate_hz == 4000.0
    sources = {"servo": "command line --servo", "servo.rate_hz": "command line --rate"}
    first, second = faults_in(load_rig, "replay", {"servo.rate_hz": 9e9, "servo.realtime": "on"}, sources)
    assert str(first).startswith("command line --rate: servo.rate_hz = 9000000000.0: must be a number from 100 to 8000")
    assert str(second).startswith("override: servo.realtime = 'on'")


def test_dotted_entry_names_match_the_longest_name() -> None:
    balls = [{"name": name, "shape": "sphere", "radius_m": 0.02, "material": "rubber"} for name in ("a", "a.b")]
    mapping = {"fingertip": {"radius_m": 0.01}, "object": balls}
    config = load_scene(mapping, {"object.a.b.radius_m": 0.03, "object.a.radius_m": 0.04})
    assert [ball.radius_m for ball in config.object] == [0.04, 0.03]


def test_another_driver_drops_the_options_of_the_first() -> None:
    assert load_rig("replay", {"device.driver": "replay"}).device.options["loop"] is True
    simulated = load_rig("replay", {"device.gain": 2, "device.driver": "simulated"}).device
    assert simulated == schema.DeviceConfig(driver="simulated", options={"gain": 2})
    changes = {"devices.thumb.recording": "tap", "devices.thumb.driver": "replay", "device.driver": "faulty"}
    devices = load_rig("simulated-pinch", changes).devices
    assert devices["thumb"] == schema.DeviceConfig(driver="replay", options={"recording": "tap"})
    assert devices["index"] == schema.DeviceConfig(driver="faulty")
    whole = load_rig("simulated-pinch", {"device": {"driver": "replay", "recording": "tap"}}).devices
    assert list(whole.values()) == [devices["thumb"]] * 2


@pytest.mark.parametrize("key", ["material", "material.name"])
def test_a_value_is_not_lost_to_the_table_or_entry_around_it(key: str) -> None:
    values = {"object[0].material.stiffness_n_per_m": 321.0, f"object.0.{key}": "wood"}
    for scene in ("sphere", load_scene("sphere", {"object.0.material": "rubber"})):
        for changes in (values, dict(reversed(values.items()))):
            material = load_scene(scene, changes).object[0].material
            assert (material.name, material.stiffness_n_per_m) == ("wood", 321.0)


def test_a_key_with_a_bracket_is_the_one_with_a_dot() -> None:
    twice = {"object[0].radius_m": 0.02, "object.0.radius_m": 0.03}
    assert "set twice" in refusal(load_scene, "sphere", twice)


def test_override_of_a_missing_or_broken_table(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text("servo = 5\n")
    (fault,) = faults_in(load_rig, path, {"servo.rate_hz": 500.0, "device.driver": "replay"})
    assert str(fault) == f"{path}: servo = 5: must be a table"


class Options(msgspec.Struct, frozen=True):
    """Options of a driver from another package."""

    port: str
    gains: list[Annotated[float, msgspec.Meta(gt=0)]] = []
    side: int | bool | str = 0

    def __post_init__(self) -> None:
        if self.port == "none":
            raise ValueError("a port is needed")


def test_build_serves_the_options_of_outside_drivers() -> None:
    assert build(Options, {"port": "a", "gains": [1, 2.5], "side": True}, "x") == Options("a", [1.0, 2.5], True)
    faults = faults_of(Options, {"port": 1, "gains": [0, -1], "side": 1.5, "gain": 3})
    assert faults == [
        "f.toml: gain is not a key here (did you mean 'gains'?); keys are port, gains, side",
        "f.toml: port = 1: must be text",
        "f.toml: gains[0] = 0: must be a number above 0",
        "f.toml: gains[1] = -1: must be a number above 0",
        "f.toml: side = 1.5: must be an integer or true or false or text",
    ]
    assert faults_of(Options, {"port": "none"}) == ["f.toml: the whole: a port is needed"]


KEYS = st.sampled_from(
    [
        *("fingertip", "radius_m", "rolling", "method", "coupling", "stiffness_n_per_m", "object", "name", "shape"),
        *("position_m", "orientation_wxyz", "material", "friction", "static", "kinetic", "torsion", "device", "driver"),
        *("servo", "rate_hz", "cpu", "guard", "force_max_n", "telemetry", "endpoint", "options"),
    ]
) | st.text(max_size=5)
LEAVES = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(["plane", "euler_zxz", "tcp://127.0.0.1:1", 10**4000, -(2**2000)])
    | st.dates()
    | st.binary(max_size=4)
)
ANYTHING = st.recursive(
    LEAVES,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(KEYS | st.integers(), inner, max_size=6),
    max_leaves=25,
)


@given(ANYTHING)
@examples(40, 300)
def test_no_mapping_raises_anything_but_config_error(mapping: object) -> None:
    for kind in (Scene, Rig):
        message = refusal_or_none(build, kind, mapping, "anything")
        assert message is None or "anything: " in message


@given(st.sampled_from(FAULTS), ANYTHING)
@examples(100, 400)
def test_nearly_valid_files_raise_nothing_but_config_error(place: Any, value: object) -> None:
    kind, make, key, _, _ = place
    message = refusal_or_none(build, kind, set_key(make(), key, value), "nearly")
    assert message is None or "nearly: " in message


def test_schema_verb_prints_json_schema_with_units_and_ranges() -> None:
    printed = json.loads(called("schema").stdout)
    radius = printed["scene"]["$defs"]["Fingertip"]["properties"]["radius_m"]
    assert (radius["minimum"], radius["maximum"], radius["unit"]) == (1e-5, 1e3, "m")
    assert printed["scene"]["$defs"]["Plane"]["properties"]["shape"] == {"enum": ["plane"]}
    device = printed["rig"]["$defs"]["DeviceConfig"]
    assert (list(device["properties"]), device["additionalProperties"]) == (["driver", "tool"], True)
    assert "null" not in json.dumps([printed["scene"], printed["rig"]])  # TOML has none
    assert [field["name"] for field in printed["telemetry"]["record"]] == [field.name for field in FIELDS]


def test_every_key_has_a_meaning_and_every_default_its_range() -> None:
    for kind in (Scene, Rig):
        for table in schema_verb.list_tables(kind):
            assert table.meaning
            assert all(row.allowed and row.default and row.meaning for row in table.rows), table
    build(Rig, describe(Rig(device=schema.DeviceConfig(driver="x"))), "defaults")


def test_the_documentation_shows_the_actual_error() -> None:
    page = (ROOT / "docs" / "operate" / "scenes.md").read_text("utf-8")
    bad = {"device": {"driver": "replay"}, "servo": {"rate_hertz": 500}, "guard": {"torque_max_nm": 3.0}}
    assert "\n".join("    " + line for line in refusal(build, Rig, bad, "bench.toml").splitlines()) in page


def test_all_patterns_are_described_in_words() -> None:
    def iter_patterns(schema: Any) -> Iterator[str]:
        if isinstance(schema, dict):
            if isinstance(schema.get("pattern"), str):
                yield schema["pattern"]
            for value in schema.values():
                yield from iter_patterns(value)
        elif isinstance(schema, list):
            for value in schema:
                yield from iter_patterns(value)

    structs = [Scene, Rig, Faults, ExperimentFile, haply_options.Options]
    structs += [method.params for method in METHODS.values()]
    patterns = {pattern for struct in structs for pattern in iter_patterns(msgspec.json.schema(struct))}
    assert patterns == PATTERNS.keys()
