"""Access to commands of a daemon whose rig names no address: only its user, by a private socket."""

from __future__ import annotations

import json
import os
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.daemons import make_daemon
from helpers.pages import running

from softfinger.config.errors import AddressInUse, ConfigError
from softfinger.config.load import load_rig, load_scene
from softfinger.config.schema import make_commands_address
from softfinger.server.app import Daemon
from softfinger.server.cli import main
from softfinger.server.gateway.addresses import find_addresses
from softfinger.server.recording.reader import Note, read_contents
from softfinger.server.remote import Client
from softfinger.server.wire.control import Control
from softfinger.server.wire.endpoint import listen

WAIT_S = 60.0
NOBODY = 65534
KEY = "[commands] endpoint"
TELEMETRY = "tcp://127.0.0.1:5555"

needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can be another user")


@pytest.fixture
def folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Folder of sockets, not created yet; its path is short, as sockets require."""
    with tempfile.TemporaryDirectory() as runtime:
        monkeypatch.setenv("XDG_RUNTIME_DIR", runtime)
        yield Path(runtime) / "softfinger"


@pytest.fixture
def daemons() -> Iterator[list[Daemon]]:
    with make_daemon() as first, make_daemon() as second:
        first.start()
        second.start()
        yield [first, second]


@pytest.mark.real_time
def test_the_telemetry_leads_to_commands_of_the_same_daemon(folder: Path, daemons: list[Daemon]) -> None:
    for daemon in daemons:
        port = daemon.publisher.endpoint.rpartition(":")[2]
        socket = folder / f"{port}.commands"
        assert daemon.commands_endpoint == f"ipc://{socket}" == make_commands_address(daemon.publisher.endpoint)
        assert stat.S_IMODE(socket.stat().st_mode) == 0o600
        with Client(daemon.publisher.endpoint, timeout_s=WAIT_S) as client:
            assert client.describe()["endpoints"]["telemetry"] == daemon.publisher.endpoint
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


@pytest.fixture
def named_daemon() -> Iterator[Daemon]:
    """Run a daemon whose rig names a TCP address for commands, on a port unrelated to that of the telemetry."""
    with running("replay", "paper-plane") as daemon:
        yield daemon


@pytest.mark.real_time
@pytest.mark.parametrize("named", [False, True], ids=["own socket", "named by the rig"])
def test_a_daemon_is_found_from_either_address(
    named: bool, folder: Path, named_daemon: Daemon, daemons: list[Daemon], capsys: pytest.CaptureFixture[str]
) -> None:
    daemon = named_daemon if named else daemons[0]
    both = (daemon.publisher.endpoint, str(daemon.commands_endpoint))
    for number, endpoint in enumerate(both):
        for to_command in (False, True):
            assert find_addresses(endpoint, to_command=to_command) == both
        assert main(["ctl", "describe", "--json", "--endpoint", endpoint, "--timeout", "60"]) == 0
        assert json.loads(capsys.readouterr().out)["endpoints"] == {"telemetry": both[0], "commands": both[1]}
        assert main(["monitor", "--once", "--json", "--endpoint", endpoint, "--timeout", "60"]) == 0
        assert '"tick"' in capsys.readouterr().out
        recording = folder / f"{number}.mcap"
        assert main(["record", str(recording), "--endpoint", endpoint, "--duration", "0.05", "--timeout", "60"]) == 0
        assert any(isinstance(part, Note) and part.name == "scene" for part in read_contents(recording))
        with Client(endpoint, timeout_s=WAIT_S) as client:
            assert next(client.subscribe(timeout_s=WAIT_S)).tick >= 0
            assert client.describe()["endpoints"]["telemetry"] == both[0]


@pytest.mark.real_time
def test_a_daemon_without_commands_refuses_them_immediately(folder: Path) -> None:
    rig = load_rig("replay", {"telemetry.endpoint": "tcp://127.0.0.1:*", "commands.endpoint": "off"})
    with Daemon(rig, load_scene("paper-plane")) as daemon:
        daemon.start()
        assert find_addresses(daemon.publisher.endpoint).commands is None
        with Client(daemon.publisher.endpoint) as client:
            assert next(client.subscribe(timeout_s=WAIT_S)).tick >= 0
            with pytest.raises(ConfigError, match="accepts no commands"):
                client.arm()


def test_addresses_follow_from_each_other(folder: Path) -> None:
    commands = f"ipc://{folder}/5601.commands"
    assert find_addresses(commands) == ("tcp://127.0.0.1:5601", commands)
    assert find_addresses("tcp://10.0.0.1:5555") == ("tcp://10.0.0.1:5555", "tcp://10.0.0.1:5556")
    assert find_addresses("tcp://10.0.0.1:5556", to_command=True).commands == "tcp://10.0.0.1:5556"


CONNECT = """
import os, socket, sys
os.setgroups([]); os.setegid(65534); os.seteuid(65534)
try:
    socket.socket(socket.AF_UNIX).connect(sys.argv[1])
except PermissionError:
    sys.exit(13)
"""


@needs_root
def test_another_user_cannot_connect_to_the_socket(folder: Path) -> None:
    folder.mkdir()
    for path in (folder.parent, folder):
        path.chmod(0o755)
    codes = []
    for own in (True, False):
        bound = listen(f"ipc://{folder}/who.commands", KEY, own=own)
        with bound.files:
            socket = bound.endpoint.removeprefix("ipc://")
            if not own:  # counter-check: the same attempt with access
                Path(socket).chmod(0o666)
            codes.append(subprocess.run([sys.executable, "-c", CONNECT, socket], check=False).returncode)
    assert codes == [13, 0]


def test_a_socket_of_a_killed_daemon_is_replaced(folder: Path) -> None:
    endpoint = make_commands_address(TELEMETRY)
    killed = (
        "import os, sys; from softfinger.server.wire.endpoint import listen; "
        "bound = listen(sys.argv[1], 'commands', own=True); os._exit(0)"
    )
    subprocess.run([sys.executable, "-c", killed, endpoint], check=True)
    path = Path(endpoint.removeprefix("ipc://"))
    abandoned = path.stat().st_ino, path.stat().st_ctime_ns
    with listen(endpoint, KEY, own=True).files:
        living = path.stat().st_ino, path.stat().st_ctime_ns
        assert living != abandoned
        with pytest.raises(AddressInUse, match="is in use: stop process "):
            listen(endpoint, KEY, own=True)
        assert (path.stat().st_ino, path.stat().st_ctime_ns) == living
    assert not path.exists()


def _make_writable(folder: Path) -> None:
    folder.mkdir()
    folder.chmod(0o777)


def _make_link(folder: Path) -> None:
    (folder.parent / "elsewhere").mkdir()
    folder.symlink_to("elsewhere")


def _make_foreign(folder: Path) -> None:
    folder.mkdir()
    os.chown(folder, NOBODY, NOBODY)


@pytest.mark.parametrize(
    ("plant", "message"),
    [
        (_make_writable, "other users may write to it"),
        (_make_link, "is not a folder"),
        (Path.touch, "is not a folder"),
        pytest.param(_make_foreign, "belongs to another user", marks=needs_root),
    ],
)
def test_a_folder_of_another_user_is_refused(folder: Path, plant, message: str) -> None:
    """The daemon's socket could be replaced there, and clients could command another user's daemon."""
    plant(folder)
    with pytest.raises(ConfigError, match=message):
        listen(make_commands_address(TELEMETRY), KEY, own=True)
    with pytest.raises(ConfigError, match=message):
        Control(make_commands_address(TELEMETRY))


def test_a_missing_runtime_folder_is_reported(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder / "gone"))
    with pytest.raises(ConfigError, match="cannot be created for the socket of commands: No such file"):
        listen(make_commands_address(TELEMETRY), KEY, own=True)
