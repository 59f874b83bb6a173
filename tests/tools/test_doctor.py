"""`doctor`: the checks on this machine and on tables of another one, its exit code, its errors; device reports:
contents, omitted data, endings."""

import fcntl
import json
import os
import platform
import pty
import re
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
import zmq
from helpers.drd_stub import stub_library  # noqa: F401  a fixture
from helpers.programs import run_program
from helpers.rig_files import write_rig
from helpers.shortages import without_rights
from test_hid_emulated import WHY_NOT, run_beside_device

from softfinger.config.errors import ConfigError, DeviceNotFound, Unfit
from softfinger.config.load import load_rig, load_scene
from softfinger.drivers.spacemouse import device as spacemouse
from softfinger.drivers.system.discovery import SystemDevice
from softfinger.proxy.kernels.jit.cache import Folder
from softfinger.proxy.kernels.jit.decorators import CACHE_DIR
from softfinger.server.cli import main
from softfinger.server.loop import realtime
from softfinger.tools.doctor import attached, loop, machine, report
from softfinger.tools.doctor.machine import STATES, Check, grade
from softfinger.tools.doctor.questions import load_questions

pytestmark = pytest.mark.real_time

COMMAND = (sys.executable, "-m", "softfinger.server.cli", "doctor")


def write(root: Path, **files: str) -> Path:
    for name, text in files.items():
        path = root / name.replace("__", "/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n")
    return root


def run(*words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return run_program([*COMMAND, *words], env={**os.environ, **environment})


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The verb on this machine, with an endpoint in use, so that one check is bad on every machine."""
    with zmq.Context() as context, context.socket(zmq.PUB) as socket:
        port = socket.bind_to_random_port("tcp://127.0.0.1")
        rig = tmp_path_factory.mktemp("rig") / "doctor.toml"
        rig.write_text(
            '[device]\ndriver = "replay"\nrecording = "tap"\n'
            f'[telemetry]\nendpoint = "tcp://127.0.0.1:{port}"\n[servo]\ncpu = {min(os.sched_getaffinity(0))}\n'
        )
        plot = rig.with_suffix(".png")
        process = run("--rig", str(rig), "--seconds", "0.3", "--json", "--plot", str(plot))
    content: dict[str, Any] = json.loads(process.stdout)
    assert plot.read_bytes().startswith(b"\x89PNG")
    return content | {"code": process.returncode, "stderr": process.stderr, "port": port}


@pytest.fixture
def open_folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir="/tmp") as name:
        Path(name).chmod(0o755)
        yield Path(name)


def test_every_check_is_made(result: dict[str, Any]) -> None:
    names = [check["name"] for check in result["checks"]]
    assert len(set(names)) == len(names)
    settings = ("timer_slack", "sched_fifo", "mlockall", "cpu_dma_latency", "affinity")
    real_time = {f"real time, {name}" for name in settings}
    machine_checks = {"Python", "packages", "system", "bare machine", "processors", "processor frequency", "clock"}
    measured = {"kernel cache", "ticks in time", "wake-up lateness", "contact step", "telemetry endpoint"}
    assert real_time | machine_checks | measured | {"libusb", "hidapi", "Force Dimension's library"} <= set(names)
    for check in result["checks"]:
        assert check.keys() == set(Check._fields) and check["state"] in STATES
        assert check["seen"] and check["wanted"] and (check["remedy"] or check["state"] == "good"), check


def test_an_endpoint_in_use_is_bad_and_decides_the_exit_code(result: dict[str, Any]) -> None:
    (check,) = (check for check in result["checks"] if check["name"] == "telemetry endpoint")
    assert check["state"] == "bad"
    assert str(result["port"]) in check["seen"] and "end the program that uses it" in check["remedy"]
    assert result["code"] == Unfit.exit_code
    bad = [check["name"] for check in result["checks"] if check["state"] == "bad"]
    assert all(name in result["stderr"] for name in bad) and result["states"]["bad"] == len(bad)
    assert "Traceback" not in result["stderr"]


@pytest.mark.parametrize(("mode", "state"), [("auto", "could be better"), ("require", "bad")])
def test_a_refused_setting_is_bad_where_the_rig_requires_it(mode: str, state: str) -> None:
    rig = load_rig("replay", {"servo.cpu": 1023, "servo.realtime": mode})
    (check,) = (check for check in loop.check_settings(rig) if check.name == "real time, affinity")
    assert check.state == state and "affinity" in realtime.REQUIRED
    assert "processor 1023" in check.seen and "servo.cpu" in check.remedy


@pytest.mark.parametrize(
    ("value", "state"), [(0.1, "good"), (0.11, "could be better"), (0.5, "could be better"), (0.51, "bad")]
)
def test_a_number_is_graded_by_its_thresholds(value: float, state: str) -> None:
    assert grade(value, 0.1, 0.5) == state


@pytest.mark.parametrize(
    ("missed", "p99", "states"),
    [(0, 50e-6, ("good", "good")), (5, 200e-6, ("could be better", "could be better")), (200, 600e-6, ("bad", "bad"))],
)
def test_the_loop_is_judged_against_the_period(missed: int, p99: float, states: tuple[str, str]) -> None:
    """The checks use the share of missed ticks and the p99 of the lateness at 1 kHz; a missing compiler is reported."""
    result = {"rate_hz": 1000.0, "servo": {"ticks": 10_000, "missed": missed, "late": {"p99": p99}}}
    checks = loop.judge_loop(result)
    assert tuple(check.state for check in checks) == states and "install gcc" in checks[1].seen
    if missed > 0:
        assert "isolcpus" in checks[0].remedy and "servo.cpu" in checks[1].remedy
    assert "the same loop in C 40 us" in loop.judge_loop(result | {"c": {"late": {"p99": 40e-6}}})[1].seen


def test_another_machine_is_read(tmp_path: Path) -> None:
    """A real-time kernel on a bare machine that does not save power is good; a guest of KVM in Docker is not."""
    good = write(
        tmp_path / "good", sys__kernel__realtime="1",
        sys__devices__system__cpu__cpu0__cpufreq__scaling_governor="performance",
        sys__devices__system__clocksource__clocksource0__current_clocksource="tsc", proc__cpuinfo="flags\t\t: fpu sse2",
        proc__1__cgroup="0::/init.scope",
    )  # fmt: skip
    for examine in (machine.check_kernel, machine.check_frequency, machine.check_clock, machine.check_virtual):
        assert examine(good).state == "good", examine
    worse = write(
        tmp_path / "worse", sys__kernel__realtime="0",
        sys__devices__system__cpu__cpu0__cpufreq__scaling_governor="powersave",
        sys__devices__system__clocksource__clocksource0__current_clocksource="hpet",
        proc__cpuinfo="processor : 0\nflags\t\t: fpu hypervisor sse2", proc__stat="cpu  60 0 20 10 0 0 0 10 0 0",
        proc__1__cgroup="12:devices:/docker/0123", sys__class__dmi__id__sys_vendor="QEMU",
        sys__devices__system__cpu__smt__active="1", sys__devices__system__cpu__isolated="3",
    )  # fmt: skip
    for check, remedy in (
        (machine.check_kernel(worse), "linux-image-rt"), (machine.check_clock(worse), "echo tsc"),
        (machine.check_frequency(worse), "cpupower frequency-set -g performance"),
        (machine.check_virtual(worse), "on the machine itself"),
        (machine.check_virtual(worse), "docs/operate/docker.md"),
    ):  # fmt: skip
        assert check.state == "could be better", check
        assert remedy in check.remedy
    details = machine.check_virtual(worse).seen
    assert "virtual machine (QEMU), 10.00% of its time taken by its host" in details and "container" in details
    assert "two threads to a core, isolated: 3" in machine.check_processors(worse).seen


def test_a_missing_package_is_bad(monkeypatch: pytest.MonkeyPatch) -> None:
    assert {"numpy", "numba", "pyzmq"} <= machine.list_versions().keys()
    assert not {"viser", "pytest"} & machine.list_versions().keys()
    required = ["numpy>=2.0", "no-such-package>=1", 'viser>=1.0; extra == "viewer"']
    monkeypatch.setattr(machine.metadata, "requires", lambda _: required)
    check = machine.check_packages()
    assert check.state == "bad" and check.remedy == "pip install no-such-package"
    assert "MISSING" in check.seen and "viser" not in check.seen


def test_the_rigs_own_device_decides(tmp_path: Path) -> None:
    puck = SystemDevice("hid", 0x046D, 0xC626, "Puck", "", str(tmp_path / "hidraw5"))
    (own,) = attached.check_devices(load_rig("spacemouse"), [puck])
    (attached_puck,) = attached.check_devices(load_rig("replay"), [puck])
    assert (own.state, attached_puck.state) == ("bad", "could be better") and "--device" in own.remedy
    (absent,) = attached.check_devices(load_rig("spacemouse"), [])
    assert (absent.name, absent.state) == ("device of the rig", "bad")
    (none,) = attached.check_devices(load_rig("replay"), [])
    assert none.state == "good"
    mine = SystemDevice("hid", 0x16C0, 0x0486, "Arm", "", str(tmp_path))
    assert attached.is_of(load_rig("woodenhaptics-2019").tables["device"], mine)
    assert not attached.is_of(load_rig("woodenhaptics-2015").tables["device"], mine)
    (ethernet,) = attached.check_devices(load_rig("touch"), [])
    assert ethernet.state == "could be better" and "Ethernet" in ethernet.seen


@pytest.mark.parametrize("rig", ["woodenhaptics-v3", "haply-2diy", "hapkit"])  # with the ids of any Teensy, or none
@pytest.mark.parametrize("on_usb", [True, False])
def test_the_path_of_a_rig_selects_its_port(rig: str, on_usb: bool, tmp_path: Path) -> None:
    """The path may be a link, as in /dev/serial/by-id, and the port need not be on USB."""
    boards = [SystemDevice("serial", 0x16C0, 0x0483, "thing", "", str(tmp_path / f"ttyACM{n}")) for n in range(2)]
    for board in boards:
        Path(board.node).touch()
    (tmp_path / "by-id").symlink_to(boards[1].node)
    for path, expected in ((boards[1].node, ["good"]), (tmp_path / "by-id", ["good"]), (tmp_path / "none", ["bad"])):
        changed = load_rig(rig, {"device.path": str(path)})
        checks = attached.check_devices(changed, boards if on_usb else [])
        assert [check.state for check in checks if check.state != "could be better"] == expected, checks
    assert f"at {path}" in checks[-1].seen


def test_the_devices_of_several_fingers_are_checked(tmp_path: Path) -> None:
    rig = tmp_path / "two.toml"
    rig.write_text('[devices.thumb]\ndriver = "spacemouse"\n[devices.index]\ndriver = "serial"\npath = "/dev/none"\n')
    puck = SystemDevice("hid", 0x046D, 0xC626, "Puck", "", str(rig))
    used, absent = attached.check_devices(load_rig(str(rig)), [puck])
    assert (used.state, absent.state, absent.name) == ("good", "bad", "device of [devices.index]")
    assert "good" in {check.state for check in attached.list_checks(load_rig("simulated-lift-a-box"))}


@pytest.mark.parametrize(
    ("problem", "reason", "remedy"),
    [("rights", "may not write to", "install --system"), ("held", "is used by process", "kill ")],
)
def test_a_node_that_cannot_be_used_is_bad(problem: str, reason: str, remedy: str, open_folder: Path) -> None:
    node = open_folder / "hidraw5"
    node.write_bytes(b"")
    puck = SystemDevice("hid", 0x046D, 0xC626, "Puck", "", str(node))
    assert attached.check_devices(load_rig("spacemouse"), [puck])[0].state == "good"
    with node.open("rb") if problem == "held" else without_rights((node, 0)) as file:
        if file is not None:
            fcntl.flock(file, fcntl.LOCK_EX)
        (check,) = attached.check_devices(load_rig("spacemouse"), [puck])
    assert check.state == "bad" and reason in check.seen and remedy in check.remedy


def test_a_cache_that_others_may_write_is_bad(open_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for mode, is_bad in ((0o755, False), (0o777, True)):
        open_folder.chmod(mode)
        monkeypatch.setattr(loop, "KERNEL_FOLDER", Folder(open_folder))
        check = loop.check_cache(load_rig("replay"), "frictionless-plane", load_scene("frictionless-plane"))
        assert (check.state == "bad") == is_bad
    assert "can be written by other users" in check.seen and "SOFTFINGER_CACHE_DIR" in check.remedy


def test_the_rig_selects_the_makers_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("FDSDK", "FORCEDIM_SDK"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    check = attached.check_maker_library(load_rig("omega-3"), "forcedimension")
    assert check.state == "bad" and "FDSDK" in check.remedy
    assert attached.check_maker_library(load_rig("replay"), "forcedimension").state == "good"


ROOT = Path(__file__).resolve().parents[2]
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


def run_report(*words: str) -> subprocess.CompletedProcess[str]:
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
    result = run_report("--rig", str(rig), "--seconds", "0.3")
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
    result = run_report("--rig", "omega-3", "--seconds", "0.3")
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
