"""Compiled kernels on disk: loaded only from a folder that nobody else can write to, and only whole.

A kept kernel is a pickle of machine code: whoever can write one runs code as whoever loads it, and a flipped
bit is another force. So two things are asked before a byte is unpickled. The folder, every folder above it and
the file belong to this user or to root and can be written by no other: that keeps attackers out. The file's
checksum is right: that keeps damage out, and no more, for an attacker can compute one. What fails either is
compiled anew. numba's own files are not used: it looks for other folders where the named one cannot be
written to, trusts what it finds there, and ends the program when a file is damaged or the disk is full.
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
OWN_FOLDER: Final = "set SOFTFINGER_CACHE_DIR to a folder of your own"

_PROGRAM: Final = f"{Path(__file__).parents[3]}{os.sep}"

KERNEL_FOLDERS: Final = ("drivers", "proxy", "server/loop", "server/offline", "server/wire/native")
"""Where kernels are written, with the constants that they read, but for those of `tools`: their sources name the
cache's folder."""

log: Final = logging.getLogger(__name__)


class Unsound(Exception):
    """Why nothing is loaded from a folder; what to do is in the text."""


class Folder:
    """The folder `path` of kept kernels; None: there is none. It is made, and looked at, when first used.

    unkept  what it means that nothing can be kept there, for the log
    """

    def __init__(
        self, path: Path | None, unkept: str = "compiled kernels are not kept, so every start compiles them"
    ) -> None:
        self.path, self._unkept = path, unkept
        self._problem: str | None = None
        self._looked = self._said = False

    def problem(self) -> str | None:
        """Why kernels are not kept and what to do, or None. What could not be written since counts, too."""
        if not self._looked:
            try:
                if self.path is None:
                    raise Unsound(f"this user has no home folder: {OWN_FOLDER}")
                make_private(self.path)
            except Unsound as error:
                self._problem = str(error)
            except (OSError, ValueError) as error:
                self._problem = f"{self.path} cannot be made: {_reason(error)}: {OWN_FOLDER}"
            self._looked = True  # last: another thread that finds it set trusts the folder
        return self._problem

    def read(self, name: str) -> bytes | None:
        """What was kept under a name; None if it is not there, or not sound."""
        if self.path is None or self.problem() is not None:
            return None
        try:
            with self.opened(name) as file:
                data = file.read()
            head = len(MAGIC) + hashlib.sha256().digest_size
            body = data[head:]
            if data[:head] != MAGIC + hashlib.sha256(body).digest():
                raise Unsound("damaged")
        except FileNotFoundError:
            return None
        except (Unsound, OSError) as error:
            self.reject(name, error)
            return None
        return body

    def opened(self, name: str) -> IO[bytes]:
        """What was kept under a name, to be read; FileNotFoundError, OSError, or Unsound if others can write to it."""
        why = self.problem()
        if why is not None or self.path is None:
            raise Unsound(why)
        path = self.path / name
        fd = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
        found = os.fstat(fd)
        if not stat.S_ISREG(found.st_mode) or _complaint(found, path) is not None:
            os.close(fd)
            raise Unsound("not a file of this user alone")
        return open(fd, "rb")

    def reject(self, name: str, why: Exception) -> None:
        """Say that what is kept under a name is not used."""
        log.warning("kept kernel %s is not used but compiled anew: %s", name, _reason(why))

    def write(self, name: str, body: bytes) -> None:
        """Keep `body` under a name, for `read`."""
        self.put(name, [MAGIC, hashlib.sha256(body).digest(), body])

    def put(self, name: str, parts: Iterable[Any]) -> None:
        """Keep bytes under a name, whole or not at all, for `opened`. Where that cannot be it is said, once."""
        if self.problem() is None and self.path is not None:
            part = self.path / f".{secrets.token_hex(8)}.part"
            try:
                flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
                with open(os.open(part, flags, 0o600), "wb") as file:
                    file.writelines(parts)
                os.replace(part, self.path / name)
            except OSError as error:
                self._problem = f"{self.path} cannot be written to: {_reason(error)}: make room, or {OWN_FOLDER}"
                part.unlink(missing_ok=True)
        if self._problem is not None and not self._said:
            self._said = True
            log.warning("%s: %s", self._unkept, self._problem)


def make_private(folder: Path) -> None:
    """Make a folder that no other user can change, its missing parents too; Unsound where it cannot be one.

    From the top down: what has been checked nobody else can change, so what is below it stays what it was.
    """
    at, ways, links = Path("/"), list(reversed(folder.absolute().parts[1:])), 0
    _check(os.lstat(at), at)
    while ways:
        name = ways.pop()
        at = at.parent if name == ".." else at / name
        try:
            found = os.lstat(at)
        except FileNotFoundError:
            with contextlib.suppress(FileExistsError):  # another process has made it since
                os.mkdir(at, 0o700)
            found = os.lstat(at)
        _check(found, at)
        if stat.S_ISLNK(found.st_mode):
            links += 1
            if links > LINKS_MAX:
                raise Unsound(f"{folder}: links without end: {OWN_FOLDER}")
            way = Path(os.readlink(at))
            ways += reversed(way.parts[1:] if way.is_absolute() else way.parts)
            at = Path("/") if way.is_absolute() else at.parent
        elif not stat.S_ISDIR(found.st_mode):
            raise Unsound(f"{at} is no folder: {OWN_FOLDER}")
    if why := _complaint(found, at):
        raise Unsound(why)


def _check(found: os.stat_result, path: Path) -> None:
    """A part of a path. Others may write to a sticky folder: what is ours in it they can neither move nor remove."""
    sticky = stat.S_ISDIR(found.st_mode) and found.st_mode & stat.S_ISVTX
    why = _complaint(found, path, 0 if sticky or stat.S_ISLNK(found.st_mode) else stat.S_IWGRP | stat.S_IWOTH)
    if why is not None:
        raise Unsound(why)


def _complaint(found: os.stat_result, path: Path, forbidden: int = stat.S_IWGRP | stat.S_IWOTH) -> str | None:
    if found.st_uid not in (0, os.geteuid()):
        return f"{path} belongs to user {found.st_uid}, who could put any program there: {OWN_FOLDER}"
    if found.st_mode & forbidden:
        return f"{path} can be written by other users: chmod go-w it, or {OWN_FOLDER}"
    return None


def _reason(error: Exception) -> str:
    return str(error.strerror if isinstance(error, OSError) and error.strerror else error)


WRITTEN: Final[dict[Any, dict[str, str | None]]] = {}
"""For each kind of node the files outside of this program that its kernels are written in, with their `sources_of`."""


def written_in(kind: Any, file: str) -> None:
    """A kernel of that kind is in a file: one kept for a scene of such nodes is not served after the file was edited.

    The file's package counts with it, and so does the module of the class. To be called as the kernel is defined,
    when the file is what Python has read. Files of this program are in the name of the folder already.
    """
    module = getattr(sys.modules.get(getattr(kind, "__module__", "")), "__file__", None)
    for name in {file, file if module is None else module}:
        if not name.startswith(_PROGRAM):
            WRITTEN.setdefault(kind, {})[name] = sources_of(Path(name))


def kinds_in(signature: Any) -> list[Any]:
    """Classes of the named tuples in a signature, each once, in the order in which they appear."""
    found: dict[Any, None] = {}

    def walk(each: Any) -> None:
        if isinstance(each, types.BaseTuple):
            if isinstance(each, types.BaseNamedTuple):
                found[each.instance_class] = None
            for part in each:
                walk(part)
        elif isinstance(each, types.TypeRef):  # a type that is given as an argument
            walk(each.instance_type)
        elif (like := getattr(each, "like", None)) is not None:  # rows.py: many trees of that type
            walk(like)

    for argument in signature if isinstance(signature, tuple) else signature.args:
        walk(argument)
    return list(found)


def sources_of(path: Path) -> str | None:
    """A hash over the file of a kernel and what else it may inline: the package that it is in, or, of this program, its
    own folder. None without a file.

    The file is read again for each kernel: a module imported late may have been edited since the others were. What is
    in one of KERNEL_FOLDERS is in the name of the cache's folder, wherever the program is installed.
    """
    top = path.parent
    if not str(path).startswith(_PROGRAM):
        while (top.parent / "__init__.py").is_file():
            top = top.parent
    named = str(path).startswith(tuple(f"{_PROGRAM}{folder}{os.sep}" for folder in KERNEL_FOLDERS))
    try:
        own = hashlib.sha256(path.read_bytes()).hexdigest()
        return own + (_package(top) if not named and (top / "__init__.py").is_file() else "")
    except OSError:
        return None


@cache
def _package(top: Path) -> str:
    digest = hashlib.sha256()
    for file in sorted(top.rglob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()
