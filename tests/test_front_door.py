"""Public interface of `import softfinger`: names, examples, and errors for wrong use."""

from __future__ import annotations

import copy
import doctest
import importlib
import inspect
import json
import pickle
import pydoc
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import msgpack
import msgspec
import numpy as np
import pytest
from helpers.programs import run_program
from helpers.refusals import refusal

import softfinger
from softfinger.config.errors import ConfigError, HapticError
from softfinger.config.load import describe, load_scene
from softfinger.proxy.engine import Engine, step_many
from softfinger.proxy.pose_checks import PoseError
from softfinger.proxy.record import AT, FIELDS, MODE_NAMES, RECORD_SIZE, list_columns
from softfinger.proxy.records import Records
from softfinger.server.cli import main
from softfinger.server.offline.simulate import run_recording
from softfinger.server.recording.results import write_blocks
from softfinger.server.remote import Client
from softfinger.server.verbs.shipped import FOLDER_OF
from softfinger.server.wire.control import Control

RIBS = FOLDER_OF["scenes"] / "ribs.csv"  # texture of a scene
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
PRESSED = (0.0, 0.0, 0.0095)
STIFFNESS = "object.table.material.stiffness_n_per_m"
MODULES = ("config.load", "proxy.engine", "proxy.records", "server.offline.simulate", "server.remote")
"""Modules with examples in their docstrings, besides the package."""


@pytest.fixture
def client(endpoints: tuple[str, str]) -> partial[Client]:
    """Return `Client` bound to a daemon that replays the shipped recording."""
    return partial(Client, *endpoints)


def test_every_name_is_there_and_none_more() -> None:
    assert "__version__" in dir(softfinger)
    assert {name for name in dir(softfinger) if name[:2] != "__"} == set(softfinger.__all__) - {"__version__"}
    for door in (Engine, Client):
        methods = [(name, method) for name, method in inspect.getmembers(door, callable) if name[0] != "_"]
        assert methods and not [name for name, method in methods if not inspect.getdoc(method)]
    page = pydoc.plain(pydoc.render_doc(softfinger))
    for name in softfinger.__all__:
        assert name == "__version__" or (name in page and getattr(softfinger, name).__doc__)
    assert softfinger.__version__ in page
    with pytest.raises(AttributeError, match=r"'engine' \(did you mean 'Engine'\?\): it offers .*Client"):
        _ = softfinger.engine


def test_every_public_error_is_exported() -> None:
    wire = [f"server.wire.{name}" for name in ("client", "client_requests", "protocol")]
    for home in ("config.errors", "proxy.pose_checks", "proxy.records", *wire):
        module = importlib.import_module(f"softfinger.{home}")
        kinds = [(name, kind) for name, kind in vars(module).items() if isinstance(kind, type)]
        raised = [name for name, kind in kinds if issubclass(kind, HapticError)]
        assert raised and [name for name in raised if getattr(softfinger, name) is getattr(module, name)] == raised


@pytest.mark.plain
def test_a_mode_is_a_name_and_a_number(engine: Engine) -> None:
    touch = engine.step(PRESSED, UPRIGHT)
    assert touch.mode is softfinger.ContactMode.ROLLING and touch.mode == 1 == touch.record[AT.contact_mode]
    assert [mode.name.lower() for mode in softfinger.ContactMode] == list(MODE_NAMES)
    assert json.dumps(touch.mode) == "1" and msgpack.packb(touch.mode) == b"\x01"


def test_repr_and_completion_of_an_engine(client: partial[Client]) -> None:
    engine = Engine("paper-plane")
    engine.step(PRESSED, UPRIGHT)
    assert repr(engine) == "<Engine: objects table; 1000 Hz, after 1 ticks>"
    records = made_up()
    assert repr(records).startswith("<Records: 4 ticks; fields timestamp, tick, ")
    assert records._ipython_key_completions_() == [field.name for field in FIELDS]
    assert {"force", "mode", "penetration"} <= set(dir(engine.step(PRESSED, UPRIGHT)))
    with client() as daemon:
        window = daemon.window(samples=10)
        assert all(daemon.telemetry in repr(shown) for shown in (daemon, window, daemon.subscribe()))
        assert window._ipython_key_completions_() == records._ipython_key_completions_()
        sample = next(daemon.subscribe(timeout_s=20.0))
        assert {"tick", "contact", "force", "as_map"} <= set(dir(sample))
        assert {"mode", "penetration"} <= set(dir(sample.contact))


def test_the_door_is_light() -> None:
    code = "import sys; had = {*sys.modules}; import softfinger; dir(softfinger); print(*{*sys.modules} - had)"
    process = run_program([sys.executable, "-c", code], check=True)
    assert {name.partition(".")[0] for name in process.stdout.split()} - sys.stdlib_module_names == {"softfinger"}
    assert "softfinger." not in process.stdout


IMPORTS = """
import gc, sys
from softfinger import Engine
def loaded(*names): return [name for name in names if name in sys.modules]
print(loaded("msgspec", "softfinger.config.schema", "softfinger.proxy.scene"), gc.isenabled())
Engine("paper-plane")
parts = ("meshes.prepared", "meshes.tree", "heightmaps", "elastic.prepared", "kernels.elastic")
parts += ("kernels.shapes.mesh", "kernels.shapes.heightmap", "kernels.jit.source_hash")
print(loaded(*(f"softfinger.proxy.{part}" for part in parts)))
"""


def test_an_engine_imports_only_the_modules_of_its_scene():
    assert run_program([sys.executable, "-c", IMPORTS], check=True).stdout.splitlines() == ["[] True", "[]"]


@pytest.mark.parametrize("name", ["softfinger", *(f"softfinger.{module}" for module in MODULES)])
def test_the_examples_of_docstrings_run(name: str, client: partial[Client]) -> None:
    results = doctest.testmod(importlib.import_module(name), extraglobs={"Client": client})
    assert results.attempted and not results.failed


def made_up(rows: int = 4) -> Records:
    return Records(np.arange(float(rows * RECORD_SIZE)).reshape(rows, RECORD_SIZE))


def test_fields_match_the_table() -> None:
    records = made_up()
    for field in FIELDS:
        expected = np.asarray(records)[:, field.at : field.at + field.size].reshape(records[field.name].shape)
        np.testing.assert_array_equal(records[field.name], expected)
        np.testing.assert_array_equal(records.structured[field.name], expected)
        assert records[field.name].dtype == (np.int64 if field.kind == "int" else np.float64)
    assert records.structured.shape == (4,) and np.shares_memory(records, records.structured)


def test_selections_of_rows_keep_field_names() -> None:
    records = made_up()
    some, single = records[records["tick"] > RECORD_SIZE], records[2]
    assert some["force"].shape == (3, 3)  # the first row's tick is 1
    np.testing.assert_array_equal(single["force"], records["force"][2])
    assert type(records[:, AT.tick]) is np.ndarray and type(single["force"]) is np.ndarray
    with pytest.raises(KeyError, match=r"'contact.mod'.*did you mean 'contact.mode'"):
        records["contact.mod"]
    with pytest.raises(ValueError, match=r"shape \(2, 3\) contains no records"):
        Records(np.zeros((2, 3)))


def test_pandas_has_the_columns_of_a_results_file(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[tuple[list[str], dict[str, type]]] = []

    class Frame:
        def __init__(self, rows: np.ndarray, columns: list[str]) -> None:
            assert type(rows) is np.ndarray and rows.shape == (4, len(columns))
            self.columns = columns

        def astype(self, kinds: dict[str, type]) -> Frame:
            made.append((self.columns, kinds))
            return self

    stand_in = type(sys)("pandas")
    stand_in.DataFrame = Frame
    monkeypatch.setitem(sys.modules, "pandas", stand_in)
    made_up().to_pandas()
    assert made == [(list_columns(), {field.name: np.int64 for field in FIELDS if field.kind == "int"})]
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(HapticError, match="pip install pandas"):
        made_up().to_pandas()


@pytest.fixture(scope="module")
def engine() -> Engine:
    return Engine("paper-plane")


def pressing(engine: Engine) -> float:
    engine.reset()
    return engine.step(PRESSED, UPRIGHT).normal_force


@pytest.mark.plain
def test_set_is_load_scene_with_overrides(engine: Engine) -> None:
    changes = {STIFFNESS: 500.0, "coupling.stiffness_n_per_m": 700.0}
    poses = np.tile([*PRESSED, *UPRIGHT], (50, 1))
    poses[:, 0] = np.linspace(0.0, 0.002, 50)
    engine.reset()
    engine.set(changes)
    assert engine.config == load_scene("paper-plane", changes)
    np.testing.assert_array_equal(engine.run(poses), Engine(load_scene("paper-plane", changes)).run(poses))
    engine.set("object.0.material.stiffness_n_per_m", 1000.0)
    assert engine.step(PRESSED, UPRIGHT).cause != "touch"  # it was in contact throughout


@pytest.mark.plain
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({STIFFNESS: -1.0}, r"set: object\[0\].material.stiffness_n_per_m = -1.0: must be a number from"),
        ({STIFFNESS: 800.0, "object.table.material.stifness": 1.0}, "did you mean 'stiffness_n_per_m'"),
        ({STIFFNESS: 800.0, "object.0.material.stiffness_n_per_m": 700.0}, "set twice"),
        ({STIFFNESS: 800.0, "object.7.name": "x"}, "there is no object.7.: entries go from 0 to 0, or by name table"),
        ({STIFFNESS: 800.0, "rolling.method": "midpoint"}, "set: rolling.method: that is another model"),
    ],
)
def test_all_or_nothing(changes: dict[str, object], message: str, engine: Engine) -> None:
    engine.set(STIFFNESS, 1000.0)
    before = engine.config
    with pytest.raises(ConfigError, match=message) as refused:
        engine.set(changes)
    assert engine.config is before and pressing(engine) == pytest.approx(0.5, rel=1e-12)  # 1000 N/m, 0.5 mm; rounding
    assert "another model" not in message or STIFFNESS not in str(refused.value)


def test_set_compiles_nothing(engine: Engine) -> None:
    pressing(engine)
    before = len(step_many.overloads)
    engine.set(STIFFNESS, 321.0)
    assert pressing(engine) == pytest.approx(321.0 * 0.0005, rel=1e-12)  # rounding of a few operations
    assert len(step_many.overloads) == before


def test_a_hand_at_rest_leaves_no_denormal_numbers(engine: Engine) -> None:
    """The filtered velocity decays to exactly 0: subnormal values would slow down every tick."""
    engine.reset()
    poses = np.tile([*PRESSED, *UPRIGHT], (10_300, 1))
    poses[:300, :3] += np.linspace((-0.0013, 0.0007, 0.0002), (0.0, 0.0, 0.0), 300)
    values = np.abs(np.asarray(engine.run(poses)))
    assert not ((values > 0.0) & (values < np.finfo(float).tiny)).any()
    velocity = values[:, AT.probe_velocity : AT.probe_velocity + 3]
    assert velocity[299].all() and not velocity[-1].any()
    assert np.array_equal(engine.run(np.full((1, 7), poses[-1]))["probe.velocity"], np.zeros((1, 3)))


@pytest.mark.plain
@pytest.mark.parametrize(
    ("position", "orientation", "message"),
    [
        *(
            (kind(position), UPRIGHT, "must be 3 numbers")
            for position in ((0.0, 0.0), 0.0, None, ["a", 0.0, 0.0], [[0.0], [0.0], [0.0]], [10**400, 0.0, 0.0])
            for kind in (lambda value: value, lambda value: np.array(value, dtype=object))
        ),
        (PRESSED, [UPRIGHT], "and 4"),
        (PRESSED, "wxyz", "and 4"),
        (PRESSED, (10**200, 0.0, 0.0, 0.0), "and 4"),
        ((0.0, np.nan, 0.0), UPRIGHT, "must be finite"),
        ((0.0, 0.0, 2e6), UPRIGHT, "at most 1e\\+06 m"),
        (PRESSED, (0.0, 0.0, 0.0, 0.0), "whose norm must be"),
    ],
)
def test_an_invalid_pose_is_refused(position: object, orientation: object, message: str, engine: Engine) -> None:
    with pytest.raises(PoseError, match=message):
        engine.step(position, orientation)
    assert pressing(engine) > 0.0


@pytest.mark.plain
@pytest.mark.parametrize("rate_hz", [0.0, -1000.0, np.nan, np.inf])
def test_an_invalid_rate_is_refused(rate_hz: float) -> None:
    with pytest.raises(ConfigError, match=r"rate_hz = .*: must be a number from 0\.001 to 1e\+09 Hz"):
        Engine("paper-plane", rate_hz)


@pytest.mark.plain
def test_step_and_run_agree_to_the_bit(engine: Engine) -> None:
    poses = np.random.default_rng(3).normal(size=(40, 7)) * 0.001 + [*PRESSED, 3.0, 0.0, 0.0, 0.0]
    engine.reset()
    steps = [engine.step(pose[:3], list(pose[3:])) for pose in poses]
    engine.reset()
    np.testing.assert_array_equal(np.array([step.record for step in steps]), engine.run(poses))


@pytest.mark.plain
def test_a_mapping_is_as_good_as_a_file() -> None:
    scene = load_scene("sphere")
    assert load_scene(describe(scene)) == scene == load_scene(scene) and Engine(describe(scene)).config == scene
    with pytest.raises(ConfigError, match=r"scene: fingertip.radius_m = 'big'.*\n.*object"):
        load_scene({"fingertip": {"radius_m": "big"}})
    ball = "object.sphere.radius_m"
    assert load_scene(scene, {ball: 0.03}) == load_scene("sphere", {"object.0.radius_m": 0.03}) != scene


def test_a_recording_runs_as_simulate_does(tmp_path: Path) -> None:
    out, own = tmp_path / "verb.csv", tmp_path / "own.csv"
    assert main(["simulate", "--scene", "paper-plane", "--poses", "tap", "--out", str(out), "--rate", "500"]) == 0
    records = run_recording("tap", "paper-plane", rate_hz=500.0)
    write_blocks(own, [""], [records[:, None]])
    assert own.read_bytes() == out.read_bytes() and type(records) is Records
    with pytest.raises(ConfigError, match="poses of thumb do not match the fingers"):
        run_recording({"thumb": "tap"})
    tables = describe(load_scene("paper-plane"))
    named = tables | {"finger": [{"name": "index", **tables.pop("fingertip")}]}
    np.testing.assert_array_equal(run_recording("tap", named), run_recording({"index": "tap"}, named)["index"])


def test_a_client_receives_events_of_its_changes(client: partial[Client]) -> None:
    with client() as daemon:
        assert isinstance(daemon, Control)
        events = daemon.subscribe("event", timeout_s=20.0)
        window = daemon.window(samples=10)
        while len(window) < 10:
            assert window.update(timeout_s=20.0)
        assert window["force"].shape == (10, 3)
        for value in (810.0, 820.0):  # the subscription may start after the first
            daemon.set_params({STIFFNESS: value})
        change = next(event for event in events if event["name"] == "set_params")
        assert msgspec.to_builtins(change["what"])[STIFFNESS]["to"] in (810.0, 820.0)
    assert list(events) == []


def test_timestamps_use_the_documented_clocks(client: partial[Client], engine: Engine) -> None:
    engine.reset()
    for records in (run_recording("tap"), engine.run(np.tile([*PRESSED, *UPRIGHT], (10, 1)))):
        np.testing.assert_allclose(records["timestamp"], records["tick"] * 0.001, rtol=0.0, atol=1e-12)  # rounding
        assert not records["servo.exec"].any() and not records["buttons"].any()
    with client() as daemon:
        sample, state = next(daemon.subscribe(timeout_s=20.0)), daemon.get_state()
        assert abs(sample.timestamp - time.time()) < 3600.0  # an hour distinguishes the clocks
        assert abs(state.timestamp - time.monotonic()) < 3600.0
        assert state.sequence > 0 and state.field_state["mode"] in list(softfinger.ContactMode)


@pytest.mark.parametrize("verb", list(FOLDER_OF))
def test_shipped_files_are_listed_one_per_line(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([verb]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert main([verb, "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    ending = ".csv" if verb == "recordings" else ".toml"
    files = {path for path in FOLDER_OF[verb].iterdir() if path.suffix == ending}
    assert {Path(entry["file"]) for entry in listed} == files and len(lines) == len(listed)
    for line, entry in zip(lines, listed, strict=True):
        name, _, text = line.partition(" ")
        assert name == entry["name"] == Path(entry["file"]).stem and text.strip() == entry["description"]
        assert len(text.split()) > 3


def test_engine_returns_parameters_and_refuses_a_path_without_value():
    get = Engine("paper-plane").get
    assert (get(STIFFNESS), get("object.0.name")) == (1000.0, "table")
    assert get("object.table.material.friction") == {"static": 0.6, "kinetic": 0.5}
    for path in ("object.table.nothing", "object.desk.name", "object.7.name", "fingertip.radius_m.x", ""):
        assert f"no value at {path!r}" in refusal(get, path)


def test_notebooks_show_tables():
    engine = Engine(load_scene("paper-plane", {"object.0.name": "a <b>"}))
    assert "a &lt;b&gt;" in engine._repr_html_() and "<b>" not in engine._repr_html_()
    records = Records(np.zeros((2, RECORD_SIZE)))
    assert records._repr_html_().count("<tr>") == len(FIELDS) == records[0]._repr_html_().count("<tr>")
    assert "<tr>" not in records[:0]._repr_html_()


@pytest.mark.plain
@pytest.mark.parametrize("scene", ["paper-plane", "heightmap", "plates", "roll-a-pencil"])
@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda engine: pickle.loads(pickle.dumps(engine))])
def test_a_copy_continues_in_separate_memory(scene: str, duplicate: Callable[[Engine], Engine]) -> None:
    engine = Engine(scene)
    engine.step((0.001, 0.0, 0.0095), UPRIGHT)
    copied = duplicate(engine)
    for x in (0.002, 0.003):
        records = [one.step((x, 0.0, 0.009), UPRIGHT).record for one in (copied, engine)]
        np.testing.assert_array_equal(*records)
    before, third = engine._state.copy(), duplicate(engine)
    copied.reset()
    copied.step(PRESSED, UPRIGHT)
    np.testing.assert_array_equal(engine._state, before)
    np.testing.assert_array_equal(*(one.step(PRESSED, UPRIGHT).record for one in (engine, third)))
