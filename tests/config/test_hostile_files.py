"""Files that somebody made to do harm: pipes, devices, bombs, planted links; scenes whose laws, motions, effects,
tables or names do not fit; files of injected faults. One error, at once, in little memory."""

import os
import re
import resource
import socket
import struct
import sys
import tomllib
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_args

import lz4.frame
import numpy as np
import pytest
import zstandard
from conftest import paper_mapping
from helpers.programs import run_program
from helpers.refusals import refusal
from helpers.waits import ends_within
from hypothesis import given
from hypothesis import strategies as st

from softfinger.config import files
from softfinger.config.arrays import grids
from softfinger.config.arrays.grids import read_grid
from softfinger.config.errors import ConfigError, DeviceError, HapticError, RecordingError
from softfinger.config.load import build, describe, load_faults, load_rig, load_scene
from softfinger.config.schema import Faults, Injection, Scene
from softfinger.config.sources import list_shipped
from softfinger.drivers import poses
from softfinger.drivers.falcon import firmware
from softfinger.drivers.fault_injector import END_TICK, FIRST_TICK, PERIOD_TICKS, make_fault_table
from softfinger.drivers.poses import load_poses
from softfinger.proxy.record import RECORD_SIZE
from softfinger.server.recording import results
from softfinger.server.recording.compare import READ_FIELDS
from softfinger.server.recording.poses_file import McapPoses
from softfinger.server.recording.results import read_results, write_blocks
from softfinger.server.recording.run import load_run
from softfinger.server.recording.summary import summarize
from softfinger.tools.doctor import report
from softfinger.tools.sweep import open_rows

pytestmark = pytest.mark.plain

STRANGER = 54321
HANGS_S = 60
"""Longer than any of these takes on a busy machine; a read of a pipe never ends."""
GROWTH_MAX_MB = 400
"""The largest limit in drivers/mcap_messages.py and drivers/poses.py is 160 MB, an array may exist twice, and zstd has
a window of up to 128 MB. Each bomb is larger."""


@pytest.fixture(autouse=True)
def _no_waiting() -> Iterator[None]:
    with ends_within(HANGS_S):
        yield


def open_sweep(path: Path) -> None:
    with open_rows(path):
        pass


INPUTS: dict[str, tuple[Callable[[Path], object], str, type[HapticError]]] = {
    "scene": (load_scene, ".toml", ConfigError),
    "rig": (load_rig, ".toml", ConfigError),
    **{f"poses{end}": (load_poses, end, RecordingError) for end in poses.ENDINGS},
    **{f"results{end}": (read_results, end, RecordingError) for end in results.SUFFIXES},
    "recording": (summarize, ".mcap", RecordingError),
    "run": (lambda path: load_run(path, READ_FIELDS), ".mcap", RecordingError),
    **{f"grid{end}": (read_grid, end, ConfigError) for end in grids.READERS},
    "sweep": (open_sweep, ".mcap", RecordingError),
    "firmware": (lambda path: firmware._read_firmware(str(path)), ".bin", DeviceError),
}
"""Everything that reads a file that a user names: how, its ending, its error."""


def make_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(str(path))


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("/dev/zero"), make_socket, Path.mkdir])
@pytest.mark.parametrize("kind", INPUTS)
def test_only_regular_files_are_read(tmp_path, monkeypatch, kind, make):
    monkeypatch.chdir(tmp_path)  # a socket's path has to be short
    read, ending, error = INPUTS[kind]
    path = Path(f"odd{ending}")
    make(path)
    with pytest.raises(error, match=f"odd{ending}"):
        read(path)


LARGE = 1 << 30


def mcap_of(compression: str, data: bytes, size: int) -> bytes:
    """Return an MCAP file with one chunk that claims to unpack to `size` bytes."""

    def text(value: str) -> bytes:
        return struct.pack("<I", len(value)) + value.encode()

    header = text("") + text("")
    chunk = struct.pack("<QQQI", 0, 0, size, 0) + text(compression) + struct.pack("<Q", len(data)) + data
    parts = [struct.pack("<BQ", kind, len(body)) + body for kind, body in ((1, header), (6, chunk))]
    return b"\x89MCAP0\r\n" + b"".join(parts)


def zstd_zeros(known: bool) -> bytes:
    made = zstandard.ZstdCompressor().compressobj(size=LARGE if known else -1)
    return b"".join(made.compress(bytes(1 << 20)) for _ in range(LARGE >> 20)) + made.flush()


def lz4_zeros(known: bool) -> bytes:
    made = lz4.frame.LZ4FrameCompressor()
    begun = made.begin(source_size=LARGE if known else 0)
    return begun + b"".join(made.compress(bytes(1 << 20)) for _ in range(LARGE >> 20)) + made.flush()


def npz_of_claims(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive, archive.open("timestamp.npy", "w") as member:
        np.lib.format.write_array_header_1_0(member, {"descr": "<f8", "fortran_order": False, "shape": (1 << 45,)})


def csv_without_lines(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(4 * LARGE)


BOMBS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "zstd": (".mcap", lambda path: path.write_bytes(mcap_of("zstd", zstd_zeros(True), LARGE))),
    "zstd of unknown size": (".mcap", lambda path: path.write_bytes(mcap_of("zstd", zstd_zeros(False), LARGE))),
    "lz4": (".mcap", lambda path: path.write_bytes(mcap_of("lz4", lz4_zeros(True), LARGE))),
    "npz header": (".npz", npz_of_claims),
    "csv line": (".csv", csv_without_lines),
}

GROWTH = """
import resource, sys
from pathlib import Path
from softfinger.config.errors import HapticError
from softfinger.drivers.poses import load_poses
from softfinger.server.recording.results import read_results
def peak():
    return int(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")).split()[1]) // 1024
before = peak()
for path in sys.argv[1:]:
    for read in (load_poses, read_results):
        try:
            read(Path(path))
            sys.exit(f"{path} was read")
        except HapticError as error:
            print(peak() - before, error)
"""


def test_bombs_are_refused_in_little_memory(tmp_path: Path) -> None:
    paths = []
    for name, (ending, make) in BOMBS.items():
        paths.append(tmp_path / f"{name}{ending}")
        make(paths[-1])
    process = run_program([sys.executable, "-c", GROWTH, *map(str, paths)], timeout=HANGS_S, check=True)
    lines = process.stdout.splitlines()
    assert len(lines) == 2 * len(paths)
    for line, path in zip(lines, np.repeat(paths, 2), strict=True):
        grown, _, error = line.partition(" ")
        assert int(grown) < GROWTH_MAX_MB, line  # of all files so far
        assert path.name in error


def some_records(count: int) -> np.ndarray:
    records = np.zeros((count, RECORD_SIZE))
    records[:, 0] = np.arange(count)
    return records


@pytest.mark.parametrize("ending", poses.ENDINGS)
def test_more_rows_than_the_limit_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: str) -> None:
    path = tmp_path / f"long{ending}"
    write_blocks(path, [""], [some_records(5)[:, None]])
    monkeypatch.setattr(poses, "POSES_MAX", 4)
    monkeypatch.setattr(results, "RESULTS_MAX", 4)
    for read in (load_poses, read_results):
        with pytest.raises(RecordingError, match=f"long{ending}: more than 4 "):
            read(path)
    monkeypatch.setattr(results, "RESULTS_MAX", 5)
    assert len(read_results(path)) == 5


def write_sweep(path: Path) -> None:
    with open_rows(path) as rows:
        rows.append([("k", 1, 2)])


def stream(path: Path) -> None:
    file = McapPoses(path)
    file.add(np.zeros(1), some_records(1))
    file.close()


OUTPUTS: dict[str, Callable[[Path], object]] = {
    "o.csv": lambda path: write_blocks(path, [""], [some_records(2)[:, None]]),
    "o.npz": lambda path: write_blocks(path, [""], [some_records(2)[:, None]]),
    "o.mcap": lambda path: write_blocks(path, [""], [some_records(2)[:, None]]),
    "live.mcap": stream,
    "sweep.mcap": write_sweep,
    "report.json": lambda path: report.write(path, {"a": 1}, "--probe"),
}


@pytest.mark.parametrize("name", OUTPUTS)
def test_no_planted_name_is_written_through(tmp_path: Path, name: str) -> None:
    victim = tmp_path / "victim"
    victim.write_text("precious")
    for planted in (f".{name}.part", f"{name}.part", f"{name}.lock", f"{name}.tmp"):
        (tmp_path / planted).symlink_to(victim)
    OUTPUTS[name](tmp_path / name)
    assert (tmp_path / name).stat().st_size > 0
    assert victim.read_text() == "precious"
    assert len(list(tmp_path.iterdir())) == 6


@pytest.mark.skipif(os.geteuid() != 0, reason="makes links of another user")
@pytest.mark.parametrize("name", OUTPUTS)
def test_a_link_of_another_user_is_not_written_through(tmp_path: Path, name: str) -> None:
    shared, victim = tmp_path / "shared", tmp_path / "victim"
    shared.mkdir()
    shared.chmod(0o1777)
    victim.write_text("precious")
    (shared / name).symlink_to(victim)
    os.lchown(shared / name, STRANGER, STRANGER)
    with pytest.raises(HapticError, match=name):
        OUTPUTS[name](shared / name)
    assert victim.read_text() == "precious"


@pytest.mark.parametrize("make", [os.mkfifo, make_socket, Path.mkdir])
@pytest.mark.parametrize("name", OUTPUTS)
def test_only_regular_files_are_replaced(tmp_path, monkeypatch, name, make):
    """A pipe is not waited for either. A device is not tried: as root, a program once replaced /dev/null by a file."""
    monkeypatch.chdir(tmp_path)
    make(Path(name))
    Path("link" + name).symlink_to(name)
    kind = Path(name).lstat().st_mode
    for output in (name, "link" + name):
        with pytest.raises(HapticError, match=output):
            OUTPUTS[name](Path(output))
    assert Path(name).lstat().st_mode == kind and sorted(os.listdir()) == ["link" + name, name]


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "o.csv"
    path.write_text("before")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
        with pytest.raises(RecordingError, match=r"o\.csv: cannot be written: File too large"):
            write_blocks(path, [""], [some_records(100)[:, None]])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_text() == "before" and list(tmp_path.iterdir()) == [path]


def test_reading_a_growing_file_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "file"
    path.write_bytes(bytes(100))
    assert files.read_input(path, 100) == bytes(100)
    with pytest.raises(OSError, match="has 100 bytes, at most 99 are allowed"):
        files.read_input(path, 99)
    with pytest.raises(OSError, match="has more than 99 bytes"):
        files.read_input("/proc/self/environ", 99) if len(Path("/proc/self/environ").read_bytes()) > 99 else None


TORUS = {"shape": "torus", "major_radius_m": 0.05, "minor_radius_m": 0.02}
ELLIPSOID = {"shape": "ellipsoid", "semi_axes_m": [0.05, 0.03, 0.02]}
CLOSED = {"method": "rotation_vector"}
LETTER = {"state_machine": "paper"}
PROXY = {"model": "soft_finger_proxy", "kinetic_friction_length_m": 0.005}
BOUNDARY = {"kind": "boundary", "stiffness_n_per_m": 300, "force_max_n": 5}
VIBRATION = {"kind": "vibration", "amplitude_n": 0.5, "frequency_hz": 60, "direction": [0, 3, 4]}
TURNTABLE = {"kind": "turntable", "rate_rad_per_s": 1}
HERTZ = {"shear_modulus_pa": 45e3}
PATCH = {"patch": HERTZ}
FOLLOWS = {"stiffness_nm_per_rad": None, "friction_length_m": None}
"""Changes that remove the torsion parameters of the paper's material."""
FINGERS = [{"name": "a", "radius_m": 0.01}, {"name": "b", "radius_m": 0.01, **PATCH}]
NONE = {"friction": None, "torsion": FOLLOWS}

MATERIALS: list[tuple[dict[str, Any], str]] = [
    ({"friction": {"static_scale": [1.0, 0.5]}}, "needs direction_x"),
    ({"friction": {"direction_x": [0.0, 0.0, 0.0]}}, "not a direction"),
    ({"friction": {"direction_x": [1.0, 0.0, 0.0], "static_scale": [1.0, 0.5]}}, "across, above the static 0.3"),
    ({"friction": {"direction_x": [1.0, 0.0, 0.0], "kinetic_scale": [0.0, 0.5]}}, "from 0.001"),
    ({"friction": {"stribeck_speed_m_per_s": 0.0}}, "from 1e-05 to 10 m/s"),
    ({"friction": {"viscous_s_per_m": -1.0}}, "from 0 to 100 s/m"),
    ({"normal": {"exponent": 0.5}}, "from 1 to 3"),
    ({"normal": {"damping_s_per_m": 1.0}, "damping_ns_per_m": 2.0}, "replaces damping_ns_per_m, which is 2"),
    ({"normal": {"depth_m": 0.0}}, "from 1e-05 to 1 m"),
    ({"normal": {"exponnent": 2.0}}, "did you mean 'exponent'"),
    ({"torsion": {"kinetic_friction_length_m": 0.003}}, 'applies to model = "soft_finger_proxy"'),
    ({"torsion": PROXY}, "at most friction_length_m = 0.004"),
    ({"torsion": {"exponent": 0.5}}, "from 0 to 0.333333"),
    ({"torsion": {"model": "soft_finger"}}, "did you mean 'soft_finger_proxy'"),
    ({"torsion": FOLLOWS}, "torsion.stiffness_nm_per_rad: is missing: add it, or add"),
    ({"shear_modulus_pa": 1.0}, "from 100 to 1e"),
]
EFFECTS: list[tuple[Any, str]] = [
    ({"kind": "viscocity", "damping_ns_per_m": 1}, "did you mean 'viscosity'?"),
    (BOUNDARY, "give either size_m"),
    (BOUNDARY | {"size_m": [0.2, 0.2, 0.4], "radius_m": 0.2}, "give either size_m"),
    ({"kind": "viscosity", "damping_ns_per_m": 2, "region": {}}, "effect[0].region.radius_m: give either size_m"),
    (VIBRATION | {"direction": [0, 0, 0]}, "effect[0].direction = [0.0, 0.0, 0.0]: all zero is not a direction"),
    ({"kind": "constant_force", "force_n": [0, 0, -41]}, "from -40 to 40 N"),
    (VIBRATION | {"frequency_hz": 600}, "effect[0].frequency_hz = 600: must be a number from 0 to 500 Hz"),
    ({"kind": "magnet", "force_n": 2, "range_m": 0.02}, "must be one of"),  # an object's effect in the workspace
]
MOTIONS: list[tuple[Any, str]] = [
    (TURNTABLE | {"kind": "turntabel"}, "object[0].motion.kind = 'turntabel': must be one of"),
    ({"kind": "turntable"}, "object[0].motion.rate_rad_per_s is missing"),
    (TURNTABLE | {"rate_rad_per_s": 101}, "from -100 to 100 rad/s"),
    (TURNTABLE | {"axis": [0, 0, 0]}, "object[0].motion.axis = [0.0, 0.0, 0.0]"),
    ({"kind": "sinusoid", "frequency_hz": 200}, "from 0 to 100 Hz"),
    ({"frequency_hz": 2}, "object[0].motion.kind is missing"),
    ([], "object[0].motion = []: must be a table"),
]
SCENES: list[tuple[dict[str, Any], str]] = [
    *(({"material": material}, message) for material, message in MATERIALS),
    *(({"effect": [effect]}, message) for effect, message in EFFECTS),
    *(({"table": {"motion": motion}}, message) for motion, message in MOTIONS),
    ({"table": TORUS, "rolling": CLOSED}, "closed form for the torus object[0]: use montana_rk4"),
    ({"table": ELLIPSOID, "rolling": CLOSED}, "closed form for the ellipsoid object[0]: use montana_rk4"),
    ({"rolling": CLOSED | {"tolerance": 1e-6}}, "tolerance = 1e-06: applies to montana_rk45"),
    ({"rolling": {"method": "montana_rk45", "tolerance": 1e-15}}, "must be a number from 1e-13 to 0.001"),
    ({"rolling": LETTER, "material": {"friction": {"viscous_s_per_m": 0.1}}}, "has Coulomb friction only"),
    ({"rolling": LETTER, "material": {"friction": {"direction_x": [1.0, 0.0, 0.0]}}}, "has Coulomb friction only"),
    ({"rolling": LETTER, "material": {"torsion": {"model": "limit_surface"}}}, "has independent limits only"),
    ({"rolling": None, "material": {"torsion": {"model": "limit_surface"}, "friction": None}}, "shares a limit"),
    ({"fingertip": {"patch": {}}}, "fingertip.patch.shear_modulus_pa is missing"),
    ({"fingertip": {"patch": HERTZ | {"exponent": 0.2}}}, "applies to a patch with radius_m, not to that of Hertz"),
    ({"fingertip": {"patch": HERTZ | {"pressure_exponent": 4.0}}}, "applies to a patch with radius_m"),
    ({"fingertip": {"patch": HERTZ | {"rolling_loss": 1.5}}}, "from 0 to 1 "),
    ({"fingertip": None, "finger": FINGERS}, "finger[0].patch: is missing, but another finger has a patch"),
    ({"fingertip": None, "finger": FINGERS[:1], "material": {"torsion": FOLLOWS}}, "add it, or add [finger.patch]"),
    ({"fingertip": PATCH, "rolling": None, "material": NONE}, "derived from patch and friction, but the material has"),
]


@pytest.mark.parametrize(("changes", "message"), SCENES)
def test_a_scene_that_does_not_fit_is_refused(changes: dict[str, Any], message: str) -> None:
    assert message in refusal(build, Scene, paper_mapping(**changes), "test scene")


@pytest.mark.parametrize(
    ("scene", "place", "name"),
    [
        ("bend-a-strip", ("object", 0, "elastic"), "fixed"),
        ("bend-a-strip", ("object", 0), "material"),
        ("paper-plane", (), "object"),
    ],
)
def test_the_header_of_a_missing_table_is_toml(scene: str, place: tuple[str | int, ...], name: str) -> None:
    mapping = table = describe(load_scene(scene))
    for key in place:
        table = table[key]
    del table[name]
    with pytest.raises(ConfigError) as refused:
        load_scene(mapping)
    (header,) = re.findall(r"\[+[\w.\[\]]+\]$", str(refused.value))
    written = tomllib.loads(header)
    for key in (*(part for part in place if isinstance(part, str)), name):
        written = written[key]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"world.geom.0.name": "bal"}, r"world\.geom\[0\] fits no geom of .*: name = 'bal'; it has bowl, ball"),
        ({"world.geom.0.group": 7}, r"world\.geom\[0\] fits no geom of .*: name = 'ball', group = 7"),
        ({"world.geom.0.default": "rubber"}, r"world\.geom\[0\] fits no geom of .*: name = 'ball', default = "),
        ({"world.mass_kg": {"bal": 0.1}}, "'bal' is not a body with a mass; it has ball"),
        ({"world.keyframe": "home"}, "has no such <key>; it has: none"),
        ({"object.bowl.motion": {"kind": "body", "body": "bal"}}, r"motion\.body = 'bal' is not a body .*; it has"),
    ],
)  # fmt: skip
def test_a_misspelt_name_is_refused_on_load(changes: dict[str, Any], message: str) -> None:
    load_scene("ball-in-a-bowl")
    with pytest.raises(ConfigError, match=message):
        load_scene("ball-in-a-bowl", changes)


PAGE = Path(__file__).resolve().parents[2] / "docs" / "operate" / "faults.md"
KINDS = {kind.kind for kind in get_args(Injection)}


def faults(**keys: Any) -> Faults:
    return build(Faults, {"fault": [{"kind": "stale", **keys}]}, "faults")


def test_a_file_is_shipped_for_every_kind() -> None:
    assert {fault.kind for name in list_shipped(Faults) for fault in load_faults(name).fault} == KINDS


def test_the_page_lists_every_kind() -> None:
    rows = re.findall(r"^\| (`.+`) \| .* \| .* \|$|^\| (`.+?`) \|", PAGE.read_text("utf-8"), re.MULTILINE)
    assert {name for row in rows for name in re.findall(r"`(\w+)`", "".join(row))} - {"kind"} == KINDS


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({}, r"fault\[0\]\.at_tick: is missing, as is at_s: set one of them"),
        ({"at_tick": 5, "at_s": 1.0}, r"fault\[0\]\.at_s = 1\.0: at_tick already sets the start"),
        ({"at_tick": 5, "ticks": 3, "for_s": 1.0}, r"fault\[0\]\.for_s = 1\.0: ticks already sets the duration"),
        ({"at_tick": -1}, r"fault\[0\]\.at_tick = -1: must be an integer from 0"),
        ({"at_s": 1.0, "kind": "stael"}, r"fault\[0\]\.kind = 'stael'.*did you mean 'stale'"),
        ({"at_s": 1.0, "offset_m": [0, 0, 1]}, r"fault\[0\]\.offset_m"),
        ({"at_s": 1.0, "kind": "teleport"}, r"fault\[0\]\.offset_m.* is missing"),
        ({"at_s": 1.0, "kind": "slow", "block_s": 1e9}, r"fault\[0\]\.block_s = 1000000000\.0: must be .* 60 s"),
        ({"at_s": 1.0, "kind": "nan", "number": "w"}, r"fault\[0\]\.number = 'w': must be"),
    ],
)
def test_a_fault_is_reported_with_its_key(keys: dict[str, Any], words: str) -> None:
    message = refusal(faults, **keys)
    assert re.search(words, message) and "\n" not in message


def test_an_unknown_name_is_reported_with_a_similar_one() -> None:
    assert re.search(r"no file of faults is called 'teleprt'.*did you mean 'teleport'", refusal(load_faults, "teleprt"))


@pytest.mark.parametrize(
    ("keys", "window"),
    [
        ({"at_tick": 7}, (7, 8)),
        ({"at_tick": 7, "ticks": 3}, (7, 10)),
        ({"at_s": 0.1}, (200, 201)),
        ({"at_s": 0.1, "for_s": 0.01}, (200, 220)),
        ({"at_tick": 7, "for_s": 0.0001}, (7, 8)),  # part of a period is one
    ],
)
def test_times_become_ticks_of_the_rate(keys: dict[str, Any], window: tuple[int, int]) -> None:
    (row,) = make_fault_table(faults(**keys, every_ticks=2).fault, 2000.0)
    assert (row[FIRST_TICK], row[END_TICK], row[PERIOD_TICKS]) == (*window, 2)


VALUES = st.one_of(
    st.none(), st.booleans(), st.integers(-(1 << 70), 1 << 70), st.floats(), st.text(max_size=5),
    st.sampled_from(["read", "write", "x", "qz", *sorted(KINDS)]), st.lists(st.floats(), max_size=4),
)  # fmt: skip
KEYS = sorted({"what", *(name for kind in get_args(Injection) for name in kind.__struct_fields__)})


@given(st.lists(st.dictionaries(st.sampled_from(["kind", *KEYS]), VALUES, max_size=5) | VALUES, max_size=3) | VALUES)
def test_a_random_file_gives_faults_or_an_error(tables: Any) -> None:
    try:
        made = build(Faults, {"fault": tables}, "my-faults.toml")
    except ConfigError as error:
        assert "my-faults.toml: fault" in str(error)  # noqa: PT017
        return
    first, end, period = make_fault_table(made.fault, 1000.0)[:, [FIRST_TICK, END_TICK, PERIOD_TICKS]].T
    assert np.isfinite([first, end, period]).all() and (first <= end).all() and (period >= 1).all()
