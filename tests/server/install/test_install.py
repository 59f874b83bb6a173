"""`install` below a folder: its files are written, recorded, updated and removed; other files are not changed."""

import errno
import json
import os
import stat
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest.mock import Mock

import pytest
from helpers.called import called
from helpers.forgotten import forget_user
from helpers.shortages import without_rights

from softfinger.config.errors import ConfigError, Exhausted
from softfinger.config.schema import Rig
from softfinger.config.sources import find
from softfinger.server.cli import main
from softfinger.server.install import verb
from softfinger.server.install.ledger import File, Ledger
from softfinger.server.install.plan import SYSTEM, find_private_folder, find_user_paths
from softfinger.server.install.verb import list_cleanup_commands, run_all

UNIT = "etc/systemd/system/softfinger.service"
ACCOUNT = "etc/sysusers.d/softfinger.conf"
RULES = "etc/udev/rules.d/70-softfinger.rules"
RECORD = str(SYSTEM.record.relative_to("/"))
FILES = {
    UNIT, RULES, "etc/security/limits.d/70-softfinger.conf", ACCOUNT,
    "usr/local/share/man/man1/softfinger.1", "usr/local/share/bash-completion/completions/softfinger",
    "usr/local/share/zsh/site-functions/_softfinger",
}  # fmt: skip
Install = Callable[..., str]


@pytest.fixture
def root() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        Path(folder).chmod(0o755)
        yield Path(folder) / "root"


@pytest.fixture
def install(root: Path) -> Install:
    """Return a function that installs below `root`, checks the exit code and returns the output."""

    def run(*words: str, code: int = 0) -> str:
        result = called("install", "--system", "--root", str(root), *words)
        assert result.returncode == code, result.stderr
        return result.stdout + result.stderr

    return run


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_dry_run_shows_what_an_install_writes(root: Path, install: Install) -> None:
    shown = install("--dry-run")
    assert not root.exists()
    install()
    written = content(root)
    assert set(written) == FILES | {RECORD}
    for name in FILES:
        text = written[name].decode()
        if "/share/" in name:
            text = f"({len(text.splitlines())} lines from the help texts)\n"
        assert f"##### /{name}: new\n{text}" in shown
    for words in ("systemd-sysusers", "systemctl daemon-reload", "udevadm control --reload"):
        assert f"##### then: {words}" in shown


def test_every_user_may_read_installed_files(root: Path, install: Install) -> None:
    before = os.umask(0o077)
    try:
        install()
    finally:
        os.umask(before)
    for path in (root / "etc").rglob("*"):
        assert stat.S_IMODE(path.stat().st_mode) == (0o755 if path.is_dir() else 0o644), path


@pytest.mark.parametrize("edited", [False, True])
def test_removal_keeps_foreign_and_edited_files(root: Path, install: Install, edited: bool) -> None:
    foreign = root / "etc/udev/rules.d/99-other.rules"
    foreign.parent.mkdir(parents=True)
    foreign.write_text("# somebody else's\n")
    install()
    if edited:
        (root / UNIT).write_text("[Service]\nExecStart=/bin/true\n")
    output = install("--remove")
    assert set(content(root)) == {str(foreign.relative_to(root))} | ({UNIT, RECORD} if edited else set())
    assert (f"edited, therefore not removed; remove it yourself: {root / UNIT}" in output) == edited
    if not edited:
        assert {path.name for path in root.rglob("*") if path.is_dir()} == {"etc", "udev", "rules.d"}
        return
    (root / UNIT).unlink()
    install("--remove")  # the record lists edited files until they are deleted
    assert set(content(root)) == {str(foreign.relative_to(root))}


def test_a_second_install_changes_nothing(root: Path, install: Install) -> None:
    install()
    before = content(root)
    assert install().count("as it was /") == len(FILES)
    assert content(root) == before


def test_an_edited_file_remains_and_is_reported(root: Path, install: Install) -> None:
    install()
    (root / RULES).write_text("# mine\n")
    (root / ACCOUNT).unlink()
    output = install("--rig", "omega-6", "--scene", "sphere")
    assert f"written {root / ACCOUNT}" in output and (root / ACCOUNT).exists()
    assert (root / RULES).read_text() == "# mine\n"
    assert f"edited, therefore not replaced; move it away to install the new one: {root / RULES}" in output
    assert f"renewed {root / UNIT}" in output
    assert "run --rig omega-6 --scene sphere\n" in (root / UNIT).read_text()


@pytest.mark.parametrize("kind", ["file", "link", "folder"])
def test_a_foreign_file_is_not_overwritten(root: Path, install: Install, kind: str) -> None:
    unit = root / UNIT
    unit.parent.mkdir(parents=True)
    if kind == "file":
        unit.write_text("[Unit]\n")
    elif kind == "link":
        unit.symlink_to("/dev/null")
    else:
        unit.mkdir()
    before = content(root)
    (line,) = install(code=2).splitlines()
    assert content(root) == before
    assert str(unit) in line and "move it away first; nothing was written" in line


def test_files_of_an_earlier_version_are_removed(root: Path, install: Install) -> None:
    install()
    old = root / "etc/old.conf"
    old.write_bytes((root / UNIT).read_bytes())
    record = json.loads((root / RECORD).read_text())
    record["files"]["/etc/old.conf"] = record["files"][f"/{UNIT}"]
    (root / RECORD).write_text(json.dumps(record))
    install()
    assert set(content(root)) == FILES | {RECORD}


@pytest.mark.parametrize("removes", [False, True])
def test_without_permission_there_is_one_clear_line(root: Path, removes: bool) -> None:
    files = [File(Path("/etc/a/one"), "1\n"), File(Path("/var/two"), "2\n")]
    if removes:
        list(Ledger(root, SYSTEM.record).write(files))
    before = content(root) if root.exists() else {}
    (root / "etc").mkdir(parents=True, exist_ok=True)
    folders = [root, *(path for path in root.rglob("*") if path.is_dir())]
    refused = pytest.raises(ConfigError, match=r"may not be changed by this user.*omit --system")
    with without_rights(*((folder, 0o555) for folder in folders)), refused as caught:
        ledger = Ledger(root, SYSTEM.record)
        list(ledger.remove() if removes else ledger.write(files))
    assert "\n" not in str(caught.value)
    assert content(root) == before


def test_a_full_disk_is_not_a_missing_permission(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "replace", Mock(side_effect=OSError(errno.ENOSPC, "No space left on device")))
    with pytest.raises(Exhausted, match=r"var/two: cannot be written: No space left on device: correct it"):
        list(Ledger(root, SYSTEM.record).write([File(Path("/var/two"), "2\n")]))


def test_a_damaged_record_is_reported(root: Path, install: Install) -> None:
    (root / RECORD).parent.mkdir(parents=True)
    (root / RECORD).write_text("{")
    assert f"{root / RECORD} is damaged" in install(code=2)


def test_the_service_uses_absolute_paths(root: Path, install: Install) -> None:
    root.mkdir()
    rig = root / "mine.toml"
    rig.write_bytes(find("omega-6", Rig).read_bytes())
    install("--rig", os.path.relpath(rig))
    assert f"run --rig {rig} --scene" in (root / UNIT).read_text()


def test_a_wrong_rig_is_refused_before_installing(root: Path, install: Install) -> None:
    assert "omega-66" in install("--rig", "omega-66", code=2) and not root.exists()


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in ("XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME"):
        monkeypatch.delenv(name, raising=False)
    home, tools = tmp_path / "home", tmp_path / "bin"
    for folder in (home, tools):
        folder.mkdir()
    (tools / "systemctl").write_text(f'#!/bin/sh\necho "$@" >> "{tmp_path}/asked"\n')
    (tools / "systemctl").chmod(0o755)
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setenv("PATH", f"{tools}:{os.environ['PATH']}")
    return home


def test_a_user_installs_without_root(home: Path) -> None:
    call_log = home.parent / "asked"
    assert main(["install"]) == 0
    files = {"softfinger.service", "softfinger.1", "softfinger", "_softfinger", "installed.json"}
    assert {path.rpartition("/")[2] for path in content(home)} == files
    assert call_log.read_text() == "--user daemon-reload\n"
    assert main(["install", "--remove"]) == 0
    assert list(home.rglob("*")) == []
    assert "--user disable --now softfinger.service\n--user daemon-reload\n" in call_log.read_text()


def test_a_users_folders_follow_xdg() -> None:
    named = find_user_paths({"XDG_CONFIG_HOME": "/c", "XDG_DATA_HOME": "relative"}, Path("/h"))
    assert named.units == Path("/c/systemd/user") and named.manuals == Path("/h/.local/share/man/man1")


def test_a_missing_home_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    forget_user(monkeypatch)
    result = called("install", "--dry-run")
    assert result.returncode == 2 and "no home folder" in result.stderr
    for name in ("CONFIG", "DATA", "STATE"):
        monkeypatch.setenv(f"XDG_{name}_HOME", str(tmp_path / name))
    result = called("install", "--dry-run")
    assert result.returncode == 0 and str(tmp_path / "CONFIG") in result.stdout


def test_a_command_that_does_not_end_does_not_stop_the_next(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(verb, "WAIT_S", 0.1)
    run_all([("sleep", "1000"), ("userdel-of-nowhere", "x")])
    assert capsys.readouterr().out.splitlines() == [
        "not finished within 0.1 s: sleep 1000",
        "not run, because userdel-of-nowhere is not installed: userdel-of-nowhere x",
    ]


def test_commands_that_are_missing_or_fail_are_reported(home, capsys, monkeypatch):
    tools = home.parent / "bin"
    (tools / "udevadm").write_text("#!/bin/sh\necho no udev runs here >&2\nexit 1\n")
    (tools / "udevadm").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tools}:/bin")
    run_all([("userdel-of-nowhere", "x"), ("udevadm", "control", "--reload"), ("systemctl", "daemon-reload")])
    assert capsys.readouterr().out.splitlines() == [
        "not run, because userdel-of-nowhere is not installed: userdel-of-nowhere x",
        "ran udevadm control --reload: no udev runs here",
        "ran systemctl daemon-reload",
    ]


def test_the_account_is_removed_unless_it_has_recordings(tmp_path: Path) -> None:
    state = tmp_path / "state"
    assert ("userdel", "softfinger") in list_cleanup_commands(True, state)
    state.mkdir()
    assert list_cleanup_commands(True, state)[-2:] == [("rmdir", str(state)), ("userdel", "softfinger")]
    (state / "trial.mcap").write_bytes(b"")
    assert not {"rmdir", "userdel"} & {words[0] for words in list_cleanup_commands(True, state)}


def test_a_program_in_a_private_folder_is_noticed(tmp_path: Path) -> None:
    """The service account could not start it."""
    program = tmp_path / "private" / "bin" / "softfinger"
    program.parent.mkdir(parents=True)
    program.parent.parent.chmod(0o700)
    assert find_private_folder([str(program)]) in (program.parent.parent, *program.parents)
