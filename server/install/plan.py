"""Files and folders of an installation, for the system or for one user."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from softfinger.config.errors import ConfigError
from softfinger.config.files import find_home_folder
from softfinger.config.load import load_rig, load_scene
from softfinger.config.schema import Rig, Scene
from softfinger.config.sources import find, list_shipped
from softfinger.drivers.system.rules import GROUP, find_program_command, make_udev_rules
from softfinger.server.install.ledger import File
from softfinger.server.install.texts import RTPRIO, make_manual, make_unit

ACCOUNT: Final = f"""\
# The account of the service; its group may open the devices and has the limits.
u {GROUP} - "softfinger, a haptic rendering server" /var/lib/softfinger
"""
LIMITS: Final = f"""\
# Needs of a servo at 1 kHz: real-time priority and locked memory.
@{GROUP} - rtprio {RTPRIO}
@{GROUP} - memlock unlimited
"""


class InstallPaths(NamedTuple):
    """Folders that programs search for units, manuals, and completion of bash and zsh; and the path of the record."""

    units: Path
    manuals: Path
    bash: Path
    zsh: Path
    record: Path


SYSTEM: Final = InstallPaths(
    Path("/etc/systemd/system"),
    Path("/usr/local/share/man/man1"),
    Path("/usr/local/share/bash-completion/completions"),
    Path("/usr/local/share/zsh/site-functions"),
    Path("/etc/softfinger/installed.json"),
)


def find_user_paths(environment: Mapping[str, str], home: Path | None) -> InstallPaths:
    """Return the places by the XDG base directories; raises ConfigError without a home folder, if one needs it."""

    def folder(name: str, fallback: str) -> Path:
        value = environment.get(name, "")
        if value.startswith("/"):
            return Path(value)
        if home is None:
            raise ConfigError(
                f"this user has no home folder, in HOME or in passwd: set HOME or {name}, or add --system"
            )
        return home / fallback

    data = folder("XDG_DATA_HOME", ".local/share")
    return InstallPaths(
        folder("XDG_CONFIG_HOME", ".config") / "systemd/user",
        data / "man/man1",
        data / "bash-completion/completions",
        data / "zsh/site-functions",
        folder("XDG_STATE_HOME", ".local/state") / "softfinger/installed.json",
    )


def install_paths(system: bool) -> InstallPaths:
    return SYSTEM if system else find_user_paths(os.environ, find_home_folder())


def list_files(system: bool, rig: str, scene: str, parser: argparse.ArgumentParser) -> list[File]:
    """Return all files to install, for a daemon with that rig and scene; `parser` has the options of all verbs.

    Raises the errors of loading the rig or the scene.
    """
    from softfinger.server.cli import format_completion

    load_scene(scene)
    devices = load_rig(rig).tables.values()
    at = install_paths(system)
    install_files = [
        File(at.units / "softfinger.service", make_unit(make_service_command(rig, scene), system)),
        File(at.manuals / "softfinger.1", make_manual(parser)),
        File(at.bash / "softfinger", format_completion("bash")),
        File(at.zsh / "_softfinger", format_completion("zsh")),
    ]
    if system:
        install_files += [
            File(Path("/etc/udev/rules.d/70-softfinger.rules"), make_udev_rules(devices)),
            File(Path("/etc/security/limits.d/70-softfinger.conf"), LIMITS),
            File(Path("/etc/sysusers.d/softfinger.conf"), ACCOUNT),
        ]
    return install_files


def make_service_command(rig: str, scene: str) -> list[str]:
    """Return the command of the unit, independent of the working directory."""
    return [*find_program_command(), "run", "--rig", resolve_name(rig, Rig), "--scene", resolve_name(scene, Scene)]


def resolve_name(name: str, kind: type[Rig] | type[Scene]) -> str:
    """Return the name of a shipped rig or scene, or else its absolute path."""
    return name if name in list_shipped(kind) else str(find(name, kind).resolve())


def find_private_folder(words: Sequence[str]) -> Path | None:
    """Return the first folder that only its owner may enter, on the path of a program, its interpreter or its files.

    Returns None if there is none.
    """
    for path in (Path(word) for word in (*words, os.path.realpath(sys.executable)) if word.startswith("/")):
        for folder in reversed(path.parents):
            if folder.exists() and not folder.stat().st_mode & 0o001:
                return folder
    return None
