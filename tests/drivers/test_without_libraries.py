"""Machines whose loader cannot find libusb or the libraries of hidapi: one clear error instead of a traceback."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import libusb_package
import pytest
from helpers.c_stub import COMPILER
from helpers.drd_stub import stub_library
from helpers.programs import run_program

from softfinger.drivers.system.libusb import SONAME

__all__ = ["stub_library"]  # fixture

COMMAND = [sys.executable, "-m", "softfinger.server.cli"]
NAMESPACE = ["unshare", "--user", "--map-root-user", "--mount"]
MAY_MOUNT = (
    shutil.which("unshare") is not None
    and subprocess.run([*NAMESPACE, "true"], capture_output=True, check=False).returncode == 0
)
mounts = pytest.mark.skipif(not MAY_MOUNT, reason="this system gives no name space of mounts (unshare)")

NEITHER = "libusb, which is .* not installed or cannot be loaded.*pip install.* libusb-package, or apt install libusb"

LOADED = """
from softfinger.drivers.system import libusb
print(libusb.load_backend() is not None)
print(*{line.strip().split(None, 5)[5] for line in open("/proc/self/maps") if "libusb" in line})
"""
"""Program that prints if pyusb has a libusb, and which files of that name it has loaded."""


def hide_files(*paths: Path | str) -> list[str]:
    script = "".join(f"mount --bind /dev/null '{path}' && " for path in paths) + 'exec "$@"'
    return [*NAMESPACE, "sh", "-c", script, "sh"]


def environment(folder: Path, *, system: str, package: bool) -> dict[str, str]:
    """Return the environment of a process with the system's libusb "there", "broken" or "as it is", and with the
    package or without.

    folder  for the files that it needs
    """
    environ = dict(os.environ)
    if system != "as it is":
        library = folder / SONAME
        if system == "there":
            shutil.copy(str(libusb_package.get_library_path()), library)
        else:
            library.touch()
        environ["LD_LIBRARY_PATH"] = str(folder)
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


@pytest.mark.parametrize("package", [True, False], ids=["package", "no package"])
def test_the_systems_libusb_is_preferred(package: bool, tmp_path: Path) -> None:
    environ = environment(tmp_path, system="there", package=package)
    assert loaded(environ) == (True, str((tmp_path / SONAME).resolve()))


def test_the_packages_libusb_is_the_fallback(tmp_path: Path) -> None:
    environ = environment(tmp_path, system="broken", package=True)
    assert loaded(environ) == (True, str(Path(str(libusb_package.get_library_path())).resolve()))
    code, output = run_softfinger(([], environ), "run", "--rig", "falcon", *endpoints(tmp_path))
    assert code != 0 and "libusb, which is needed for USB devices, is not installed" not in output, output
    assert re.search(r"no Falcon|USB devices cannot be listed", output), output


@pytest.fixture
def bare(tmp_path: Path) -> tuple[list[str], dict[str, str]]:
    environ = environment(tmp_path, system="broken", package=False)
    assert loaded(environ) == (False, ""), "libusb is still there"
    return [], environ


def endpoints(folder: Path) -> list[str]:
    return ["--endpoint", f"ipc://{folder}/t", "--commands", f"ipc://{folder}/c"]


def run_softfinger(bare: tuple[list[str], dict[str, str]], *words: str) -> tuple[int, str]:
    front, environ = bare
    process = run_program([*front, *COMMAND, *words, "--quiet"], env=environ)
    assert "Traceback" not in process.stderr + process.stdout
    return process.returncode, process.stdout + process.stderr


MISSING = {
    "falcon": NEITHER,
    "omega-6": "libdrd was not found",
    "touch": "libHD was not found",
    "woodenhaptics-2019": "no HID device 16c0:0486",
    "woodenhaptics-v3": "no serial port 16c0:0483",
    "haply-inverse3": "no Inverse Service on port 10001",
    "spacemouse": "no SpaceMouse",
}
"""Error of `run` by rig, on a machine without libraries and devices."""

RUN_EACH = """
import contextlib, io, json, sys
from softfinger.server.cli import main
endpoints, *rigs = sys.argv[1:]
for rig in rigs:
    with contextlib.redirect_stderr(io.StringIO()) as said:
        code = main(["run", "--quiet", "--rig", rig, "--duration", "1", *endpoints.split()])
    print(json.dumps([rig, code, said.getvalue()]))
"""


def test_run_names_the_missing_part_in_one_error(bare: tuple[list[str], dict[str, str]], tmp_path: Path) -> None:
    front, environ = bare
    command = [*front, sys.executable, "-c", RUN_EACH, " ".join(endpoints(tmp_path)), *MISSING]
    process = run_program(command, env=environ, check=True)
    ended = [json.loads(line) for line in process.stdout.splitlines()]
    assert [rig for rig, _, _ in ended] == list(MISSING)
    for rig, code, output in ended:
        assert code != 0 and "Traceback" not in output, output
        assert re.search(MISSING[rig], output), output
        assert len(output.strip().splitlines()) == 1, output


def test_no_libusb_at_all(tmp_path: Path) -> None:
    environ = environment(tmp_path, system="as it is", package=False)
    if loaded(environ)[0]:
        pytest.skip("libusb is installed; the test needs a system without it")
    code, output = run_softfinger(([], environ), "run", "--rig", "falcon", *endpoints(tmp_path))
    assert code != 0
    assert re.search(NEITHER, output) and len(output.strip().splitlines()) == 1, output


@pytest.mark.skipif(COMPILER is None, reason="the stub for the maker's library is C, and there is no compiler")
def test_makers_library_without_a_device(
    bare: tuple[list[str], dict[str, str]], stub_library: Path, tmp_path: Path
) -> None:
    """With the maker's library but no device the error is that none is attached, though USB cannot be listed."""
    rig = tmp_path / "rig.toml"
    rig.write_text(f'[device]\ndriver = "forcedimension"\nlibrary_file = "{stub_library}"\n')
    front, environ = bare
    words = ("run", "--rig", str(rig), *endpoints(tmp_path))
    code, output = run_softfinger((front, environ | {"STUB_DRD_SET": "devices=0"}), *words)
    assert code != 0, output
    assert output.strip().splitlines()[-1].startswith("softfinger: no device of Force Dimension is attached"), output


@pytest.mark.sampled(1)
@pytest.mark.parametrize("words", [("devices", "--ask"), ("doctor", "--seconds", "0.1")])
def test_diagnosis_needs_no_libusb(words: tuple[str, ...], bare: tuple[list[str], dict[str, str]]) -> None:
    code, output = run_softfinger(bare, *words)
    if words[0] == "doctor":
        assert re.search(r"libusb: not found", output), output
    else:
        assert code == 0, output


@pytest.mark.sampled(1)
@mounts
@pytest.mark.parametrize("words", [("run", "--rig", "woodenhaptics-2019", "--duration", "1"), ("devices",)])
def test_hidapi_without_its_libraries(words: tuple[str, ...], tmp_path: Path) -> None:
    import hidraw

    bundled = list((Path(hidraw.__file__).parent / "hidapi.libs").glob("lib*"))
    if not bundled:
        pytest.skip("this hidapi brings no libraries of its own")
    own = endpoints(tmp_path) if words[0] == "run" else []
    code, output = run_softfinger((hide_files(*bundled), dict(os.environ)), *words, *own)
    if words[0] == "run":
        # Without root the files are hidden in a namespace that contains no files of root, so cached kernels cause
        # warnings.
        (error,) = [line for line in output.splitlines() if line.startswith("softfinger: ")]
        assert code != 0 and "hidapi cannot be loaded" in error and output.endswith(f"{error}\n"), output
    else:
        assert code == 0, output
