"""Sessions on a daemon with a simulated hand: forces, markers, recordings, answers at a terminal, and kills."""

import json
import os
import pty
import random
import re
import resource
import signal
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from helpers.called import read_stdout
from helpers.faulty_device import registered
from helpers.processes import COMMAND, list_children
from helpers.programs import Program
from helpers.shortages import file_size_limit
from helpers.waits import WAIT_S, repeated
from test_trial_order import STIFFNESS, make_tables

from softfinger.config.errors import CommandRefused, DeviceLost, Exhausted, HapticError, SafetyStop
from softfinger.config.materials import load_materials
from softfinger.config.sources import EXPERIMENTS, list_names
from softfinger.proxy.record import FREE
from softfinger.server.experiment.daemon import RunOptions
from softfinger.server.experiment.experiment import Experiment, load_results
from softfinger.server.experiment.haptics import START_TOLERANCE_M, START_TOLERANCE_RAD, Haptics
from softfinger.server.experiment.interfaces import Stimulus, TouchResult
from softfinger.server.experiment.journal import read
from softfinger.server.loop.guard import DISARMED
from softfinger.server.recording.run import Run, load_run
from softfinger.server.remote import Client
from softfinger.server.wire.client import Sample
from softfinger.server.wire.control import Control

pytestmark = pytest.mark.real_time

MOTION = [[0.0, 0.0, 0.0, 0.015], [0.2, 0.0, 0.0, 0.008], [0.9, 0.0, 0.0, 0.008]]
TURN = [[0.2, 0.0, 0.0, 0.0], [0.7, 0.0, 0.0, 0.3]]
"""Spin about the normal: a plane answers it with a moment and no force."""
SLEW_N = 2.0
"""Slew limit of the rig's guard, N per tick."""
RAMP_TICKS = 500


MATERIAL = "object.table.material"
DAMPING = f"{MATERIAL}.damping_ns_per_m"


def experiment(**changes: Any) -> dict[str, Any]:
    procedure = {"kind": "constant", "levels": [1.0], "repetitions": 1}
    kinds = {"damped": {DAMPING: 2.0}, "plain": {}}
    factor = {"name": "kind", "levels": list(kinds), "values": kinds}
    trial = {"touch_s": 0.9, "gap_s": 0.1}
    tables = {"factor": [factor], "design": {"seed": 5, "order": "given"}, "procedure": procedure, "trial": trial}
    return make_tables(**tables, motion={"fingertip": MOTION}, turn={"fingertip": TURN}, **changes)


def settings(folder: Path) -> RunOptions:
    endpoints = {"telemetry.endpoint": f"ipc://{folder}/t", "commands.endpoint": f"ipc://{folder}/c"}
    return RunOptions(dry_run=True, doctor=False, rig=endpoints | {"servo.realtime": "off"})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a session."""
    folder = tmp_path_factory.mktemp("session")
    running = settings(folder)
    # A late loop makes few ticks between a change and the touch: with a ramp, none is comparable after it.
    Experiment(experiment()).run(folder / "out", 1, running._replace(rig=running.rig | {"commands.ramp_s": 0.0}))
    return folder / "out"


@pytest.fixture(scope="module")
def run(folder: Path) -> Run:
    return load_run(folder / "sub-01" / "sub-01_run-01_ticks.mcap", (
        "force", "contact.normal_force", "contact.mode", "servo.guard", "servo.missed", "probe.position",
        "probe.orientation",
    ))  # fmt: skip


def select_marks(run: Run, label: str) -> list[dict[str, Any]]:
    return [event for event in run.events if event["kind"] == "mark" and event["label"] == label]


def find_tick(run: Run, tick: int) -> int:
    return int(np.searchsorted(run.first["tick"], tick))


def test_every_touch_is_marked_in_its_order(run: Run) -> None:
    touches = [(event["data"]["trial"], event["data"]["touch"]) for event in select_marks(run, "touch")]
    assert touches == [(1, 1), (1, 2), (2, 1), (2, 2)]
    assert [(event["data"]["trial"], event["data"]["touch"]) for event in select_marks(run, "release")] == touches
    values = [event["data"]["changes"].popitem()[1] for event in select_marks(run, "touch")]
    assert sorted(values) == [500.0, 500.0, 1000.0, 1000.0]


def test_a_change_meets_no_force_and_the_force_never_jumps(run: Run) -> None:
    force = run.first["force"]
    changed = [event["tick"] for event in run.events if event["kind"] == "command" and event["name"] == "set_params"]
    assert len(changed) >= 2
    for tick in [*changed, *(event["tick"] for event in select_marks(run, "touch"))]:
        assert not force[find_tick(run, tick)].any()
    assert np.linalg.norm(np.diff(force, axis=0), axis=1).max() <= SLEW_N
    assert not [event for event in run.events if event.get("name") == "set_scene"]  # nothing was compiled
    damping = [event["what"][DAMPING] for event in run.events if DAMPING in (event.get("what") or {})]
    assert damping == [{"from": 0.0, "to": 2.0}, {"from": 2.0, "to": 0.0}]


def test_from_zero_to_touch_within_half_a_second(run: Run) -> None:
    missed = run.first["servo.missed"]
    armed = [event["tick"] for event in run.events if event["kind"] == "command" and event["name"] == "arm"]
    for tick, end in zip(armed, select_marks(run, "release"), strict=True):
        # Commands arrive between two ticks and take effect in the next one; the touch ends on command.
        first, last = find_tick(run, tick), find_tick(run, end["tick"])
        rows = slice(first + RAMP_TICKS + 3, last)
        force, wanted = run.first["force"][rows, 2], run.first["contact.normal_force"][rows]
        assert missed[last] > missed[first] or (len(force) > 100 and wanted.max() > 0.3)
        assert force == pytest.approx(wanted, abs=1e-12)


def test_a_guided_hand_starts_on_its_path_turns_and_turns_back(run: Run) -> None:
    w, _, _, z = run.first["probe.orientation"].T
    angle = 2.0 * np.arctan2(z, w)
    for begin, end in zip(select_marks(run, "touch"), select_marks(run, "release"), strict=True):
        start = find_tick(run, begin["tick"])
        assert np.linalg.norm(run.first["probe.position"][start] - MOTION[0][1:]) <= START_TOLERANCE_M
        assert abs(angle[start]) <= START_TOLERANCE_RAD
        # The path ends 0.2 s before the touch; the hand follows with a first-order lag of 30 ms.
        assert angle[find_tick(run, end["tick"])] == pytest.approx(0.3, abs=START_TOLERANCE_RAD)


@pytest.mark.exhaustive
def test_a_limit_of_the_rig_and_a_material_are_levels_of_a_factor(tmp_path: Path) -> None:
    kinds = {"weak": {"rig.guard.force_max_n": 0.3}, **{name: {MATERIAL: name} for name in ("wood", "rubber")}}
    factor = {"name": "kind", "levels": list(kinds), "values": kinds}
    task = {"kind": "rate", "parameter": DAMPING, "question": "How heavy?"}
    Experiment(experiment() | {"factor": [factor], "task": task}).run(tmp_path / "out", 1, settings(tmp_path))
    fields = ("force", "contact.normal_force", "contact.penetration")
    run = load_run(tmp_path / "out" / "sub-01" / "sub-01_run-01_ticks.mcap", fields)
    for condition, end in zip(kinds, select_marks(run, "release"), strict=True):
        last = find_tick(run, end["tick"]) - 1
        force = np.linalg.norm(run.first["force"][last])
        normal, depth = run.first["contact.normal_force"][last], run.first["contact.penetration"][last]
        if condition == "weak":
            assert force == pytest.approx(0.3, rel=1e-9) and normal > 0.3
            continue
        assert force == pytest.approx(normal, rel=1e-9)
        # The hand moves at some mm/s, where the damper contributes a thousandth of the force.
        assert normal / depth == pytest.approx(load_materials()[condition].values["stiffness_n_per_m"], rel=0.01)
    replaced = [find_tick(run, event["first"]) for event in run.events if event["name"] == "replaced"]
    assert len(replaced) >= 2 and not run.first["force"][replaced].any()


SEVERAL = {"name": "hand", "levels": ["one", "two"], "scenes": {"one": "paper-plane", "two": "pinch"}}
WEAK = {"device.force_max_n": 1.0, "guard.force_max_n": 0.8}


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("changes", "rig", "message"),
    [
        ({"factor": [{"name": "limit", "parameter": "rig.guard.force_max_n", "levels": [0.5, 2.0]}]}, WEAK,
         "condition 2.0, level 1: rig.guard.force_max_n = 2 N: simulated .* displays 1 N"),
        ({"overrides": {"rig.guard.force_max_n": 2.0}}, WEAK,
         "rig.guard.force_max_n = 2 N: simulated .* displays 1 N"),
        ({"factor": [SEVERAL], "task": {"kind": "rate", "question": "?", "parameter": "coupling.damping_ns_per_m"}}, {},
         r"scene pinch, rig .*: the scene has \[\[finger\]\] 'thumb', 'index', but the rig has \[device\]"),
        ({}, {"commands.endpoint": "off"}, "accepts no commands, but an experiment needs them"),
        ({"rig": "falcon"}, {}, "no Falcon .* is attached"),
        ({"motion": {"fingertip": [[0.0, 0.0, 0.0, 15.0]]}}, {}, "motion.fingertip: .* outside the workspace"),
    ],
)  # fmt: skip
def test_an_unusable_experiment_is_refused_before_writing(changes, rig, message, tmp_path):
    running = settings(tmp_path)
    with pytest.raises(HapticError, match=message):
        Experiment(experiment() | changes).run(tmp_path / "out", 1, running._replace(rig={**running.rig, **rig}))
    assert not (tmp_path / "out").exists()


def test_a_session_stops_on_a_full_disk_and_repeats_that_trial(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, limit = tmp_path / "out", resource.getrlimit(resource.RLIMIT_FSIZE)[1]
    force, numbers = list[float](), list[int]()
    own, take, touch = out / "sub-01", Haptics._store, Haptics.touch
    presented = list[int]()

    def touch_and_note(self: Haptics, stimulus: Stimulus) -> TouchResult:
        presented.append(stimulus.trial)
        return touch(self, stimulus)

    def store_and_fill_disk(self: Haptics, sample: Sample) -> None:
        take(self, sample)
        if "" in self.latest:
            force.append(float(np.linalg.norm(self.latest[""].data.force)))
            numbers.append(self.latest[""].tick)
        if presented and presented[-1] == 2 and force and force[-1] > 0.3:
            size = (own / "sub-01_run-01_ticks.mcap").stat().st_size
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, limit))

    monkeypatch.setattr(Haptics, "touch", touch_and_note)
    monkeypatch.setattr(Haptics, "_store", store_and_fill_disk)
    with file_size_limit(limit), pytest.raises(Exhausted) as ended:
        Experiment(experiment()).run(out, 1, settings(tmp_path))
    monkeypatch.undo()
    start = re.escape(str(own / "sub-01_run-01_ticks.mcap")) + r": the recording ends after \d+ ticks: File too large: "
    assert re.fullmatch(start + "the force is off, and all earlier answers are stored: make room .* this trial again",
                        str(ended.value))  # fmt: skip
    assert presented == [1, 1, 2]
    assert force[-1] == 0.0 and max(force) > 0.3
    assert (np.abs(np.diff(force)) <= SLEW_N * np.diff(numbers)).all()  # a late reader gets not every tick
    journal = own / "sub-01_journal.jsonl"
    assert [entry["kind"] for entry in read(journal)] == ["started", "begun", "done", "begun"]
    rows = Experiment(experiment()).run(out, 1, settings(tmp_path))
    assert [(row["trial"], row["attempt"]) for row in rows] == [(1, 1), (2, 2)]
    run = load_run(own / "sub-01_run-02_ticks.mcap", ("force",))
    assert {event["data"]["trial"] for event in select_marks(run, "touch")} == {2}
    ticks = pd.read_csv(own / "trials" / "sub-01_trial-0002_attempt-2.csv")
    assert np.isin(ticks["tick"], run.first["tick"]).all() and len(ticks) > 100


def test_a_touch_without_force_is_not_answered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store, disarmed = Haptics._store, list[bool]()

    def store_and_disarm(self: Haptics, sample: Sample) -> None:
        store(self, sample)
        if not disarmed and "" in self.latest and np.linalg.norm(self.latest[""].data.force) > 0.3:
            with Control(f"ipc://{tmp_path}/c", WAIT_S) as control:
                disarmed.append(control.disarm().armed)

    monkeypatch.setattr(Haptics, "_store", store_and_disarm)
    with pytest.raises(SafetyStop, match=r"^the force was removed during the touch: .* presents this trial again$"):
        Experiment(experiment()).run(tmp_path / "out", 1, settings(tmp_path))
    assert disarmed == [False]
    journal = tmp_path / "out" / "sub-01" / "sub-01_journal.jsonl"
    assert [entry["kind"] for entry in read(journal)] == ["started", "begun"]


def test_a_session_whose_device_is_lost_repeats_that_trial(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    driver, touch = registered(monkeypatch), Haptics.touch
    rating = {"kind": "rate", "parameter": DAMPING, "question": "How heavy?"}
    pressing = experiment() | {"rig": "replay", "motion": {}, "turn": {}, "task": rating}
    pressing["factor"] = [{"name": "push", "parameter": STIFFNESS, "levels": [500.0, 1000.0]}]
    running, faulty = settings(tmp_path), {"device.driver": "faulty", "device.fault": "lost", "device.at": 10**9}
    running = running._replace(rig={**running.rig, **faulty})

    def touch_and_unplug(self: Haptics, stimulus: Stimulus) -> TouchResult:
        if stimulus.trial == 2 and len(driver.devices) == 1:
            driver.device.fail_after(500)
        return touch(self, stimulus)

    monkeypatch.setattr(Haptics, "touch", touch_and_unplug)
    with pytest.raises(DeviceLost, match="faulty"):
        Experiment(pressing).run(tmp_path / "out", 1, running)
    assert driver.device.wrenches.any() and not driver.device.wrenches[-1].any()
    journal = tmp_path / "out" / "sub-01" / "sub-01_journal.jsonl"
    assert [entry["kind"] for entry in read(journal)] == ["started", "begun", "done", "begun"]
    rows = Experiment(pressing).run(tmp_path / "out", 1, running)
    assert [(row["trial"], row["attempt"]) for row in rows] == [(1, 1), (2, 2)]


def test_the_table_of_a_trial_has_the_ticks_of_the_recording(folder: Path, run: Run) -> None:
    for row in load_results(folder):
        ticks = pd.read_csv(folder / "sub-01" / "trials" / f"sub-01_trial-{row['trial']:04d}.csv")
        places = np.searchsorted(run.first["tick"], ticks["tick"])
        assert np.array_equal(run.first["force"][places], ticks[["fx_n", "fy_n", "fz_n"]])
        test = ticks[ticks["touch"] == (1 if row["test_first"] else 2)]
        assert row["lost_ticks"] == 0 and row["peak_force_n"] == pytest.approx(test["fz_n"].max())


def test_the_recording_of_a_session_is_replayed(folder: Path, run: Run) -> None:
    recording = folder / "sub-01" / "sub-01_run-01_ticks.mcap"
    content = json.loads(read_stdout("replay", "--tolerance", "0", "--json", str(recording)))
    armed = run.first["servo.guard"].astype(int) & DISARMED == 0
    late = run.first["servo.missed"][-1] > run.first["servo.missed"][0]
    # No command follows the last touch; the guard takes its force away in one tick more.
    touched = armed & (run.first["contact.mode"] != FREE) & (run.first["tick"] > select_marks(run, "touch")[-1]["tick"])
    fewest = touched.sum() - 1 if late else armed.sum() / 2
    assert content["different"] == 0 and 0 < fewest <= content["compared"] <= armed.sum()


def test_measured_forces_are_plotted_by_condition(folder: Path) -> None:
    read_stdout("figure", str(folder))
    figures = folder / "figures"
    assert {path.name for path in figures.glob("felt.*")} == {"felt.png", "felt.svg"}
    content = json.loads((figures / "numbers.json").read_text())
    assert [entry["condition"] for entry in content] == ["damped", "plain"]
    for entry in content:
        peaks = [row["peak_force_n"] for row in load_results(folder) if row["condition"] == entry["condition"]]
        assert entry["peak_force_n_mean"] == pytest.approx(float(np.mean(peaks)), rel=1e-12)


def program(file: Path, folder: Path, *words: str) -> list[str]:
    ends = ["--endpoint", f"ipc://{folder}/t", "--commands", f"ipc://{folder}/c"]
    common = [*COMMAND, "-q", "experiment", str(file), "--no-doctor"]
    return [*common, "--out", str(folder / "out"), *ends, *words]


EXPERIMENT = f"""
title = "at a terminal"
scene = "paper-plane"
task = {{ kind = "compare", parameter = "{STIFFNESS}", reference = 500.0, question = "Which?" }}
procedure = {{ kind = "constant", levels = [0.5, 1.0] }}
design = {{ seed = 1, practice = 1 }}
trial = {{ touch_s = 0.1, gap_s = 0.0 }}
"""


def test_a_participant_answers_by_key_and_by_command_and_may_stop(tmp_path: Path) -> None:
    file = tmp_path / "terminal.toml"
    file.write_text(EXPERIMENT)
    ours, theirs = pty.openpty()
    try:
        with Program(program(file, tmp_path), stdin=theirs, stdout=subprocess.PIPE, text=True) as process:
            assert "Which?" in process.stdout.readline()
            with repeated(lambda: os.write(ours, b"1"), 0.033):  # a key that remains pressed
                assert "Release the key." in process.stdout.readline()
            practised = process.stdout.readline()
            os.write(ours, b"\n")
            assert "1 of 3 trials are done" in process.stdout.readline()
            os.write(ours, b"\n")
            assert "Which?" in process.stdout.readline()
            os.write(ours, b"x2")
            assert "Which?" in process.stdout.readline()
            process.send_signal(signal.SIGINT)
            assert process.wait(WAIT_S) == 0
        with Program(program(file, tmp_path), stdin=theirs, stdout=subprocess.PIPE, text=True) as process:
            assert "Which?" in process.stdout.readline()
            with Client(f"ipc://{tmp_path}/t", f"ipc://{tmp_path}/c", timeout_s=WAIT_S) as client:
                with pytest.raises(CommandRefused, match="give one of first, second"):
                    client.answer("neither")
                client.answer("first")
            assert process.wait(WAIT_S) == 0
    finally:
        os.close(ours)
        os.close(theirs)
    rows = load_results(tmp_path / "out")
    assert all(0.0 < row["answer_s"] < WAIT_S for row in rows)
    answers = [(row["trial"], row["practice"], row["answer"], row["attempt"]) for row in rows]
    assert answers == [(1, True, "first", 1), (2, False, "second", 1), (3, False, "first", 2)]
    assert ("right" if rows[0]["right"] else "wrong") in practised
    journal = read(tmp_path / "out" / "sub-01" / "sub-01_journal.jsonl")
    assert [entry["kind"] for entry in journal] == [
        "started", "begun", "done", "begun", "done", "begun", "started", "begun", "done", "finished",
    ]  # fmt: skip
    assert len(list((tmp_path / "out" / "sub-01").glob("*.mcap"))) == 2


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", list_names(EXPERIMENTS))
def test_each_shipped_experiment_runs_on_a_daemon(name: str, tmp_path: Path) -> None:
    levels = Experiment(name).file.procedure.levels or (0.1, 0.6)
    changes: dict[str, Any] = {"procedure.kind": "constant", "procedure.levels": [min(levels), max(levels)]}
    changes |= {"procedure.repetitions": 1, "procedure.starts": [], "design.practice": 0}
    rows = Experiment(name, changes).run(tmp_path / "out", 1, settings(tmp_path))
    assert all(row["peak_force_n"] > 0.1 and row["lost_ticks"] == 0 for row in rows)


KILLED = """
title = "killed"
scene = "paper-plane"
rig = "rig.toml"
task = {{ kind = "rate", parameter = "object.table.material.stiffness_n_per_m", question = "How stiff?" }}
procedure = {{ kind = "constant", levels = [200.0, 500.0, 900.0], repetitions = {repetitions} }}
design = {{ seed = 3 }}
trial = {{ touch_s = 0.03, gap_s = 0.0 }}
motion = {{ fingertip = [[0.0, 0.0, 0.0, 0.009]] }}
"""
RIG = """
guard = { ramp_s = 0.01 }
commands = { ramp_s = 0.0 }
servo = { realtime = "off" }
[device]
driver = "simulated"
preset = "omega.6"
position_m = [0.0, 0.0, 0.009]
hand = { mass_kg = 0.1, damping_ns_per_m = 8.0, stiffness_n_per_m = 1000.0 }
"""


def kill_while_running(words: list[str], journal: Path, rng: random.Random) -> None:
    size = lambda: journal.stat().st_size if journal.exists() else 0  # noqa: E731
    process = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    until = size() + (rng.randrange(1, 1500) if rng.random() < 0.8 else 0)
    over = time.monotonic() + 300.0
    while size() < until and process.poll() is None:
        time.sleep(1e-3)
        if time.monotonic() > over:
            process.kill()
            pytest.fail("the session does not go on")
    time.sleep(rng.random() * (0.1 if until else 2.0))
    if rng.random() < 0.3:
        for child in list_children(process.pid):
            with suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)
        time.sleep(rng.random() * 0.1)
    process.send_signal(signal.SIGKILL)
    process.wait()


@pytest.mark.scaled
@pytest.mark.exhaustive
def test_a_session_with_a_daemon_survives_kills(tmp_path: Path, cases: Callable[[int, int], int]) -> None:
    kills = cases(1, 50)  # each kill costs a start of the program, about 2 s of processor time
    (tmp_path / "rig.toml").write_text(RIG)
    file = tmp_path / "killed.toml"
    file.write_text(KILLED.format(repetitions=2 * kills))
    words = [*COMMAND, "-q", "experiment", str(file), "--dry-run", "--no-doctor"]
    words += ["--out", str(tmp_path / "out"), "--endpoint", f"ipc://{tmp_path}/t", "--commands", f"ipc://{tmp_path}/c"]
    own, rng = tmp_path / "out" / "sub-01", random.Random(11)
    for _ in range(kills):
        kill_while_running(words, own / "sub-01_journal.jsonl", rng)
    assert subprocess.run(words, check=False, stdout=subprocess.DEVNULL, timeout=300.0).returncode == 0
    rows, rehearsed, keys = load_results(tmp_path / "out"), Experiment(file).rehearse(), ("trial", "level", "answer")
    assert [[row[key] for key in keys] for row in rows] == [[row[key] for key in keys] for row in rehearsed]
    steps = [entry for entry in read(own / "sub-01_journal.jsonl") if entry["kind"] in ("begun", "done")]
    for number, (trial, group) in enumerate(groupby(steps, lambda entry: entry["trial"]), 1):
        entries = list(group)
        assert trial == number  # never an earlier trial
        assert [entry["kind"] for entry in entries] == ["begun"] * (len(entries) - 1) + ["done"]
        assert [entry["attempt"] for entry in entries[:-1]] == list(range(1, len(entries)))
        assert entries[-1]["attempt"] == len(entries) - 1
    for row in rows:
        suffix = f"_attempt-{row['attempt']}" if row["attempt"] > 1 else ""
        ticks = pd.read_csv(own / "trials" / f"sub-01_trial-{row['trial']:04d}{suffix}.csv")
        assert len(ticks) + row["lost_ticks"] == row["last_tick"] - row["first_tick"] + 1
