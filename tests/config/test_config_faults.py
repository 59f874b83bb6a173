"""Faults of scene and rig files: each has one message with its place; no content raises another error."""

import itertools
import math
import os
import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import msgspec
import pytest
from helpers.examples import examples
from helpers.refusals import faults_in, refusal
from hypothesis import given
from hypothesis import strategies as st
from test_config import ROOT, pinch_scene, rig, rig_of_two, scene, set_key

from softfinger.config import limits, schema
from softfinger.config.errors import ConfigError
from softfinger.config.load import build, load_scene
from softfinger.config.schema import Rig, Scene, make_commands_address

pytestmark = pytest.mark.plain


ANY_SHAPE = "one of 'plane', 'sphere', 'cylinder', 'capsule', 'box', 'ellipsoid', 'torus', 'heightmap', 'mesh'"


def faults_of(struct_type: type[msgspec.Struct], mapping: object) -> list[str]:
    return [str(fault) for fault in faults_in(build, struct_type, mapping, "f.toml")]


def refusal_or_none(call: Callable[..., object], *args: Any) -> str | None:
    """Return the message of the ConfigError that a call raises, or None; other errors propagate."""
    try:
        call(*args)
    except ConfigError as error:
        return str(error)
    return None


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


def test_commands_without_a_runtime_folder_are_in_the_temp_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    folder = Path(tempfile.gettempdir()) / f"softfinger-{os.geteuid()}"
    assert make_commands_address("tcp://127.0.0.1:5555") == f"ipc://{folder}/5555.commands"
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/" + 90 * "x")
    (fault,) = faults_of(Rig, set_key(rig(), "telemetry.endpoint", "tcp://127.0.0.1:5555"))
    assert "commands.endpoint: ipc:///xxx" in fault and "107 bytes: set another" in fault


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


def test_faults_behind_an_unknown_shape_are_reported_too() -> None:
    bad = scene()
    bad["object"] = [
        {"name": "a", "shape": "spher", "radius_m": -2, "colour": 3, "material": {"stiffness_n_per_m": -5}},
        {"name": "b", "radius_m": 0.1, "size_m": 7, "position_m": [0, 1], "material": {"stiffness_n_per_m": "x"}},
        {"name": "c", "shape": "plane", "material": {"name": "steell", "damping_ns_per_m": -1}},
        {"name": "d", "shape": 7, "radius_m": "?", "material": "wood", "effect": [{"kind": "magnt", "force_n": 1}]},
        {"name": "d", "shape": "cube", "material": "wood", "motion": {"kind": "body", "body": "x"}},
        {"name": "1", "shape": "thing"},
    ]
    assert [fault.key for fault in faults_in(build, Scene, bad, "scene.toml")] == [
        *("object[0].shape", "object[0].colour", "object[0].material.stiffness_n_per_m", "object[0].radius_m"),
        *("object[1].shape", "object[1].position_m", "object[1].material.stiffness_n_per_m", "object[1].size_m"),
        *("object[2].material.name", "object[2].material.damping_ns_per_m"),
        *("object[3].shape", "object[3].effect[0].kind", "object[3].radius_m", "object[4].shape", "object[5].shape"),
        *("object[5].material", "object[4].motion", "object[4].name", "object[5].name"),
    ]


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
        (b"\xef\xbb\xbf[fingertip]\nradius_m = +inf", ["fingertip.radius_m = inf", "object: is missing"]),
    ],
    ids=["syntax", "twice", "latin-1", "huge", "deep", "large", "empty", "byte order mark"],
)
def test_unreadable_files_name_the_position(tmp_path: Path, content: bytes, fragments: list[str]) -> None:
    path = tmp_path / "bad.toml"
    path.write_bytes(content)
    message = refusal(load_scene, path)
    assert str(path) in message
    assert [part for part in fragments if part not in message] == [], message


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


def test_the_documentation_shows_the_actual_error() -> None:
    page = (ROOT / "docs" / "operate" / "scenes.md").read_text("utf-8")
    bad = {"device": {"driver": "replay"}, "servo": {"rate_hertz": 500}, "guard": {"torque_max_nm": 3.0}}
    assert "\n".join("    " + line for line in refusal(build, Rig, bad, "bench.toml").splitlines()) in page
