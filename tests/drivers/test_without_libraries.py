"""Machines without libusb, or without what hidapi needs: one clear error in place of a traceback.

The libraries are truly out of the loader's reach, in the process of the command itself; nothing of pyusb's is replaced.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.drd_stub import COMPILER, stub_library

__all__ = ["stub_library"]  # fixture

COMMAND = [sys.executable, "-m", "softfinger.server.cli"]
NAMESPACE = ["unshare", "--user", "--map-root-user", "--mount"]
MAY_MOUNT = (
    shutil.which("unshare") is not None
    and subprocess.run([*NAMESPACE, "true"], capture_output=True, check=False).returncode == 0
)
mounts = pytest.mark.skipif(not MAY_MOUNT, reason="this system gives no name space of mounts (unshare)")


def hidden(*paths: Path | str) -> list[str]:
    """A command in front of another, for which these files are empty."""
    script = "".join(f"mount --bind /dev/null '{path}' && " for path in paths) + 'exec "$@"'
    return [*NAMESPACE, "sh", "-c", script, "sh"]


def loads_libusb(front: list[str], environ: dict[str, str]) -> bool:
    code = "import usb.backend.libusb1 as one; print(one.get_backend() is not None)"
    said = subprocess.run(
        [*front, sys.executable, "-c", code], env=environ, capture_output=True, text=True, timeout=60, check=True
    )
    return "True" in said.stdout


@pytest.fixture(params=["broken", pytest.param("absent", marks=mounts)])
def bare(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[list[str], dict[str, str]]:
    """A command in front and an environment in which libusb cannot be loaded, or is nowhere to be found."""
    if request.param == "broken":
        (tmp_path / "libusb-1.0.so.0").touch()
        front, environ = [], os.environ | {"LD_LIBRARY_PATH": str(tmp_path)}
    else:
        # find_library asks the loader's cache, then a compiler and a linker, which are on the path
        front, environ = [*hidden("/etc/ld.so.cache"), "env", "PATH=/nonexistent"], dict(os.environ)
    assert not loads_libusb(front, environ), "libusb is still there"
    return front, environ


def said_by(bare: tuple[list[str], dict[str, str]], *words: str) -> tuple[int, str]:
    front, environ = bare
    done = subprocess.run(
        [*front, *COMMAND, *words], env=environ, capture_output=True, text=True, timeout=300, check=False
    )
    assert "Traceback" not in done.stderr + done.stdout
    return done.returncode, done.stdout + done.stderr


@pytest.mark.parametrize(
    ("rig", "words"),
    [
        ("falcon", "libusb is not installed or cannot be loaded.*apt install libusb"),
        ("omega-6", "libdrd is not on this machine"),
        ("woodenhaptics-2019", "no HID device 16c0:0486"),
        ("woodenhaptics-v3", "no serial port 16c0:0483"),
        ("spacemouse", "no SpaceMouse"),
    ],
)
def test_run_says_in_one_error_what_is_missing(
    rig: str, words: str, bare: tuple[list[str], dict[str, str]], tmp_path: Path
) -> None:
    """Each rig of a device ends with one line, exit code not 0."""
    code, said = said_by(bare, "run", "--rig", rig, "--duration", "1", "--endpoint", f"ipc://{tmp_path}/t")
    assert code != 0
    assert re.search(words, said), said
    assert len(said.strip().splitlines()) == 1, said


@pytest.mark.skipif(COMPILER is None, reason="the stand-in for the maker's library is C, and there is no compiler")
def test_makers_library_that_sees_no_device(
    bare: tuple[list[str], dict[str, str]], stub_library: Path, tmp_path: Path
) -> None:
    """With the maker's library there and no device: not found, though USB cannot be asked why."""
    rig = tmp_path / "rig.toml"
    rig.write_text(f'[device]\ndriver = "forcedimension"\nlibrary_file = "{stub_library}"\n')
    front, environ = bare
    code, said = said_by((front, environ | {"STUB_DRD_SET": "devices=0"}), "run", "--rig", str(rig))
    assert code != 0, said
    assert said.strip().splitlines()[-1].startswith("softfinger: no device of Force Dimension is attached"), said


@pytest.mark.parametrize("words", [("devices", "--ask"), ("doctor",)])
def test_diagnosis_needs_no_libusb(words: tuple[str, ...], bare: tuple[list[str], dict[str, str]]) -> None:
    """What is attached is told as far as it can be seen, and the doctor says that libusb is missing."""
    code, said = said_by(bare, *words)
    if words == ("doctor",):
        assert re.search(r"libusb: not found", said), said
    else:
        assert code == 0, said


@mounts
@pytest.mark.parametrize("words", [("run", "--rig", "woodenhaptics-2019", "--duration", "1"), ("devices",)])
def test_hidapi_without_its_libraries(words: tuple[str, ...]) -> None:
    """hidapi brings libraries of its own; where they are broken the error says what to install."""
    import hidraw

    bundled = list((Path(hidraw.__file__).parent / "hidapi.libs").glob("lib*"))
    if not bundled:
        pytest.skip("this hidapi brings no libraries of its own")
    code, said = said_by((hidden(*bundled), dict(os.environ)), *words)
    if words[0] == "run":
        assert code != 0 and "hidapi cannot be loaded" in said and len(said.strip().splitlines()) == 1, said
    else:
        assert code == 0, said
