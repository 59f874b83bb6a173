"""The programs of examples/subscribe print the published values."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.programs import run_program
from helpers.waits import repeated

from softfinger.server.wire.client import subscribe

PROGRAMS = Path(__file__).resolve().parents[1] / "examples" / "subscribe"
MODES = ("free", "rolling", "sliding")
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
        assert MODES[sample.contact.mode] == mode
        assert list(sample.force) == pytest.approx([float(word) for word in force], abs=1e-3)  # three decimals
        assert at == 0 or MODES[ticks[int(tick) - apart].contact.mode] != mode


def test_every_program_is_on_the_page() -> None:
    page = (PROGRAMS.parents[1] / "docs" / "operate" / "subscribe.md").read_text()
    own = (PROGRAMS / "README.md").read_text()
    for program in PROGRAMS.glob("subscribe*.*"):
        assert f"/{program.name})" in page and f"({program.name})" in own
    assert "**It has not been run**" in page
