"""Machines on which the loader cannot find libusb: one clear error instead of a traceback."""

import json
import os
import re
import shutil
import sys
from pathlib import Path

import libusb_package
import pytest
from helpers.programs import run_program

from softfinger.drivers.system.libusb import SONAME

COMMAND = [sys.executable, "-m", "softfinger.server.cli"]
ENDPOINTS = ["--endpoint", "tcp://127.0.0.1:*", "--commands", "tcp://127.0.0.1:*"]
NEITHER = "libusb, which is .* not installed or cannot be loaded.*pip install.* libusb-package, or apt install libusb"

LOADED = """
from softfinger.drivers.system import libusb
print(libusb.load_backend() is not None)
print(*{line.strip().split(None, 5)[5] for line in open("/proc/self/maps") if "libusb" in line})
"""
"""Program that prints if pyusb has a libusb, and which files of that name it has loaded."""


def environment(folder: Path, *, system: bool, package: bool) -> dict[str, str]:
    """Return the environment of a process with or without the system's libusb, which is then a broken file, and the
    package, with files in `folder`."""
    environ = dict(os.environ) | {"LD_LIBRARY_PATH": str(folder)}
    if system:
        shutil.copy(str(libusb_package.get_library_path()), folder / SONAME)
    else:
        (folder / SONAME).touch()
    if not package:
        missing = folder / "missing"
        missing.mkdir()
        (missing / "libusb_package.py").write_text("raise ImportError('not installed')")
        environ["PYTHONPATH"] = os.pathsep.join(filter(None, (str(missing), environ.get("PYTHONPATH"))))
    return environ


def loaded(environ: dict[str, str]) -> tuple[bool, str]:
    process = run_program([sys.executable, "-c", LOADED], env=environ, check=True)
    is_loaded, files = process.stdout.split("\n")[:2]
    return is_loaded == "True", files


def run_softfinger(environ: dict[str, str], *words: str) -> tuple[int, str]:
    process = run_program([*COMMAND, *words, "--quiet"], env=environ)
    assert "Traceback" not in process.stderr + process.stdout
    return process.returncode, process.stdout + process.stderr


@pytest.mark.parametrize("package", [True, False], ids=["package", "no package"])
def test_the_systems_libusb_is_preferred(package: bool, tmp_path: Path) -> None:
    environ = environment(tmp_path, system=True, package=package)
    assert loaded(environ) == (True, str((tmp_path / SONAME).resolve()))


def test_the_packages_libusb_is_the_fallback(tmp_path: Path) -> None:
    environ = environment(tmp_path, system=False, package=True)
    assert loaded(environ) == (True, str(Path(str(libusb_package.get_library_path())).resolve()))
    code, output = run_softfinger(environ, "run", "--rig", "falcon", *ENDPOINTS)
    assert code != 0 and "libusb, which is needed for USB devices, is not installed" not in output, output
    assert re.search(r"no Falcon|USB devices cannot be listed", output), output


@pytest.fixture
def bare(tmp_path: Path) -> dict[str, str]:
    environ = environment(tmp_path, system=False, package=False)
    assert loaded(environ) == (False, ""), "libusb is still there"
    return environ


MISSING = {
    "falcon": NEITHER,
    "omega-6": "libdrd was not found",
    "touch": "libHD was not found",
    "woodenhaptics-2019": "no HID device 16c0:0486 is attached: plug it in",
    "woodenhaptics-v3": "no serial port 16c0:0483",
    "haply-inverse3": "no Inverse Service on port 10001",
    "spacemouse": "no SpaceMouse",
}
"""Error of `run` by rig, on a machine without libraries and devices."""

RUN_EACH = """
import contextlib, io, json, sys
from softfinger.server.cli import main
for rig in sys.argv[5:]:
    with contextlib.redirect_stderr(io.StringIO()) as said:
        code = main(["run", "--quiet", "--rig", rig, "--duration", "1", *sys.argv[1:5]])
    print(json.dumps([rig, code, said.getvalue()]))
"""


def test_run_names_the_missing_part_in_one_error(bare: dict[str, str]) -> None:
    process = run_program([sys.executable, "-c", RUN_EACH, *ENDPOINTS, *MISSING], env=bare, check=True)
    ended = [json.loads(line) for line in process.stdout.splitlines()]
    assert [rig for rig, _, _ in ended] == list(MISSING)
    for rig, code, output in ended:
        assert code != 0 and "Traceback" not in output, output
        assert re.search(MISSING[rig], output), output
        assert len(output.strip().splitlines()) == 1, output


@pytest.mark.sampled(1)
@pytest.mark.parametrize("words", [("devices", "--ask"), ("doctor", "--seconds", "0.1")])
def test_diagnosis_needs_no_libusb(words: tuple[str, ...], bare: dict[str, str]) -> None:
    code, output = run_softfinger(bare, *words)
    if words[0] == "doctor":
        assert re.search(r"libusb: not found", output), output
    else:
        assert code == 0, output
