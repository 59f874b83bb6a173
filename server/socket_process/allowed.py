"""Public keys of peers that may connect, in a folder that is read again while the gateway or publisher runs."""

from __future__ import annotations

import errno
import logging
import os
import threading
from pathlib import Path
from typing import Final

from softfinger.config.errors import ConfigError
from softfinger.config.files import check_owner
from softfinger.config.schema import Security
from softfinger.server.keys import read_pair, read_public

log: Final = logging.getLogger(__name__)

_NO_FILES: Final = (errno.EMFILE, errno.ENFILE)
"""Peers may have used up all file descriptors: then the keys are assumed unchanged."""


class AllowedKeys:
    """Keys in the files `*.key` of a folder; raises ConfigError if other users may write to it."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self._names: dict[bytes, str] = {}
        self._accepted: set[bytes] = set()
        self._revoked: set[bytes] = set()
        self._warned: set[str] = set()
        self._reading = threading.Lock()
        self._read(strictly=True)

    def callback(self, domain: str, key: bytes) -> bool:
        """Return whether a peer with this key (Z85) may connect; called by libzmq's authenticator, in its thread."""
        # A rejected client does not connect again, so a key that was just added must be found now.
        if key not in self._names:
            self._read()
        if key not in self._names:
            return False
        self._accepted.add(key)
        return True

    def name(self, key: bytes) -> str:
        """Return the name of the file of an allowed key (Z85)."""
        return self._names.get(key, "")

    def refresh(self) -> bool:
        """Read the folder again; return whether a key that was in use is no longer allowed."""
        self._read()
        removed = set(self._accepted) - self._names.keys()
        self._accepted -= removed
        return bool(removed)

    def revoke(self, key: bytes) -> None:
        """Refuse a key (Z85) until the gateway is restarted."""
        self._revoked.add(key)

    def _read(self, strictly: bool = False) -> None:
        with self._reading:
            self._read_all(strictly)

    def _read_all(self, strictly: bool) -> None:
        names: dict[bytes, str] = {}
        try:
            check_owner(self.folder, os.stat(self.folder), "could let anybody in")
            for path in sorted(self.folder.glob("*.key")):
                self._read_one(path, names, strictly)
        except (OSError, ConfigError) as error:
            if isinstance(error, OSError) and error.errno in _NO_FILES:
                return
            text = str(error) if isinstance(error, ConfigError) else f"{self.folder}: {error.strerror}"
            if strictly:
                raise ConfigError(f"no keys of allowed clients: {text}") from error
            self._warn(f"no client is allowed: {text}")
            names = {}
        self._names = {key: name for key, name in names.items() if key not in self._revoked}

    def _read_one(self, path: Path, names: dict[bytes, str], strictly: bool) -> None:
        try:
            names[read_public(path)] = path.stem
        except ConfigError as error:
            if isinstance(error.__cause__, OSError) and error.__cause__.errno in _NO_FILES:
                raise error.__cause__ from None
            if strictly:
                raise
            self._warn(f"skipped: {error}")

    def _warn(self, text: str) -> None:
        """Log a warning once, instead of each time the folder is read."""
        if text not in self._warned:
            self._warned.add(text)
            log.warning("%s", text)


def list_key_folders(security: Security) -> tuple[str, str]:
    """Return a rig's folders of readers and commanders, '' for none; raises ConfigError for unusable keys."""
    read_pair(security.key)
    for folder in filter(None, (security.readers, security.commanders)):
        AllowedKeys(folder)
    return security.readers or "", security.commanders or ""
