"""CURVE keys: reading, writing and using key pairs in ZeroMQ's certificate files.

A pair consists of NAME.key, which is public, and NAME.key_secret. Other programs with libzmq's certificates can read
and write the same files.
"""

from __future__ import annotations

import argparse
import os
import re
import stat
from pathlib import Path
from typing import Any, Final, NamedTuple

import zmq

from softfinger.config.arguments import describe_refusal
from softfinger.config.errors import ConfigError
from softfinger.config.files import check_owner, open_input
from softfinger.config.words import format_value

SIZE_MAX: Final = 4096
"""Maximum size of a key file, bytes; files written here have about 200."""
_NAME: Final = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,63}")
_LINE: Final = re.compile(
    rb'^\s*(public|secret)-key\s*=\s*"([0-9A-Za-z.:+=^!/*?&<>()\[\]{}@%$#-]{40})"\s*$', re.MULTILINE
)
_OTHERS_ACCESS: Final = stat.S_IRWXG | stat.S_IRWXO


class KeyPair(NamedTuple):
    """Public key and secret key, Z85."""

    public: bytes
    secret: bytes


class ClientKeys(NamedTuple):
    """Key pair of a client and public key of its server, Z85."""

    client: KeyPair
    server: bytes

    def apply_to(self, socket: zmq.Socket[Any]) -> None:
        """Set the keys of a socket; call before it is connected."""
        socket.curve_publickey, socket.curve_secretkey, socket.curve_serverkey = *self.client, self.server


def check_keys(keys: object) -> ClientKeys | None:
    """Return the keys of a client, or None; raises ConfigError for anything else."""
    if keys is None or isinstance(keys, ClientKeys):
        return keys
    raise ConfigError(describe_refusal("keys", keys, "the result of `client_keys`, or None"))


def make_pair(folder: Path, name: str) -> tuple[Path, Path]:
    """Write a new key pair, the secret file with mode 600.

    Returns
    -------
    tuple
        Public file, secret file.

    Raises
    ------
    ConfigError
        If the name is not allowed or one of the files exists.
    """
    if not _NAME.fullmatch(name):
        raise ConfigError(f"{format_value(name)} is not a name of a key: up to 64 letters, digits, dots, - and _")
    files = folder / f"{name}.key", folder / f"{name}.key_secret"
    public, secret = zmq.curve_keypair()
    texts = [f'curve\n    public-key = "{public.decode()}"\n', f'    secret-key = "{secret.decode()}"\n']
    created: list[Path] = []
    try:
        folder.mkdir(mode=0o755, parents=True, exist_ok=True)
        for path in files:
            if os.path.lexists(path):
                raise FileExistsError(None, "already exists, and keys are not overwritten: choose another name", path)
        for path, text, mode in ((files[1], "".join(texts), 0o600), (files[0], texts[0], 0o644)):
            fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, mode)
            created.append(path)
            with open(fd, "w", encoding="ascii") as file:
                os.fchmod(fd, mode)  # undo the umask
                file.write(text)
    except OSError as error:
        for path in created:
            path.unlink()
        raise ConfigError(f"{error.filename or folder}: {error.strerror or error}") from error
    return files


def read_public(path: str | Path) -> bytes:
    """Return the public key of a file; raises ConfigError if it has none."""
    keys, _ = _read(path)
    return keys["public"]


def read_pair(path: str | Path) -> KeyPair:
    """Return the pair of a secret file; raises ConfigError if it has none or if other users may read it."""
    keys, mode = _read(path)
    if "secret" not in keys:
        raise ConfigError(f"{path}: a public key: the secret one is in the same folder, in a file .key_secret")
    if mode & _OTHERS_ACCESS:
        raise ConfigError(
            f"{path}: a secret key that other users can read (mode {stat.S_IMODE(mode):o}): chmod 600 it, and create "
            "new keys if another user has read it"
        )
    if zmq.curve_public(keys["secret"]) != keys["public"]:
        raise ConfigError(f"{path}: its public key does not belong to its secret key: create new keys")
    return KeyPair(keys["public"], keys["secret"])


def client_keys(client: str | Path, server: str | Path) -> ClientKeys:
    """Read a client's secret file and the server's public file; raises ConfigError if either is unusable."""
    return ClientKeys(read_pair(client), read_public(server))


def read_keys(args: argparse.Namespace) -> ClientKeys | None:
    """Return the keys named by these options; None without options. Raises ConfigError if only one is given."""
    if args.server_key is None and args.keys is None:
        return None
    if args.keys is None:
        raise ConfigError("--server-key requires --keys FILE, your secret key: create one with softfinger keys")
    if args.server_key is None:
        raise ConfigError(f"--keys {args.keys} requires --server-key FILE, the public key of the server")
    return client_keys(args.keys, args.server_key)


def _read(path: str | Path) -> tuple[dict[str, bytes], int]:
    """Return the keys in a file by kind, and its mode (`st_mode`)."""
    try:
        with open_input(path, SIZE_MAX) as file:
            status, text = os.fstat(file.fileno()), file.read(SIZE_MAX)
        folder = Path(path).resolve().parent
        for checked, status_of_checked in ((path, status), (folder, folder.stat())):
            check_owner(checked, status_of_checked, "could replace this key")
    except (OSError, ValueError, TypeError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise ConfigError(f"{path}: no key can be read: {reason}; create one with softfinger keys") from error
    keys = {kind.decode(): key for kind, key in _LINE.findall(text)}
    if "public" not in keys:
        raise ConfigError(f"{path}: no CURVE certificate: it has no line public-key; create one with softfinger keys")
    return keys, status.st_mode
