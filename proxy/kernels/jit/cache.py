"""Compiled kernels on disk: loaded only if complete, and only from a folder that no other user can write to.

A cached kernel is a pickle of machine code: an attacker with write access runs code as the user that loads it, and a
flipped bit changes a force. So two conditions are checked before a byte is unpickled. The folder, every folder above it
and the file belong to this user or to root, and no other user can write to them: this excludes attackers. The checksum
of the file is correct: this excludes damage, and only damage, because an attacker can compute a checksum. If either
check fails, the kernel is compiled again. numba's cache is not used: it falls back to other folders if the named one is
not writable, trusts their content, and ends the program if a file is damaged or the disk is full.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import secrets
import stat
import sys
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import IO, Any, Final

from numba import types

MAGIC: Final = b"softfinger kernel 1\n"
LINKS_MAX: Final = 40
FOLDER_REMEDY: Final = "set SOFTFINGER_CACHE_DIR to a folder that belongs to you"

_PROGRAM: Final = f"{Path(__file__).parents[3]}{os.sep}"

KERNEL_FOLDERS: Final = ("drivers", "proxy", "server/loop", "server/offline", "server/wire/native")
"""Folders with kernels and the constants that they read, except those of `tools`: a hash of their sources is part of
the name of the cache folder."""

_KERNEL_PATHS: Final = tuple(f"{_PROGRAM}{folder}{os.sep}" for folder in KERNEL_FOLDERS)
_OWN_FILE: Final = f"{_PROGRAM}config{os.sep}package.py"
"""Excluded from hashes: a wheel has it at another path, but shares cached kernels with a clone of the same version."""

log: Final = logging.getLogger(__name__)


class UntrustedCache(Exception):
    """Reason why a folder or a file is not used; the message includes the remedy."""


class Folder:
    """Folder of cached kernels at `path`, or no cache if that is None. It is created and checked on first use.

    unkept  consequence for the log if nothing can be stored
    """

    def __init__(
        self, path: Path | None, unkept: str = "compiled kernels are not cached, so every start compiles them"
    ) -> None:
        self.path, self._unkept = path, unkept
        self._problem: str | None = None
        self._looked = self._said = False

    def problem(self) -> str | None:
        """Return why kernels are not cached, with the remedy; None if they are. Includes a write that has failed."""
        if not self._looked:
            try:
                if self.path is None:
                    raise UntrustedCache(f"this user has no home folder: {FOLDER_REMEDY}")
                make_private(self.path)
            except UntrustedCache as error:
                self._problem = str(error)
            except (OSError, ValueError) as error:
                self._problem = f"{self.path} cannot be created: {_reason(error)}: {FOLDER_REMEDY}"
            self._looked = True  # last: another thread that reads True trusts the folder
        return self._problem

    def read(self, name: str) -> bytes | None:
        """Return the content of a cached file; None if it is missing or invalid."""
        if self.path is None or self.problem() is not None:
            return None
        try:
            with self.opened(name) as file:
                data = file.read()
            head = len(MAGIC) + hashlib.sha256().digest_size
            body = data[head:]
            if data[:head] != MAGIC + hashlib.sha256(body).digest():
                raise UntrustedCache("damaged")
        except FileNotFoundError:
            return None
        except (UntrustedCache, OSError) as error:
            self.reject(name, error)
            return None
        return body

    def opened(self, name: str) -> IO[bytes]:
        """Open a cached file for reading.

        Raises FileNotFoundError, OSError, or UntrustedCache if other users can write to it.
        """
        why = self.problem()
        if why is not None or self.path is None:
            raise UntrustedCache(why)
        path = self.path / name
        fd = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
        status = os.fstat(fd)
        if not stat.S_ISREG(status.st_mode) or _complaint(status, path) is not None:
            os.close(fd)
            raise UntrustedCache("not a file that only this user can write")
        return open(fd, "rb")

    def reject(self, name: str, why: Exception) -> None:
        """Log that a cached file is not used."""
        log.warning("cached kernel %s is invalid and is compiled again: %s", name, _reason(why))

    def write(self, name: str, body: bytes) -> None:
        """Store `body` under a name, for `read`."""
        self.put(name, [MAGIC, hashlib.sha256(body).digest(), body])

    def put(self, name: str, parts: Iterable[Any]) -> None:
        """Store bytes under a name, completely or not at all, for `opened`. Log the first failure."""
        if self.problem() is None and self.path is not None:
            part = self.path / f".{secrets.token_hex(8)}.part"
            try:
                flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
                with open(os.open(part, flags, 0o600), "wb") as file:
                    file.writelines(parts)
                os.replace(part, self.path / name)
            except OSError as error:
                self._problem = f"{self.path} cannot be written to: {_reason(error)}: make room, or {FOLDER_REMEDY}"
                part.unlink(missing_ok=True)
        if self._problem is not None and not self._said:
            self._said = True
            log.warning("%s: %s", self._unkept, self._problem)


def make_private(folder: Path) -> None:
    """Create a folder that no other user can change, including missing parents.

    Raises UntrustedCache if that is not possible. The path is checked from the root down: no other user can change a
    checked folder, so the entries below it cannot be exchanged after their check.
    """
    at, parts, links = Path("/"), list(reversed(folder.absolute().parts[1:])), 0
    _check(os.lstat(at), at)
    while parts:
        name = parts.pop()
        at = at.parent if name == ".." else at / name
        try:
            status = os.lstat(at)
        except FileNotFoundError:
            with contextlib.suppress(FileExistsError):  # another process has created it
                os.mkdir(at, 0o700)
            status = os.lstat(at)
        _check(status, at)
        if stat.S_ISLNK(status.st_mode):
            links += 1
            if links > LINKS_MAX:
                raise UntrustedCache(f"{folder}: links without end: {FOLDER_REMEDY}")
            target = Path(os.readlink(at))
            parts += reversed(target.parts[1:] if target.is_absolute() else target.parts)
            at = Path("/") if target.is_absolute() else at.parent
        elif not stat.S_ISDIR(status.st_mode):
            raise UntrustedCache(f"{at} is not a folder: {FOLDER_REMEDY}")
    if why := _complaint(status, at):
        raise UntrustedCache(why)


def _check(status: os.stat_result, path: Path) -> None:
    """Raise UntrustedCache if another user could replace this part of a path.

    Others may write to a sticky folder: they can neither move nor remove our entries in it.
    """
    sticky = stat.S_ISDIR(status.st_mode) and status.st_mode & stat.S_ISVTX
    why = _complaint(status, path, 0 if sticky or stat.S_ISLNK(status.st_mode) else stat.S_IWGRP | stat.S_IWOTH)
    if why is not None:
        raise UntrustedCache(why)


def _complaint(status: os.stat_result, path: Path, forbidden: int = stat.S_IWGRP | stat.S_IWOTH) -> str | None:
    if status.st_uid not in (0, os.geteuid()):
        return f"{path} belongs to user {status.st_uid}, who could replace the kernels: {FOLDER_REMEDY}"
    if status.st_mode & forbidden:
        return f"{path} can be written by other users: chmod go-w it, or {FOLDER_REMEDY}"
    return None


def _reason(error: Exception) -> str:
    return str(error.strerror if isinstance(error, OSError) and error.strerror else error)


KERNEL_SOURCES: Final[dict[Any, dict[str, str | None]]] = {}
"""Source files outside of this program with the kernels of each kind of node, and their `sources_of`."""


def written_in(kind: Any, file: str) -> None:
    """Record that a file has a kernel for a kind of node, so that an edit of the file invalidates cached kernels.

    The file's package counts too, and so does the module of the class. Call this when the kernel is defined, before the
    file can differ from the imported code. Files of this program are ignored: the name of the cache folder covers them.
    """
    module = getattr(sys.modules.get(getattr(kind, "__module__", "")), "__file__", None)
    for name in {file, file if module is None else module}:
        if not name.startswith(_PROGRAM):
            KERNEL_SOURCES.setdefault(kind, {})[name] = sources_of(name)


def kinds_in(signature: Any) -> list[Any]:
    """Return the classes of the named tuples in a signature, each once, in order of appearance."""
    kinds: dict[Any, None] = {}

    def walk(each: Any) -> None:
        if isinstance(each, types.BaseTuple):
            if isinstance(each, types.BaseNamedTuple):
                kinds[each.instance_class] = None
            for part in each:
                walk(part)
        elif isinstance(each, types.TypeRef):  # a type passed as an argument
            walk(each.instance_type)
        elif (like := getattr(each, "like", None)) is not None:  # rows.py: several trees of that type
            walk(like)

    for argument in signature if isinstance(signature, tuple) else signature.args:
        walk(argument)
    return list(kinds)


def sources_of(file: str) -> str | None:
    """Return a hash over the file of a kernel and everything else that it may inline; None without a file.

    That is its package or, within this program, its folder. A file that has changed is read again: a module that is
    imported late may have been edited since. Files in KERNEL_FOLDERS count only by themselves, because the name of the
    cache folder covers them wherever the program is installed.
    """
    try:
        status = os.stat(file)
        return _sources(file, status.st_ino, status.st_mtime_ns, status.st_size)
    except OSError:
        return None


@cache
def _sources(file: str, *version: int) -> str:
    own = _digest(file).hex()
    if file.startswith(_KERNEL_PATHS):
        return own
    top = Path(file).parent
    if not file.startswith(_PROGRAM):
        while (top.parent / "__init__.py").is_file():
            top = top.parent
    return own + (_package(top) if (top / "__init__.py").is_file() else "")


@cache
def _package(top: Path) -> str:
    digest = hashlib.sha256()
    for file in sorted(top.rglob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def hash_of_sources(folders: Iterable[str]) -> str:
    """Return a hash over every source file of these folders of the program, in the order of their paths."""
    paths = sorted(
        f"{parent}{os.sep}{name}"
        for top in folders
        for parent, _, names in os.walk(_PROGRAM + top)
        for name in names
        if name.endswith(".py")
    )
    return hashlib.sha256(b"".join(_digest(path) for path in paths if path != _OWN_FILE)).hexdigest()


def _digest(path: str) -> bytes:
    with open(path, "rb", buffering=0) as file:
        return hashlib.sha256(file.readall()).digest()
