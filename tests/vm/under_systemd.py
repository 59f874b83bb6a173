"""The service under systemd as the first process: installed from a wheel in /opt, started, starved, removed."""

import os
import pwd
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pytest

if "SOFTFINGER_VM" not in os.environ:
    raise RuntimeError("these tests install a service of the machine that they run on: make test-vm")

PROGRAM = Path("/opt/softfinger")
WHEEL = Path("/run/vm/wheel")
RIG = PROGRAM / "slow.toml"
TELEMETRY = Path("/run/softfinger/telemetry")
SHIPPED = Path(__file__).resolve().parents[2] / "config/rigs/simulated.toml"
OF_THE_SERVICE = Path("/run/systemd/system/softfinger.service.d/vm.conf")
WRITTEN, BELOW = Path("/run/above/files"), Path("/run/below")
"""All files written since the start, as stored by the overlay above the files of the host."""
ACCOUNTS = ("passwd", "shadow", "group", "gshadow", "subuid", "subgid")
OTHERS = re.compile(rf"/etc/({'|'.join(ACCOUNTS)})-?$|/etc/\.pwd\.lock$|/var/log/|/var/lib/systemd/|__pycache__")
"""Files of others: the accounts, which a test reads, the journal, Python."""
WATCHDOG_S = 10
"""Replaces the unit's 2 s: an emulated processor may stall for as long."""
SCHED_FIFO = 1
POLICY, RT_PRIORITY = 38, 37
"""Fields of /proc/PID/stat after the name, counted from 0 (proc(5) has them as 41 and 40)."""


def run(*words: str | Path, code: int = 0) -> str:
    """Run a command that has to exit with `code`, and return its output."""
    process = subprocess.run([*map(str, words)], capture_output=True, text=True, timeout=400)
    assert process.returncode == code, f"{words}: {process.returncode}\n{process.stdout}{process.stderr}\n{journal()}"
    return process.stdout


def journal() -> str:
    process = subprocess.run(["journalctl", "-b", "-o", "cat", "-u", "softfinger"], capture_output=True, text=True)
    return process.stdout


def show(name: str) -> str:
    return run("systemctl", "show", "--value", "--property", name, "softfinger").strip()


def wait_for(true: Callable[[], bool], seconds: float = 300.0) -> bool:
    until = time.monotonic() + seconds
    while not (value := true()) and time.monotonic() < until:
        time.sleep(0.2)
    return value


def files() -> set[str]:
    """Return all files that were written or removed, without folders that existed before."""
    paths = {at.relative_to(WRITTEN) for at in WRITTEN.rglob("*") if not OTHERS.search(f"/{at.relative_to(WRITTEN)}")}
    return {f"/{at}" for at in paths if not ((WRITTEN / at).is_dir() and (BELOW / at).is_dir())}


def status(pid: str) -> dict[str, str]:
    return dict(line.split(":\t", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())


@cache
def program() -> str:
    """Install the program in /opt, as in docs/operate/install.md, with this machine's libraries and a rig of 100 Hz."""
    for folder in Path(os.path.realpath(sys.executable)).parents:
        folder.chmod(folder.stat().st_mode | 0o055)  # the interpreter may be in a home folder
    run(sys.executable, "-m", "venv", "--without-pip", "--symlinks", PROGRAM)
    for name, source in (("wheel", WHEEL), ("libraries", sysconfig.get_path("purelib"))):
        (PROGRAM / name).mkdir()
        run("mount", "--bind", source, PROGRAM / name)
    (packages,) = (PROGRAM / "lib").glob("*/site-packages")
    (packages / "vm.pth").write_text(f"{PROGRAM}/wheel\n{PROGRAM}/libraries\n")
    script = PROGRAM / "bin/softfinger"
    script.write_text(f"#!{PROGRAM}/bin/python\nfrom softfinger.server.cli import main\nraise SystemExit(main())\n")
    script.chmod(0o755)
    slow = SHIPPED.read_text().replace("rate_hz = 1000.0", "rate_hz = 100.0")
    RIG.write_text(slow.replace("tcp://127.0.0.1:5555", f"ipc://{TELEMETRY}"))
    return str(script)


@cache
def files_before() -> set[str]:
    program()
    return files()


@cache
def installed() -> str:
    """Install the service, and return the output. Its kernels are for a generic processor, compiled on the host."""
    files_before()
    output = run(program(), "install", "--system", "--rig", RIG)
    OF_THE_SERVICE.parent.mkdir(parents=True)
    own = f"Environment=NUMBA_CPU_NAME={os.environ['NUMBA_CPU_NAME']}\nWatchdogSec={WATCHDOG_S}s"
    OF_THE_SERVICE.write_text(f"[Service]\n{own}\n")
    shutil.copytree("/run/kernels", "/var/cache/softfinger")
    run("systemctl", "daemon-reload")
    return output


@pytest.fixture
def service() -> str:
    """Main process of the service, started if necessary; `systemctl start` waits for READY."""
    installed()
    run("systemctl", "start", "softfinger")
    return show("MainPID")


@pytest.fixture
def arm(tmp_path: Path) -> Iterator[None]:
    words = [sys.executable, "-S", Path(__file__).with_name("gadgets") / "woodenhaptics.py", tmp_path / "arm", "{}"]
    with subprocess.Popen(words) as process:
        yield
        process.kill()


def test_installing_creates_the_account_and_reloads_systemd() -> None:
    output = installed()
    assert [line for line in output.splitlines() if line.startswith(("ran", "not run"))] == [
        "ran systemd-sysusers /etc/sysusers.d/softfinger.conf",
        "ran systemctl daemon-reload",
        "ran udevadm control --reload",
        f"ran udevadm trigger {' '.join(f'--subsystem-match={name}' for name in ('usb', 'hidraw', 'tty', 'misc'))}",
    ]
    assert "cannot start" not in output
    assert pwd.getpwnam("softfinger").pw_dir == "/var/lib/softfinger"


def test_it_runs_with_minimal_rights(service: str) -> None:
    assert (show("ActiveState"), show("SubState"), show("Type")) == ("active", "running", "notify")
    assert re.fullmatch(r"\d+ ticks, \d+ missed", show("StatusText"))
    account, now = pwd.getpwnam("softfinger"), status(service)
    assert set(now["Uid"].split()) == {str(account.pw_uid)} and set(now["Gid"].split()) == {str(account.pw_gid)}
    assert (int(now["CapEff"], 16), now["NoNewPrivs"], now["Seccomp"]) == (0, "1", "2")
    stats = [path.read_text().rpartition(") ")[2].split() for path in Path(f"/proc/{service}/task").glob("*/stat")]
    priorities = {int(stat[RT_PRIORITY]) for stat in stats if int(stat[POLICY]) == SCHED_FIFO}
    assert priorities == {79, 80, 81}  # relay, servo, supervisor
    made = TELEMETRY.stat()
    assert (made.st_uid, made.st_gid, made.st_mode & 0o777) == (account.pw_uid, account.pw_gid, 0o660)
    log = journal()
    assert not re.search(r"Failed to|refused|compiled in", log), log
    print(log)


def test_devices_are_for_the_group_and_within_the_service(service: str, arm: None) -> None:
    for pattern in ("hidraw*", "bus/usb/*/*"):
        assert wait_for(lambda p=pattern: "softfinger" in {at.group() for at in Path("/dev").glob(p)}), pattern
    (hidraw,) = (str(at) for at in Path("/dev").glob("hidraw*") if at.group() == "softfinger")
    (usb,) = (str(at) for at in Path("/dev").glob("bus/usb/*/*") if at.group() == "softfinger")
    group = f"/sys/fs/cgroup{show('ControlGroup')}/cgroup.procs"
    opened, account = f'echo $$ >{group}; exec "$@" dd count=0 if=/dev/null of=', ("setpriv", "--reuid=softfinger")
    for node in (hidraw, usb, "/dev/cpu_dma_latency"):
        assert Path(node).stat().st_mode & 0o777 == 0o660
        run("sh", "-c", opened + node, "sh", *account, "--regid=softfinger", "--clear-groups")
    run("sh", "-c", opened + "/dev/uhid", "sh", "env", code=1)  # root may open it outside the service


def test_ticks_feed_the_watchdog(service: str) -> None:
    first = int(show("WatchdogTimestampMonotonic"))
    assert wait_for(lambda: int(show("WatchdogTimestampMonotonic")) > first + 2e6 * WATCHDOG_S)
    assert (show("MainPID"), show("ActiveState")) == (service, "active")


def test_it_stops_with_zero_force(service: str) -> None:
    run("systemctl", "stop", "softfinger")
    assert (show("ActiveState"), show("Result"), show("ExecMainStatus")) == ("inactive", "success", "0")
    assert re.search(r"stopped after \d+ ticks; force is zero", journal())


def test_the_watchdog_ends_a_stopped_process(service: str) -> None:
    """systemd kills a stopped process by its watchdog, and does not restart it: a hand may be on the device."""
    os.kill(int(service), signal.SIGSTOP)
    assert wait_for(lambda: show("ActiveState") == "failed"), journal()
    assert (show("Result"), show("NRestarts")) == ("watchdog", "0")
    assert f"Watchdog timeout (limit {WATCHDOG_S}s)!" in journal()


def test_removing_leaves_nothing(service: str) -> None:
    shutil.rmtree(OF_THE_SERVICE.parent)
    output = run(program(), "install", "--system", "--remove")
    assert not Path(f"/proc/{service}").exists()
    assert files() - files_before() == set(), output
    assert not TELEMETRY.parent.exists()
    for account in ACCOUNTS:
        assert "softfinger" not in Path("/etc", account).read_text()
    assert show("LoadState") == "not-found"
