"""Device reports contain no personal data, and answer the questions of the form."""

import platform
import sys
from pathlib import Path
from typing import Final

import pytest
from helpers.forgotten import forget_user

from softfinger.config.load import load_rig
from softfinger.drivers import registry
from softfinger.tools.doctor import privacy, report
from softfinger.tools.doctor.questions import ANSWERS, answer_questions, load_questions

pytestmark = pytest.mark.plain

USER: Final = "zaphodb"


@pytest.fixture
def somebody(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> privacy.Redactor:
    monkeypatch.setenv("HOME", f"/home/{USER}")
    monkeypatch.setenv("USER", USER)
    (tmp_path / "My Project").mkdir()
    monkeypatch.chdir(tmp_path / "My Project")
    return privacy.Redactor(["SN-4711-A"])


@pytest.mark.parametrize(
    ("text", "clean"),
    [
        (f"/home/{USER}/lib/x.so", "x.so"),
        (f"/home/{USER}", "~"),
        (f"/media/{USER}/disk", "..."),
        (f"/home/{USER}/Project-X/scene.toml: no such file", "scene.toml: no such file"),
        ("~/Project-X/scene.toml, ~/Project-X", "scene.toml, ..."),
        ("Project-X/part/scene.toml:12", "scene.toml:12"),
        ("../Project-X/scene.toml", "scene.toml"),
        ("no file '/srv/Project X/scene.toml'", "no file 'scene.toml'"),
        ("PATH=/srv/Project-X/bin:/usr/bin", "PATH=...:/usr/bin"),
        ("ipc:///srv/Project-X/commands", "ipc://..."),
        ("/run/media/me/Project-X/a.csv", "a.csv"),
        (f"sudo setcap x {sys.prefix}/bin/python", "sudo setcap x <environment>/bin/python"),
        (f"{Path(privacy.__file__).parent}/privacy.py", "softfinger/tools/doctor/privacy.py"),
        ("tcp://127.0.0.1:5555, https://example.org/a/b.zip", "tcp://127.0.0.1:5555, https://example.org/a/b.zip"),
        ("docs/operate/docker.md, 3 N/m, 1/s.", "docs/operate/docker.md, 3 N/m, 1/s."),
        ("/sys/class/x.y, /dev/hidraw0", "/sys/class/x.y, /dev/hidraw0"),
        (f"held by {USER}", "held by <user>"),
        (f"{USER}x is another word", f"{USER}x is another word"),
        ("omega.3, serial 1234", "omega.3, serial ...34"),
        ("no HID device has the serial number 'SN42'", "no HID device has the serial number '...42'"),
        ("attached is SN-4711-A here", "attached is ...-A here"),
        ("/dev/serial/by-id/usb-PJRC_Teensy_123456-if00", "/dev/serial/by-id/..."),
        ("a serial line at 115200", "a serial line at 115200"),
        ("serial 16c0:0483 at /dev/pts/0", "serial 16c0:0483 at /dev/pts/0"),
    ],
)
def test_identifying_words_are_removed(text: str, clean: str, somebody: privacy.Redactor) -> None:
    assert somebody.text(text) == clean


def test_all_of_a_report_is_cleaned_but_the_words_of_the_program(somebody: privacy.Redactor) -> None:
    dirty = {"driver": USER, "a": [USER, {"b": f"on {platform.node()}"}], USER: 1.5, "none": None}
    assert somebody.clean(dirty) == {"driver": USER, "a": ["<user>", {"b": "on <host>"}], USER: 1.5, "none": None}


def test_options_contain_no_folder() -> None:
    options = {"firmware": "/srv/lab/x.bin", "serial": 123456, "path": "/dev/hidraw0", "hand": {"recording": "a/b.csv"}}
    want = {"firmware": "x.bin", "serial": "...56", "path": "/dev/hidraw0", "hand": {"recording": "b.csv"}}
    assert privacy.redact_options(options) == want


def test_a_working_folder_with_a_space_is_removed(somebody: privacy.Redactor) -> None:
    assert somebody.text(f"{Path.cwd()}/part/x.toml: fault; {Path.cwd()} is full") == "x.toml: fault; . is full"


def test_scenes_and_rigs_contain_no_folder(somebody: privacy.Redactor) -> None:
    dirty = {"object": [{"file": "My Project/a.obj"}], "world": {"model": "Project-X/m"}, "directory": "Project-X"}
    want = {"object": [{"file": "a.obj"}], "world": {"model": "m"}, "directory": "..."}
    assert somebody.clean(dirty) == want and somebody.clean({"directory": "."}) == {"directory": "."}


def test_a_user_without_a_home_is_no_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    forget_user(monkeypatch)
    assert privacy.Redactor().text("~ and /srv/x/y.toml") == "~ and y.toml"


def test_the_questions_are_well_formed() -> None:
    ids = [question.id for question in load_questions()]
    assert len(set(ids)) == len(ids)
    drivers = {driver for question in load_questions() for driver in question.drivers}
    assert drivers <= set(registry.list_names()) and not drivers & {"replay", "simulated"}
    assert ANSWERS.keys() <= set(ids)


def test_measurements_answer_their_questions() -> None:
    empty, _ = report.start_report(load_rig("falcon"), guided=False)
    assert not any(row["measured"] for row in answer_questions(empty))
    full = empty | {
        "moves": [{"asked": "move it up", "kind": "translation", "seen": "+z"}],
        "pushes": [{"axis": "+x", "seen": "-x"}],
        "buttons": {"masks": [0, 4]},
    }
    answers = {row["id"]: row["answer"] for row in answer_questions(full) if row["measured"]}
    assert answers == {
        "frame": "move it up: +z", "force-sign": "force along +x: -x", "buttons": "masks 0, 4 were seen"
    }  # fmt: skip
