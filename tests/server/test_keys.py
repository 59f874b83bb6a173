"""Key files: permissions, protection from overwriting, refused files, and compatibility with pyzmq."""

from __future__ import annotations

import json
import os
import stat
import subprocess
from pathlib import Path

import pytest
import zmq
import zmq.auth
from helpers.processes import COMMAND
from helpers.programs import run_program

from softfinger.config.errors import ConfigError
from softfinger.config.load import build, load_rig
from softfinger.config.schema import Rig
from softfinger.server.keys import make_pair, read_pair, read_public
from softfinger.server.socket_process.allowed import AllowedKeys

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
    words = [*COMMAND, "keys", str(tmp_path / "new" / "keys"), "rig", "anna", "--json"]
    completed = run_program(words, check=True)
    pairs = json.loads(completed.stdout)
    assert set(pairs) == {"rig", "anna"} and all(read_pair(files["secret"]) for files in pairs.values())
    assert subprocess.run(words, capture_output=True, check=False).returncode == 2
    output = run_program([*words[:-3], "ben"], check=True).stdout
    assert (
        f"{tmp_path}/new/keys/ben.key: public key: copy it to the other side" in output
        and "ben.key_secret: secret key: do not share it" in output
    )


def test_invalid_key_files_are_refused(tmp_path: Path) -> None:
    public, secret = make_pair(tmp_path, "rig")
    _, second_secret = make_pair(tmp_path, "other")
    public.chmod(0o600)
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
        for bits in (right | 0o020, right | 0o002, 0o666):
            path.chmod(bits)
            with pytest.raises(
                ConfigError, match=rf"{path.name}: other users may write to it .*replace this key.*chmod go-w"
            ):
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
    for bits in (0o775, 0o757):  # writable by its group, and by others
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
        completed = run_program([*COMMAND, "ctl", "heartbeat", *words])
        assert completed.returncode == 2 and "requires --" in completed.stderr
