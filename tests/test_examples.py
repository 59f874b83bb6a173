"""The programs of examples/ run unchanged, and print the values predicted by theory."""

import csv
import importlib
import math
import os
import re
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import nbformat
import pytest
from helpers.programs import run_program
from helpers.waits import repeated
from nbclient import NotebookClient

from softfinger.drivers.base import PROTOCOL
from softfinger.proxy.record import MODE_NAMES
from softfinger.server.driver_contract import DeviceCaller
from softfinger.server.experiment.analysis import fit_groups
from softfinger.server.experiment.daemon import RunOptions
from softfinger.server.experiment.experiment import Experiment
from softfinger.server.experiment.folder import load, write_csv
from softfinger.server.experiment.psychometric import Fit
from softfinger.server.wire.client import subscribe

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
PNG = b"\x89PNG"
LINES_MAX = 130


def run_example(program: str, *words: str, cwd: Path, plain: bool = False) -> str:
    """Run an example to its end; return its output. `plain`: nothing is compiled."""
    command = [sys.executable, EXAMPLES / program, *words]
    environment = os.environ | ({"NUMBA_DISABLE_JIT": "1"} if plain else {})
    return run_program(command, cwd=cwd, timeout=500, env=environment, check=True).stdout


def number(pattern: str, text: str) -> float:
    match = re.search(pattern, text)
    assert match, text
    return float(match[1])


def test_a_box_hangs_by_soft_fingers(tmp_path: Path) -> None:
    """By no more than a fifth beyond the closed form, for it is let go at once; by points past the vertical."""
    text = run_example("lift_a_box.py", cwd=tmp_path, plain=True)
    rest = math.degrees(0.1 * 9.81 * 0.008 / (2.0 * 0.05))
    assert number(r"has ([0-9.]+)", text) == pytest.approx(rest, abs=0.05)  # as it is rounded
    assert rest < number(r"soft fingers it turns by ([0-9.]+)", text) < 1.2 * rest
    assert number(r"points it turns by ([0-9.]+)", text) > 90.0


def test_a_finger_feels_how_hard_a_gripper_presses(tmp_path: Path) -> None:
    text = run_example("teleoperate_a_gripper.py", cwd=tmp_path, plain=True)
    rows = re.findall(r"by ([0-9.]+) mm: the finger feels ([0-9.]+) N, the gripper presses with ([0-9.]+)", text)
    assert len(rows) == 3
    for pulled, shown, pressed in (tuple(map(float, row)) for row in rows):
        expected = max(1e-3 * pulled - 0.004, 0.0) / (1.0 / 2000.0 + 1.0 / 300.0)
        assert shown == pytest.approx(pressed, abs=2e-3)
        assert shown == pytest.approx(
            expected, rel=0.04
        )  # MuJoCo's contact is compliant: some hundredths of a millimetre


def test_each_is_listed_short_and_tested() -> None:
    page, tests = (EXAMPLES / "README.md").read_text(), Path(__file__).read_text()
    for program in [*EXAMPLES.glob("*.py"), *EXAMPLES.glob("*.ipynb")]:
        assert f"({program.name})" in page and f'"{program.name}"' in tests
        assert program.suffix == ".ipynb" or len(program.read_text().splitlines()) < LINES_MAX


def run_notebook(name: str, folder: Path = EXAMPLES) -> str:
    """Run a notebook in its own kernel, in a folder; return its output and the number of pictures."""
    notebook = nbformat.read(EXAMPLES / name, as_version=4)
    assert not [cell for cell in notebook.cells if cell.get("outputs")], "kept without outputs"
    with warnings.catch_warnings(action="ignore"):  # warnings of the Jupyter libraries
        place = {"metadata": {"path": str(folder)}}
        NotebookClient(notebook, timeout=500, kernel_name="python3", resources=place).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    pictures = sum("image/png" in output.get("data", {}) for output in outputs)
    return "".join(output.get("text", "") for output in outputs) + f"{pictures} pictures\n"


def test_press_and_plot(tmp_path: Path) -> None:
    out = run_example("press_and_plot.py", "press.png", cwd=tmp_path)
    # The damper of the coupling adds 2 mN, which is one tick of the drag; the drag starts and slips at a whole tick.
    assert number(r"slips after ([\d.]+) s", out) == pytest.approx(0.8, abs=0.003)
    assert (tmp_path / "press.png").read_bytes().startswith(PNG)


def test_friction_sweep() -> None:
    out = run_notebook("friction_sweep.ipynb")
    assert number(r"difference ([\d.]+) um", out) <= 2.0 and number(r"(\d+) pictures", out) == 2


def test_stiffness_staircase() -> None:
    out = run_notebook("stiffness_staircase.ipynb")
    threshold, expected = number(r"threshold ([\d.]+)%", out), number(r"observer's is ([\d.]+)%", out)
    # 99 of 100 staircases of 36 reversals end between half and 1.65 of it (2000 drawn without the engine).
    assert 0.5 < threshold / expected < 1.65
    assert number(r"(\d+) pictures", out) == 1


def table_row(out: str, row: str) -> dict[str, float]:
    """The numbers of a row of the table that the notebook prints, by the name of their column."""
    head, *lines = out.splitlines()
    line = next(line for line in lines if line.split()[:1] == [row])  # a table of the answers may follow
    return dict(zip(head.split(), map(float, line.split()[1:]), strict=True))


@pytest.mark.exhaustive
def test_an_experiment_s_folder_with_pandas_and_scipy(tmp_path: Path) -> None:
    Experiment("curvature-by-rolling").run(tmp_path, 1, RunOptions(dry_run=True, no_daemon=True))
    out = run_notebook("analyse_experiment.ipynb", tmp_path)
    for group in fit_groups(*load(tmp_path)):
        row, fit = table_row(out, group.condition), group.fit
        assert isinstance(fit, Fit) and row["trials"] == group.trials
        # A step of a slope is 8 % there (40 from 0.5 to 12) and 2.6 % here (120 of them); of a threshold 2.3 % and 6 %
        # (300 and 120 from a quarter of the least level to four times the largest). Both interpolate between steps.
        assert row["threshold"] == pytest.approx(fit.threshold, rel=0.04)
        assert row["slope"] == pytest.approx(fit.slope, rel=0.08)
        low, high = fit.threshold_95
        assert (row["threshold_low"], row["threshold_high"]) == pytest.approx((low, high), rel=0.06)
    assert number(r"(\d+) pictures", out) == 1


@pytest.mark.exhaustive
def test_the_notebook_shows_exponents_and_answers(tmp_path: Path) -> None:
    Experiment("friction-magnitude").run(tmp_path, 1, RunOptions(dry_run=True, no_daemon=True))
    rows = list(csv.DictReader((tmp_path / "trials.csv").read_text().splitlines()))
    forces = [2.0 + 0.01 * place for place in range(len(rows))]
    write_csv(tmp_path / "trials.csv", [row | {"peak_force_n": force} for row, force in zip(rows, forces, strict=True)])
    tick = {"timestamp": 0.0, "x_m": 0.0, "z_m": 0.0, "fx_n": 0.0, "fy_n": 0.0, "fz_n": 1.0}
    counted = [number for number, row in enumerate(rows) if row["practice"] == "False"]
    trial = tmp_path / "sub-01" / "trials" / f"sub-01_trial-{counted[0] + 1:04d}.csv"
    write_csv(trial, [tick, tick | {"timestamp": 0.1}])
    out = run_notebook("analyse_experiment.ipynb", tmp_path)
    (group,) = fit_groups(*load(tmp_path))
    row = table_row(out, "all")
    assert row["exponent"] == pytest.approx(group.fit.exponent, abs=6e-5)  # four digits are printed
    assert (row["exponent_low"], row["exponent_high"]) == pytest.approx(group.fit.exponent_95, abs=6e-5)
    mean = sum(forces[place] for place in counted) / len(counted)
    assert float(out.splitlines()[-2].split()[1]) == pytest.approx(mean, abs=6e-5)
    assert number(r"(\d+) pictures", out) == 3


@pytest.mark.real_time
def test_change_a_parameter(tmp_path: Path, endpoints: tuple[str, str]) -> None:
    out = run_example("change_a_parameter.py", *endpoints, cwd=tmp_path)
    assert "1000 -> 500; largest normal force 1.00 N -> 0.50 N" in out


@pytest.mark.real_time
def test_draw_live(tmp_path: Path, endpoints: tuple[str, str]) -> None:
    assert number(r"(\d+) ticks drawn", run_example("draw_live.py", "live.png", endpoints[0], cwd=tmp_path)) > 0
    assert (tmp_path / "live.png").read_bytes().startswith(PNG)


@pytest.mark.real_time
@pytest.mark.exhaustive  # 8 s; `make test` runs the numba driver on a daemon, and this one without
def test_my_driver_python(tmp_path: Path) -> None:
    out = run_example("my_driver_python.py", "1300", cwd=tmp_path)
    alone, busy = out.splitlines()
    assert alone.startswith("1300 ticks alone") and busy.startswith("1300 ticks with a busy thread")
    # The ramp is over after half a second, so the second press has it all. One tick more or less is far below a digit.
    assert number(r"largest force ([\d.]+) N", alone) == pytest.approx(0.75, abs=0.01)


def test_an_exception_in_a_python_driver_ends_the_run() -> None:
    sys.path.insert(0, str(EXAMPLES))
    try:
        driver = importlib.import_module("my_driver_python")
    finally:
        sys.path.remove(str(EXAMPLES))

    class Broken(driver.MyDevice):
        def read(self, sample: object) -> int:
            raise ZeroDivisionError

    with Broken(driver.Options(), 1000.0) as device:
        assert DeviceCaller(device).read()[0] == PROTOCOL


@pytest.mark.real_time
def test_my_driver_numba(tmp_path: Path) -> None:
    run_example("my_driver_numba.py", cwd=tmp_path)


PROGRAMS = Path(__file__).resolve().parents[1] / "examples" / "subscribe"
CHANGES = 3


def python(_: Path) -> list[str]:
    return [sys.executable, str(PROGRAMS / "subscribe.py")]


def cpp(folder: Path) -> list[str]:
    compiler = shutil.which("g++")
    includes = b"#include <zmq.hpp>\n#include <msgpack.hpp>\n"
    look = [compiler or "false", "-std=c++17", "-DMSGPACK_NO_BOOST", "-E", "-x", "c++", "-", "-o", "/dev/null"]
    if subprocess.run(look, input=includes, capture_output=True, timeout=60).returncode != 0:
        pytest.skip("no g++, or not the headers of cppzmq and msgpack: make subscribers")
    source = PROGRAMS / "subscribe.cpp"
    (line,) = re.findall(r"^//     (g\+\+ .*)$", source.read_text(), re.MULTILINE)
    words = [str(source) if word.endswith("subscribe.cpp") else word for word in line.split()]
    subprocess.run([*words, "-Wall", "-Wextra", "-Werror"], cwd=folder, check=True, timeout=300)
    return [str(folder / "subscribe")]


def javascript(_: Path) -> list[str]:
    node = shutil.which("node")
    if node is None or not (PROGRAMS / "node_modules").is_dir():
        pytest.skip("Node.js or its packages are not installed: run `make subscribers`")
    return [node, str(PROGRAMS / "subscribe.mjs")]


def octave(_: Path) -> list[str]:
    program = shutil.which("octave-cli")
    look = [program or "false", "--eval", "pkg load zeromq"]
    if subprocess.run(look, capture_output=True, timeout=60).returncode != 0:
        pytest.skip("no Octave, or not its package zeromq: apt install octave octave-zeromq")
    return [str(program), str(PROGRAMS / "subscribe_octave.m")]


@pytest.mark.sampled(2)
@pytest.mark.real_time
@pytest.mark.parametrize("make", [python, cpp, javascript, octave])
def test_a_program_prints_published_ticks(make, tmp_path: Path, endpoints: tuple[str, str]) -> None:
    command = [*make(tmp_path), endpoints[0], *(["--changes"] if make is python else []), str(CHANGES)]
    apart = 5 if make is octave else 1  # it reads every state, at 200 Hz; the other programs read every tick
    with subscribe(endpoints[0], timeout_s=60.0) as samples:
        published = [next(samples)]
        with repeated(lambda: published.append(next(samples)), every_s=0.0):
            process = run_program(command)
    assert process.returncode == 0, process.stderr
    lines = [line.split() for line in process.stdout.splitlines()]
    ticks = {sample.tick: sample for sample in published}
    assert len(lines) == CHANGES and "-0.000" not in process.stdout
    for at, (tick, mode, *force) in enumerate(lines):
        sample = ticks[int(tick)]
        assert MODE_NAMES[sample.contact.mode] == mode
        assert list(sample.force) == pytest.approx([float(word) for word in force], abs=1e-3)  # three decimals
        assert at == 0 or MODE_NAMES[ticks[int(tick) - apart].contact.mode] != mode


def test_every_program_is_on_the_page() -> None:
    page = (PROGRAMS.parents[1] / "docs" / "operate" / "subscribe.md").read_text()
    own = (PROGRAMS / "README.md").read_text()
    for program in PROGRAMS.glob("subscribe*.*"):
        assert f"/{program.name})" in page and f"({program.name})" in own
    assert "**It has not been run**" in page
