"""Access to a daemon: key files, and its own socket for commands if the rig names no address."""

import errno
import json
import os
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import zmq
import zmq.auth
from helpers.called import called, read_stdout
from helpers.daemons import make_daemon
from helpers.pages import running

from softfinger.config.errors import AddressInUse, ConfigError
from softfinger.config.load import build, load_rig, load_scene
from softfinger.config.schema import Rig, make_commands_address
from softfinger.server.app import Daemon
from softfinger.server.gateway.addresses import find_addresses
from softfinger.server.keys import make_pair, read_pair, read_public
from softfinger.server.recording.reader import Note, read_contents
from softfinger.server.remote import Client
from softfinger.server.socket_process.allowed import AllowedKeys
from softfinger.server.wire.control import Control
from softfinger.server.wire.endpoint import listen

OTHER = 65534
"""User `nobody`."""


def read_mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


@pytest.mark.parametrize("mask", [0o000, 0o777])
def test_the_secret_is_readable_by_its_owner_only(tmp_path: Path, mask: int) -> None:
    before = os.umask(mask)
    try:
        public, secret = make_pair(tmp_path, "rig")
    finally:
        os.umask(before)
    assert (read_mode(secret), read_mode(public)) == (0o600, 0o644)
    assert zmq.auth.load_certificate(secret) == tuple(read_pair(secret))
    assert zmq.auth.load_certificate(public) == (read_public(public), None)
    assert zmq.curve_public(read_pair(secret).secret) == read_public(public)


def test_a_pair_is_written_as_a_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    open_file = os.open

    def refuse_public(path: Path, *how: int) -> int:
        if path.suffix == ".key":
            raise OSError(errno.ENOSPC, "No space left on device", path)
        return open_file(path, *how)

    monkeypatch.setattr(os, "open", refuse_public)
    with pytest.raises(ConfigError, match=r"rig\.key: No space left"):
        make_pair(tmp_path, "rig")
    monkeypatch.undo()
    make_pair(tmp_path, "rig")


def test_no_key_is_overwritten(tmp_path: Path) -> None:
    public, secret = make_pair(tmp_path, "rig")
    content = public.read_bytes(), secret.read_bytes()
    for deleted in (None, public):
        if deleted is not None:
            deleted.unlink()
        with pytest.raises(ConfigError, match="keys are not overwritten"):
            make_pair(tmp_path, "rig")
    assert secret.read_bytes() == content[1] and not public.exists()
    (tmp_path / "link.key_secret").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ConfigError, match="keys are not overwritten"):
        make_pair(tmp_path, "link")
    for name in ("", "../rig", ".hidden", "a/b", "a\n", "x" * 65):
        with pytest.raises(ConfigError, match="is not a name of a key"):
            make_pair(tmp_path, name)


def test_the_verb_makes_pairs(tmp_path: Path) -> None:
    words = ["keys", str(tmp_path / "new" / "keys"), "rig", "anna", "--json"]
    pairs = json.loads(read_stdout(*words))
    assert set(pairs) == {"rig", "anna"} and all(read_pair(files["secret"]) for files in pairs.values())
    assert called(*words).returncode == 2
    output = read_stdout("keys", str(tmp_path / "new" / "keys"), "ben")
    assert f"{tmp_path}/new/keys/ben.key: public key: copy it to the other side" in output
    assert "ben.key_secret: secret key: do not share it" in output


def test_invalid_key_files_are_refused(tmp_path: Path) -> None:
    public, secret = make_pair(tmp_path, "rig")
    _, second_secret = make_pair(tmp_path, "other")
    with pytest.raises(ConfigError, match="a public key"):
        read_pair(public)
    text = secret.read_text()
    mixed = tmp_path / "mixed"
    mixed.touch(0o600)
    mixed.write_text(text.replace(text.split('"')[3], second_secret.read_text().split('"')[3]))
    with pytest.raises(ConfigError, match="does not belong to its secret key"):
        read_pair(mixed)
    with pytest.raises(ConfigError, match="no line public-key"):
        read_public(Path(__file__).parents[2] / "LICENSE")
    with pytest.raises(ConfigError, match="No such file"):
        read_public(tmp_path / "none")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ConfigError, match="is a pipe"):
        read_public(tmp_path / "pipe")
    for bits in (0o640, 0o604, 0o601):
        secret.chmod(bits)
        with pytest.raises(ConfigError, match=r"other users can read .*chmod 600"):
            read_pair(secret)


def test_keys_writable_by_other_users_are_refused(tmp_path: Path) -> None:
    public, secret = make_pair(tmp_path, "rig")
    for path, read, right in ((public, read_public, 0o644), (secret, read_pair, 0o600)):
        message = rf"{path.name}: other users may write to it .*replace this key.*chmod go-w"
        for bits in (right | 0o020, right | 0o002, 0o666):
            path.chmod(bits)
            with pytest.raises(ConfigError, match=message):
                read(path)
        path.chmod(right)
        for bits in (0o775, 0o757):
            tmp_path.chmod(bits)
            with pytest.raises(ConfigError, match="other users may write to it"):
                read(path)
        tmp_path.chmod(0o1777)
        read(path)
        tmp_path.chmod(0o755)


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to give files away")
def test_keys_of_another_user_are_refused(tmp_path: Path) -> None:
    public, secret = make_pair(tmp_path, "rig")
    for path, read in ((public, read_public), (secret, read_pair), (tmp_path, lambda _: read_pair(secret))):
        os.chown(path, OTHER, OTHER)
        with pytest.raises(ConfigError, match=f"belongs to another user \\({OTHER}\\)"):
            read(path)
        if path is tmp_path:
            with pytest.raises(ConfigError, match="who could let anybody in"):
                AllowedKeys(tmp_path)
        os.chown(path, 0, 0)


def test_changes_of_the_key_folder_take_effect(tmp_path: Path) -> None:
    allowed = AllowedKeys(tmp_path)
    public, _ = make_pair(tmp_path, "anna")
    key = read_public(public)
    assert not allowed.refresh() and allowed.callback("", key) and allowed.name(key) == "anna"
    public.unlink()
    assert allowed.refresh() and not allowed.callback("", key)
    eve, _ = make_pair(tmp_path, "eve")
    allowed.revoke(read_public(eve))
    assert not allowed.refresh() and not allowed.callback("", read_public(eve))
    make_pair(tmp_path, "bob")
    assert not allowed.refresh() and allowed.callback("", read_public(tmp_path / "bob.key"))
    bob = read_public(tmp_path / "bob.key")
    for bits in (0o775, 0o757):  # writable by its group, and by all users
        tmp_path.chmod(bits)
        assert allowed.refresh() and not allowed.callback("", bob)
        with pytest.raises(ConfigError, match="other users may write to it"):
            AllowedKeys(tmp_path)
        tmp_path.chmod(0o755)
        assert not allowed.refresh() and allowed.callback("", bob)
    with pytest.raises(ConfigError, match="No such file"):
        AllowedKeys(tmp_path / "none")


def test_a_key_written_after_the_folder_was_read_is_admitted(tmp_path: Path) -> None:
    """A rejected client does not reconnect, so the folder is read again for an unknown key."""
    folder = tmp_path / "readers"
    folder.mkdir()
    public, _ = make_pair(tmp_path, "anna")
    allowed, key = AllowedKeys(folder), read_public(public)
    file = folder / public.name
    file.write_bytes(b"")
    assert not allowed.refresh()
    file.write_bytes(public.read_bytes())
    assert allowed.callback("", key)


RIG = {"device": {"driver": "replay", "recording": "tap"}}
ALL = {"key": "k", "readers": "r", "commanders": "c"}
READERS = {"key": "k", "readers": "r"}


@pytest.mark.parametrize(
    ("tables", "fault"),
    [
        ({"telemetry": {"endpoint": "tcp://0.0.0.0:1"}}, "may read: add [security] with key and readers"),
        ({"telemetry": {"endpoint": "tcp://0.0.0.0:1"}, "security": {"key": "k"}}, "may read"),
        ({"telemetry": {"endpoint": "tcp://0.0.0.0:1"}, "security": READERS}, "may command"),
        ({"commands": {"endpoint": "tcp://eth0:1"}, "security": READERS}, "may command"),
        ({"metrics": {"endpoint": "0.0.0.0:9464"}}, "without protection"),
        ({"metrics": {"endpoint": "127.0.0.1"}}, "must be HOST:PORT"),
        ({"telemetry": {"endpoint": "tcp://[::]:1"}, "commands": {"endpoint": "off"}, "security": READERS}, ""),
        ({"telemetry": {"endpoint": "tcp://*:1"}, "security": ALL}, ""),
    ],
)  # fmt: skip
def test_public_endpoints_need_keys(tables: dict, fault: str) -> None:
    if fault:
        with pytest.raises(ConfigError) as caught:
            build(Rig, RIG | tables, "rig.toml")
        assert fault in str(caught.value) and "faults" not in str(caught.value)
    else:
        assert build(Rig, RIG | tables, "rig.toml").security is not None


def test_key_paths_are_relative_to_the_rig_file(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(
        '[device]\ndriver = "replay"\nrecording = "tap"\n[security]\nkey = "k"\nreaders = "/r"\n'
    )
    security = load_rig(tmp_path / "rig.toml").security
    assert (security.key, security.readers, security.commanders) == (str(tmp_path / "k"), "/r", None)


def test_a_client_needs_both_keys(tmp_path: Path) -> None:
    public, secret = make_pair(tmp_path, "rig")
    for words in (["--keys", str(secret)], ["--server-key", str(public)]):
        result = called("ctl", "heartbeat", *words)
        assert result.returncode == 2 and "requires --" in result.stderr


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
    """Run a daemon; its rig names a TCP address for commands, on a port unrelated to that of the telemetry."""
    with running("replay", "paper-plane") as daemon:
        yield daemon


@pytest.mark.real_time
@pytest.mark.parametrize("named", [False, True], ids=["own socket", "named by the rig"])
def test_a_daemon_is_found_from_either_address(named, folder, named_daemon, daemons):
    daemon = named_daemon if named else daemons[0]
    both = (daemon.publisher.endpoint, str(daemon.commands_endpoint))
    for number, endpoint in enumerate(both):
        for to_command in (False, True):
            assert find_addresses(endpoint, to_command=to_command) == both
        to = ["--endpoint", endpoint, "--timeout", "60"]
        described = json.loads(read_stdout("ctl", "describe", "--json", *to))
        assert described["endpoints"] == {"telemetry": both[0], "commands": both[1]}
        assert '"tick"' in read_stdout("monitor", "--once", "--json", *to)
        recording = folder / f"{number}.mcap"
        read_stdout("record", str(recording), "--duration", "0.05", *to)
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
        bound = listen(f"ipc://{folder}/who.commands", KEY, private=own)
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
        "bound = listen(sys.argv[1], 'commands', private=True); os._exit(0)"
    )
    subprocess.run([sys.executable, "-c", killed, endpoint], check=True)
    path = Path(endpoint.removeprefix("ipc://"))
    abandoned = path.stat().st_ino, path.stat().st_ctime_ns
    with listen(endpoint, KEY, private=True).files:
        living = path.stat().st_ino, path.stat().st_ctime_ns
        assert living != abandoned
        with pytest.raises(AddressInUse, match="is in use: stop process "):
            listen(endpoint, KEY, private=True)
        assert (path.stat().st_ino, path.stat().st_ctime_ns) == living
    assert not path.exists()


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("writable", "other users may write to it"),
        ("link", "is not a folder"),
        ("file", "is not a folder"),
        pytest.param("foreign", "belongs to another user", marks=needs_root),
    ],
)
def test_a_folder_of_another_user_is_refused(folder: Path, kind: str, message: str) -> None:
    """The daemon's socket could be replaced there, and clients could command another user's daemon."""
    if kind == "file":
        folder.touch()
    else:
        folder.mkdir()
        folder.chmod(0o777 if kind == "writable" else 0o700)
    if kind == "link":
        folder.rename(folder.parent / "elsewhere")
        folder.symlink_to("elsewhere")
    if kind == "foreign":
        os.chown(folder, NOBODY, NOBODY)
    with pytest.raises(ConfigError, match=message):
        listen(make_commands_address(TELEMETRY), KEY, private=True)
    with pytest.raises(ConfigError, match=message):
        Control(make_commands_address(TELEMETRY))


def test_a_missing_runtime_folder_is_reported(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder / "gone"))
    with pytest.raises(ConfigError, match="cannot be created for the socket of commands: No such file"):
        listen(make_commands_address(TELEMETRY), KEY, private=True)
