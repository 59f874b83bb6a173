"""Design of an experiment: conditions, orders, mistakes that are found before, and the hand motion of a shipped one."""

import json
from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
from helpers.called import called
from numpy.typing import NDArray

from softfinger.config.errors import ConfigError
from softfinger.config.sources import EXPERIMENTS
from softfinger.drivers import quaternions
from softfinger.proxy.engine import Engine
from softfinger.proxy.kernels.numerics.rotations import exp
from softfinger.server.experiment.checks import load
from softfinger.server.experiment.daemon import RunOptions
from softfinger.server.experiment.experiment import Experiment
from softfinger.server.experiment.hands import interpolate_path
from softfinger.server.experiment.interfaces import Progress
from softfinger.server.experiment.parameters import load_changed_scene
from softfinger.server.experiment.schema import SINGLE_FINGER, ExperimentFile
from softfinger.server.experiment.session import number_blocks
from softfinger.server.experiment.trial_order import list_conditions, make_williams_row, plan_trials

pytestmark = pytest.mark.plain

STIFFNESS = "object.table.material.stiffness_n_per_m"


def make_tables(**tables: Any) -> dict[str, Any]:
    task = {"kind": "compare", "parameter": STIFFNESS, "reference": 500.0, "question": "Which was stiffer?"}
    procedure = {"kind": "constant", "levels": [0.1, 0.2, 0.4], "repetitions": 4}
    factor = {"name": "damping", "parameter": "object.table.material.damping_ns_per_m", "levels": [0.0, 1.0, 2.0]}
    defaults = {"title": "small", "scene": "paper-plane", "task": task, "procedure": procedure, "factor": [factor]}
    return defaults | {"design": {"seed": 5}} | tables


def make_file(**tables: Any) -> ExperimentFile:
    return Experiment(make_tables(**tables)).file


def test_all_combinations_occur_equally_often() -> None:
    both = [*make_tables()["factor"], {"name": "radius", "parameter": "fingertip.radius_m", "levels": [0.008, 0.01]}]
    experiment = make_file(factor=both)
    assert len(list_conditions(experiment)) == 6
    count = Counter((trial.condition, trial.level) for trial in plan_trials(experiment, 1))
    assert len(count) == 18 and set(count.values()) == {4}


def test_the_order_depends_on_seed_and_participant() -> None:
    trials = plan_trials(make_file(), 1)
    assert plan_trials(make_file(), 1) == trials
    assert plan_trials(make_file(), 2) != trials and plan_trials(make_file(design={"seed": 6}), 1) != trials


def test_the_reference_comes_first_as_often_as_second() -> None:
    assert sum(trial.test_first for trial in plan_trials(make_file(), 3)) == 18


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 6, 7, 8])
def test_a_latin_square_is_balanced(count: int) -> None:
    """Each condition occurs equally often at each position and after each other condition (Williams 1949)."""
    rows = [make_williams_row(count, row) for row in range(count * (1 + count % 2))]
    for place in range(count):
        assert len(set(Counter(row[place] for row in rows).values())) == 1
    follows = Counter(pair for row in rows for pair in pairwise(row))
    assert len(follows) == count * (count - 1) and len(set(follows.values())) <= 1


def test_blocks_contain_one_condition_each() -> None:
    for order, wanted in (("latin-square", make_williams_row(3, 1)), ("given", [0, 1, 2])):
        trials = plan_trials(make_file(design={"seed": 5, "order": order}), 2)
        assert [trial.condition for trial in trials] == [at for at in wanted for _ in range(12)]


def test_practice_comes_first() -> None:
    trials = plan_trials(make_file(design={"seed": 5, "practice": 3}), 1)
    assert [trial.practice for trial in trials] == [True] * 3 + [False] * 36
    assert [trial.number for trial in trials] == list(range(1, 40))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"task.reference": None}, "required for compare"),
        ({"procedure.kind": "stair"}, "did you mean 'staircase'"),
        ({"procedure.levels": []}, "constant needs levels"),
        ({"procedure.levels": 0.1}, "must be a list of 0 to 200 numbers above 0 and at most 1e"),
        ({"task.scale_ends": "soft"}, "must be a list of texts of 1 to 64 characters"),
        ({"procedure.kind": "staircase", "procedure.start": 2.0}, "must be from smallest = 0.005"),
        ({"task.parameter": "object.table.material.stifness"}, "is not a key here"),
        ({"task.parameter": "object.chair.material.stiffness_n_per_m"}, "there is no object.chair"),
        ({"task.parameter": "mass.box"}, "the scene has no .world"),
        ({"task.parameter": "guard.force_max_n"}, "of the rig there are rig.guard"),
        ({"task.parameter": "rig.guard.arm"}, "cannot change in a running daemon"),
        ({"factor.0.parameter": "rig.guard.force_max_n", "factor.0.levels": [1.0, -1.0]}, "guard.force_max_n = -1.0"),
        ({"rig": "touch", "factor.0.parameter": "rig.guard.continuous_force_n", "factor.0.levels": [0.5, 0.95]},
         "0.95: the rig's 0.88 is the limit of its motors"),
        ({"rig": "touch", "overrides": {"rig.guard.heat_time_s": 1e3}},
         "heat_time_s = 1000.0: the rig's .* is the limit of its motors"),
        # levels 40.5 / 1.1 to 40.5 / 1.4: none is above 40
        ({"task.parameter": "rig.guard.force_max_n", "task.reference": 40.5, "task.more": "down"},
         "guard.force_max_n = 40.5"),
        ({"task.kind": "rate", "task.reference": None, "task.scale": [7, 1]}, "the first mark, from 1"),
        ({"task.kind": "rate", "task.reference": None, "procedure.kind": "staircase"},
         "must be constant: answers of rate are not right or wrong"),
        ({"task.scale": [1, 7]}, "only rate has a scale"),
        ({"task.scale_ends": ["soft", "hard"]}, "requires scale"),
        ({"factor.0.scenes": {"a": "sphere"}}, "set one of parameter, scenes and values"),
        ({"procedure.levels": [0.1, 0.2, 0.1]}, "has a level twice"),
        ({"task.kind": "compares", "procedure.kind": "staircase"}, r"^experiment: task\.kind = [^\n]*$"),
        ({"factor.0.parameter": STIFFNESS}, r"factor\[0\] = 'object\.[^']*': is set by the task, which replaces it"),
        ({"observer.by": {"3.0": {"threshold": 0.1}}}, "no condition is called '3.0'.*; there are 0.0; 1.0; 2.0"),
        ({"observer.by": {"2.0": {"treshold": 0.1}}}, "did you mean 'threshold'"),
        ({"motion": {"thumb": [[0.0, 0.0, 0.0, 0.0]]}}, "motion.thumb: no scene has this finger; there are fingertip"),
        ({"motion": {"fingertip": [[3.0, 0.0, 0.0, 0.0]]}}, "ends at 3 s: set trial.touch_s to that"),
    ],
)  # fmt: skip
def test_an_unusable_design_is_refused_before_the_session(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Experiment(make_tables(), changes)


def test_progress_shows_the_block_but_no_condition() -> None:
    blocked = make_file(design={"seed": 5, "order": "given", "practice": 1})
    assert number_blocks(plan_trials(blocked, 1), is_mixed=False) == [1] * 13 + [2] * 12 + [3] * 12
    assert number_blocks(plan_trials(make_file(), 1), is_mixed=True) == [1] * 36
    assert Progress(3, 37, 1, 3, True, 2, 2).title == "Block 1 of 3, trial 3 of 37, practice"
    assert Progress(3, 37, 1, 1, False, 1, 2).text == "Touch 1 of 2"


def test_a_rating_stays_on_its_scale() -> None:
    task = {"kind": "rate", "parameter": STIFFNESS, "question": "?", "scale": [1, 7], "scale_ends": ["soft", "hard"]}
    observer = {"scale": 5.0, "exponent": 2.0, "noise": 0.5}
    procedure = {"kind": "constant", "levels": [0.1, 1.0, 3.0]}
    experiment = Experiment(make_tables(task=task, observer=observer, procedure=procedure))
    assert {row["answer"] for row in experiment.rehearse()} <= {float(mark) for mark in experiment.file.task.marks}


ROLLING, SLIDING = 1, 2
RADIUS_M = 0.01
FRICTION = 0.5
"""Kinetic friction coefficient of both scenes."""


def simulate_condition(condition: str, radius_m: float) -> tuple[Any, NDArray[np.float64]]:
    experiment, folder = load("curvature-by-rolling", {})
    path, turns = experiment.motion[SINGLE_FINGER], experiment.turn[SINGLE_FINGER]
    times = np.arange(0.0, 1.5, 0.005)
    poses = np.array([[*interpolate_path(path, t), *quaternions.exp(interpolate_path(turns, t))] for t in times])
    name = experiment.factor[0].scenes[condition]
    values = {"object.sphere.radius_m": radius_m, "object.sphere.position_m.2": -radius_m}
    scene = load_changed_scene(folder / name if name.endswith(".toml") else name, values, "a test")
    return Engine(scene).run(poses), poses


@pytest.mark.parametrize("radius_m", [0.04, 0.02])  # reference radius and smallest radius of all levels
def test_with_rolling_the_finger_never_slides(radius_m: float) -> None:
    """The finger never slides, and the tangential force is coupling stiffness times the lag of the rolling proxy."""
    records, poses = simulate_condition("rolls", radius_m)
    mode = records["contact.mode"]
    first = int(np.argmax(mode == ROLLING))
    assert (mode[first:] == ROLLING).all() and first < 100
    # The proxy touches at the angle -asin(5 mm / (r + R)) from the top and rolls on by theta r / (r + R), where r theta
    # is the displacement of the probe. The probe moves on a straight line, so its tangential distance from the proxy
    # loads the coupling of 1000 N/m.
    reach = radius_m + RADIUS_M
    proxy = (poses[-1, 0] + 0.005) / reach - np.arcsin(0.005 / reach)
    x, z = poses[-1, 0], poses[-1, 2] + radius_m
    lag = np.hypot(x, z) * np.sin(np.arctan2(x, z) - proxy)
    normal, force = records["contact.normal_force"][-1], records["force"][-1]
    tangential = float(np.sqrt(force @ force - normal**2))
    assert tangential == pytest.approx(1000.0 * lag, rel=0.05)  # the damper of 1 N s/m contributes a few hundredths
    assert tangential < 0.6 * FRICTION * normal


def test_without_rolling_the_same_movement_drags() -> None:
    records, _ = simulate_condition("slides", 0.04)
    slides = records["contact.mode"] == SLIDING
    assert slides[-100:].all()
    force, normal = records["force"][-100:], records["contact.normal_force"][-100:]
    tangential = np.sqrt((force * force).sum(axis=1) - normal**2)
    assert np.median(tangential / normal) == pytest.approx(FRICTION, rel=1e-6)


@pytest.mark.parametrize("rotation", [(0.0, 0.0, 0.0), (0.0, 0.5, 0.0), (-1.0, 2.0, 0.3), (1e-9, 0.0, 0.0)])
def test_a_rotation_vector_turns_as_the_kernels_have_it(rotation: tuple[float, float, float]) -> None:
    assert quaternions.exp(rotation).tolist() == pytest.approx(exp(rotation), abs=4e-16)


def test_a_turn_needs_a_motion() -> None:
    with pytest.raises(ConfigError, match=r"turn\.thumb: rotates a hand that \[motion\] does not move"):
        Experiment(EXPERIMENTS / "curvature-by-rolling.toml", {"turn.thumb": [[0.0, 0.0, 0.0, 0.0]]})


SCENE: Final = """
[fingertip]
radius_m = RADIUS
[[object]]
name = "table"
shape = "plane"
[object.material]
stiffness_n_per_m = 500.0
damping_ns_per_m = DAMPING
"""
RIG: Final = '[device]\ndriver = "DRIVER"\n[servo]\nrate_hz = RATE\n'
EXPERIMENT: Final = """
title = "t"
scene = "scene.toml"
rig = "rig.toml"
procedure = { kind = "constant", levels = [0.1, 1.0] }
design = { seed = SEED }
overrides = { "OVERRIDE" = 1.0 }
motion = { FINGER = [[0.0, 0.0, 0.0, 0.01]] }
screen = { image = "none.png", by = { "3.0" = { colour = "#ffffff" } } }
observer = { by = { "2.0" = { threshold = 0.2 } }, answers = { weight = 60.0 } }
survey = [{ name = "tlx", at = ["after"], file = "SURVEY" }]
[task]
kind = "compare"
parameter = "object.table.material.stiffness_n_per_m"
reference = 500.0
question = "Which was stiffer?"
[[factor]]
name = "damping"
parameter = "object.table.material.damping_ns_per_m"
levels = [0.0, 1.0]
"""
PLAIN: Final = """
title = "t"
scene = "scene.toml"
task = { kind = "compare", parameter = "coupling.damping_ns_per_m", reference = 1.0, question = "?" }
procedure = { kind = "constant", levels = [0.1] }
design = { seed = 1 }
"""


def check(folder: Path, **values: str) -> list[str]:
    sound = {"SEED": "1", "OVERRIDE": "object.table.material.damping_ns_per_m", "FINGER": "fingertip", "RADIUS": "0.01",
             "DAMPING": "0.0", "DRIVER": "simulated", "RATE": "1000.0", "SURVEY": "nasa-tlz"}  # fmt: skip
    for name, text in (("scene.toml", SCENE), ("rig.toml", RIG), ("study.toml", EXPERIMENT)):
        for word, value in (sound | values).items():
            text = text.replace(word, value)
        (folder / name).write_text(text)
    errors: list[str] = json.loads(called("check", "--json", str(folder / "study.toml")).stdout)[0]["errors"]
    return errors


def assert_lists(errors: list[str], *texts: str) -> None:
    matches = [[text for text in texts if text in error] for error in errors]
    assert sorted(matches) == sorted([text] for text in texts), errors


NAMES: Final = ("'nasa-tlz'", "observer.by", "screen.by", "screen.image = 'none.png'")


def test_mistakes_of_other_files_and_names(tmp_path: Path) -> None:
    assert_lists(check(tmp_path), *NAMES)
    assert_lists(check(tmp_path, SURVEY="nasa-tlx"), *NAMES[1:], "observer.answers.weight")
    errors = check(tmp_path, OVERRIDE="object.tabel.position_m", FINGER="thumb", DRIVER="simulatd")
    assert_lists(errors, "simulatd", "object.tabel", "motion.thumb", *NAMES)


def test_mistakes_behind_mistakes_of_the_file(tmp_path: Path) -> None:
    errors = check(tmp_path, SEED="-1", RADIUS="-0.01", DAMPING="-2.0", RATE="0.0", FINGER="thumb")
    assert_lists(errors, "design.seed", "servo.rate_hz", "fingertip.radius_m", "damping_ns_per_m = -2.0", *NAMES)
    with pytest.raises(ConfigError, match=r"8 faults:\n(.*\n){7}.*"):
        Experiment(tmp_path / "study.toml")


@pytest.mark.parametrize(
    ("name", "data", "more", "table"),
    [
        ("blob.obj", b"v 0 0 0\nv .04 0 0\nv 0 .04 0\nv 0 0 .04\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n", b"# more\n",
         '[[object]]\nname = "blob"\nshape = "mesh"\nfile = "blob.obj"\nposition_m = [0.0, 0.0, -1.0]\n'
         'material = "wood"\n'),
        ("ribs.csv", b"0,1\n1,0\n", b"0,1\n",
         '[object.texture]\nfile = "ribs.csv"\nsize_m = [0.02, 0.02]\nheight_m = 1e-5\n'),
        ("box.xml", b'<mujoco><worldbody><geom size=".01" pos="0 0 -1"/></worldbody></mujoco>', b"<!-- more -->",
         '[world]\nmodel = "box.xml"\nmaterial = "wood"\n'),
    ],
    ids=["mesh", "texture", "model"],
)  # fmt: skip
def test_a_file_that_a_scene_names_belongs_to_the_study(name, data, more, table, tmp_path):
    folder, offline = tmp_path / "study", RunOptions(dry_run=True, no_daemon=True)
    folder.mkdir()
    (folder / name).write_bytes(data)
    (folder / "scene.toml").write_text(SCENE.replace("RADIUS", "0.01").replace("DAMPING", "0.0") + table)
    (folder / "study.toml").write_text(PLAIN)
    Experiment(folder / "study.toml").run(tmp_path / "out", 1, offline)
    Experiment(folder / "study.toml").run(tmp_path / "out", 2, offline)
    (folder / name).write_bytes(data + more)
    with pytest.raises(ConfigError, match=rf"files\.json: .* other values \({name}\)"):
        Experiment(folder / "study.toml").run(tmp_path / "out", 3, offline)


RISES = [[0.5, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [1.5, 0.0, 0.0, 0.0]]


@pytest.mark.parametrize("table", ["motion", "turn"])
@pytest.mark.parametrize("order", [(1, 0, 2), (2, 1, 0), (0, 2, 1), (0, 0, 1)])
def test_times_of_a_path_increase(table: str, order: tuple[int, ...]) -> None:
    file, paths = EXPERIMENTS / "curvature-by-rolling.toml", {"motion": {"fingertip": RISES}, "turn": {}}
    load(file, paths)
    with pytest.raises(ConfigError, match=rf"{table}\.fingertip = .*: times must increase"):
        load(file, paths | {table: {"fingertip": [RISES[index] for index in order]}})


@pytest.mark.parametrize(("name", "rig"), [("weight-of-a-box", "simulated"), ("path-tracing", "simulated-lift-a-box")])
def test_the_rig_has_a_device_for_each_finger(name: str, rig: str) -> None:
    with pytest.raises(ConfigError, match=r"the scene has \[.*but the rig has \[device"):
        load(EXPERIMENTS / f"{name}.toml", {"rig": rig})
