"""Scene and rig files: accepted values, endpoints, fingers with their devices, overrides, the JSON schema."""

import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from helpers.called import called
from helpers.refusals import faults_in, refusal
from hypothesis import given, settings
from hypothesis import strategies as st

from softfinger.config import schema
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


def test_missing_file_suggests_a_similar_one(tmp_path: Path) -> None:
    (tmp_path / "bench.toml").write_text("")
    assert "bnech.toml: no such file (did you mean 'bench.toml'?)" in refusal(load_rig, str(tmp_path / "bnech.toml"))
    assert "is a folder" in refusal(load_rig, tmp_path)
    assert re.search(r"cannot be read: .*embedded null", refusal(load_rig, "a\0b.toml"))


def test_misspelt_shipped_name_lists_the_shipped_ones() -> None:
    message = refusal(load_scene, "paper-plan")
    assert "no scene is called 'paper-plan' (did you mean 'paper-plane'?)" in message
    assert all(name in message for name in list_shipped(Scene))


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


def test_override_of_a_missing_or_broken_table(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text("servo = 5\n")
    (fault,) = faults_in(load_rig, path, {"servo.rate_hz": 500.0, "device.driver": "replay"})
    assert str(fault) == f"{path}: servo = 5: must be a table"


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
