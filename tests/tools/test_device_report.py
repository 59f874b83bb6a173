"""`doctor --device-report`: contents of a report, omitted data, and its endings."""

import json
import os
import platform
import pty
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
from helpers.drd_stub import stub_library  # noqa: F401  a fixture
from helpers.programs import run_program
from helpers.rig_files import write_rig
from test_hid_emulated import WHY_NOT, run_beside_device

from softfinger.config.errors import ConfigError, DeviceNotFound
from softfinger.config.load import load_rig
from softfinger.drivers.spacemouse import device as spacemouse
from softfinger.proxy.kernels.jit.decorators import CACHE_DIR
from softfinger.server.cli import main
from softfinger.tools.doctor import report
from softfinger.tools.doctor.questions import load_questions

pytestmark = pytest.mark.real_time

ROOT = Path(__file__).resolve().parents[2]
COMMAND = (sys.executable, "-m", "softfinger.server.cli", "doctor")
USER: Final = "zaphodb"
KEYS: Final = {
    "report", "complete", "ended", "softfinger", "system", "driver", "options", "rate_hz", "guided", "freedom",
    "identity", "maker_library", "device", "realtime", "rest", "exchange", "without_pauses", "range", "moves",
    "buttons", "pushes", "counts", "reason", "fault", "questions",
}  # fmt: skip
RATE_HZ: Final = 1000.0

Here = Callable[..., str]


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Home and working folder of a user."""
    folder = tmp_path / USER
    folder.mkdir()
    variables = {"HOME": folder, "USER": USER, "LOGNAME": USER, "SOFTFINGER_CACHE_DIR": CACHE_DIR.parent}
    for name, value in variables.items():
        monkeypatch.setenv(name, str(value))
    monkeypatch.chdir(folder)
    return folder


def run(*words: str) -> subprocess.CompletedProcess[str]:
    return run_program([*COMMAND, "--device-report", *words], stdin=subprocess.DEVNULL)


@pytest.fixture
def here(home: Path, capsys: pytest.CaptureFixture[str]) -> Here:
    def report_of(*words: str) -> str:
        assert main(["doctor", "--device-report", *words]) == 0
        return capsys.readouterr().out

    return report_of


def checked(file: Path, home: Path) -> dict[str, Any]:
    text = file.read_text(encoding="utf-8")
    content: dict[str, Any] = json.loads(text)
    assert content.keys() == KEYS
    assert str(home) not in text and USER not in text
    assert not re.search(rf"(?<![A-Za-z0-9]){re.escape(platform.node())}(?![A-Za-z0-9])", text)
    assert not re.search(r"/home/|/root\b", text)
    assert {row["id"] for row in content["questions"]} == {
        question.id for question in load_questions() if content["driver"] in question.drivers
    }
    return content


def test_a_recording_is_reported(here: Here, home: Path) -> None:
    (home / "mine.csv").write_bytes((ROOT / "config" / "recordings" / "tap.csv").read_bytes())
    rig = home / "mine.toml"
    rig.write_text(f'[device]\ndriver = "replay"\nrecording = "{home}/mine.csv"\n')
    output = here("--rig", str(rig), "--seconds", "0.3")
    content = checked(home / "softfinger-replay-report.json", home)
    assert content["complete"] and content["ended"] == "in full" and content["fault"] is None
    assert content["options"]["recording"] == "mine.csv" and content["device"]["name"] == "replay mine"
    assert content["rest"]["ticks"] == 1000 and content["exchange"]["ticks"] == 300
    assert content["without_pauses"]["exchanges"] > 0
    assert content["counts"]["reads"] >= 1300 + content["without_pauses"]["exchanges"]
    assert content["moves"] == content["pushes"] == content["questions"] == content["identity"] == []
    assert {"system", "python", "packages", "checks"} == content["system"].keys()
    assert "attach it to an issue" in output and "noise along x, y, z" in output


def test_a_push_of_the_simulated_device_is_measured_along_its_axis(here: Here, home: Path) -> None:
    rig = home / "still.toml"
    rig.write_text('[device]\ndriver = "simulated"\nposition_m = [0.0, 0.0, 0.03]\n')
    words = ("--seconds", "1", "--with-force", "2", "--json", "--plot", "times.png")
    output = here("report.json", "--rig", str(rig), *words)
    content = checked(home / "report.json", home)
    assert json.loads(output) == content
    assert (home / "times.png").read_bytes().startswith(b"\x89PNG")
    assert [push["seen"] for push in content["pushes"]] == ["+x", "+y", "+z"]
    assert all(1.5 < push["largest_n"] <= 2.0 for push in content["pushes"])
    # 2 N displace a hand of 1000 N/m by 2 mm; at 3 Hz its mass overshoots slightly.
    ends = content["range"]["position_min_m"], content["range"]["position_max_m"]
    for low, high, at in zip(*ends, (0.0, 0.0, 0.03), strict=True):
        assert -0.003 < low - at < 0.0 < high - at < 0.003


def test_a_device_behind_the_makers_library_is_reported(home: Path, stub_library: Path) -> None:  # noqa: F811
    rig = write_rig(home, "omega-3", library_file=str(stub_library))
    result = run("--rig", str(rig), "--seconds", "0.3")
    assert result.returncode == 0, result.stderr
    content = checked(home / "softfinger-forcedimension-report.json", home)
    assert content["device"]["name"] == "omega.3, serial ...30"
    assert content["maker_library"] == [stub_library.name] and "/" not in content["options"]["library_file"]
    by_id = {row["id"]: row for row in content["questions"]}
    measured = {name for name, row in by_id.items() if row["measured"]}
    assert measured == {"exchange-time", "fd-library", "fd-force-on", "fd-held-back"}
    assert by_id["fd-held-back"]["answer"].startswith("0 of ")
    assert by_id["frame"]["answer"].startswith("not answered: run the report in a terminal")


@pytest.mark.sampled(1)
@pytest.mark.skipif(WHY_NOT is not None, reason=str(WHY_NOT))
@pytest.mark.parametrize("lost", [False, True], ids=["whole", "unplugged"])
def test_a_hid_device_is_reported(lost: bool, home: Path) -> None:
    file = home / "report.json"
    case = {"arm": "woody-2019", "generation": 2, "place": [0.0, 0.0, 0.01]} | ({"lost_after": 300} if lost else {})
    rig = write_rig(home, "woodenhaptics-2019")
    # the emulated device is a normal process and must not be delayed by the exchange's thread
    rig.write_text(rig.read_text().replace('realtime = "auto"', 'realtime = "off"'), encoding="utf-8")
    words = ("--device-report", str(file), "--rig", str(rig), "--seconds", "0.3")
    _, saw = run_beside_device(case, *COMMAND, *words, code=4 if lost else 0)
    content = checked(file, home)
    (arm,) = content["identity"]
    known = {"vendor_id": "16c0", "product_id": "0486", "node": "/dev/hidraw0", "serial": "...42"}
    assert arm | known == arm and arm["report_descriptor"].startswith("06abff")
    assert content["counts"]["written"] >= 300
    assert not any(saw["last"]), "the last report was no zero"
    answers = {row["id"]: row for row in content["questions"]}
    assert answers["hid-descriptor"]["answer"] == arm["report_descriptor"]
    assert answers["unplugged"]["measured"] is lost and content["complete"] is not lost
    if lost:
        assert content["fault"]["kind"] == "DeviceLost" and content["fault"]["in_use"]
        assert "is gone" in content["fault"]["message"]


def test_a_puck_is_not_pushed() -> None:
    rig = load_rig("spacemouse")
    near, far = socket.socketpair()
    puck = spacemouse.SpaceMouse(spacemouse.Options(led=False), near.detach(), RATE_HZ)
    with far, puck, pytest.raises(ConfigError, match="spacemouse puck displays no force"):
        report.limit_guard(rig, puck, 1.0)


@pytest.mark.usefixtures("home")
def test_nothing_is_compiled_before_the_device_is_open(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("softfinger.tools.exchange.exchange_loop", None)
    for words in (["doctor", "--device-report"], ["devices", "--probe"], ["bench", "device"]):
        assert main([*words, "--rig", "omega-3"]) == DeviceNotFound.exit_code


def test_a_device_that_cannot_be_opened_is_reported(home: Path) -> None:
    result = run("--rig", "omega-3", "--seconds", "0.3")
    assert result.returncode == 4 and "not answered" not in result.stdout
    content = checked(home / "softfinger-forcedimension-report.json", home)
    assert content["ended"] == "by a fault" and not content["complete"]
    assert content["fault"] == {"kind": "DeviceNotFound", "message": content["fault"]["message"], "in_use": False}
    assert "searched for libdrd.so*, /usr/local/lib/libdrd.so*" in content["fault"]["message"]
    assert content["device"] is None and content["exchange"] is None
    assert not any(row["measured"] for row in content["questions"])


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("number", "part"), [(signal.SIGINT, "the exchange"), (signal.SIGTERM, "a push along x")])
def test_an_interrupted_report_is_written(number: signal.Signals, part: str, home: Path) -> None:
    rig = home / "kept.toml"
    rig.write_text('[device]\ndriver = "replay"\nrecording = "tap"\nforces = "forces.npz"\n')
    process = subprocess.Popen(
        [*COMMAND, "--device-report", "--rig", str(rig), "--seconds", "2", "--with-force", "1"],
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    for line in process.stderr:
        if line.startswith(f"recording {part}"):  # printed half a second after the part started
            break
    process.send_signal(number)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 128 + number
    content = checked(home / "softfinger-replay-report.json", home)
    assert content["ended"] == "stopped by the user" and not content["complete"]
    assert content["rest"]["ticks"] == 1000 and (content["exchange"] is not None) == (number == signal.SIGTERM)
    assert content["pushes"] == []
    assert "stopped by the user" in output
    force = np.load(home / "forces.npz")["force"]
    assert force.any() == (number == signal.SIGTERM) and not force[-1].any()


def test_the_user_is_prompted_on_a_terminal(home: Path) -> None:
    rig = home / "still.toml"
    rig.write_text('[device]\ndriver = "simulated"\nposition_m = [0.0, 0.0, 0.03]\nsway_m = [0.02, 0.0, 0.0]\n')
    main, side = pty.openpty()
    process = subprocess.Popen(
        [*COMMAND, "--device-report", "--rig", str(rig), "--seconds", "0.2"],
        stdin=side, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    os.close(side)
    prompts = []
    for line in process.stderr:
        if line.endswith("; Enter to begin\n"):
            prompts.append(line)
            os.write(main, b"\n")
    output, _ = process.communicate(timeout=60)
    os.close(main)
    assert process.returncode == 0, output
    content = checked(home / "softfinger-simulated-report.json", home)
    assert content["guided"]
    assert len(prompts) == 6  # rest, three directions, a rotation, buttons
    assert [move["expected"] for move in content["moves"]] == ["+x", "+y", "+z", "+z"]
    assert all(move["agrees"] == (move["seen"] == move["expected"]) for move in content["moves"])
    assert content["moves"][3]["kind"] == "rotation" and content["moves"][3]["seen"] == "no motion"
    assert content["buttons"] == {"masks": [0]}


@pytest.mark.parametrize("option", ["--device-report", "--probe"])
def test_a_report_that_cannot_be_written_names_its_option(option: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=f"{option} .*cannot be written"):
        report.write(tmp_path / "missing" / "report.json", {}, option)
