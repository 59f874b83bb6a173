"""Files that a user names: one way to open them, one way to write them, and whose they have to be.

A name may lead to anything: a pipe that nobody writes to, a device that never ends, a link that another user
planted. What is opened is looked at before a byte is read, by its descriptor and not by its name, which may mean
another file a moment later. What is refused is an OSError with its reason in words, as a missing file is.
"""

from __future__ import annotations

import errno
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Final

from softfinger.config.errors import ConfigError

LINKS_MAX: Final = 40
_KINDS: Final = {
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a disk",
}


def home_folder() -> Path | None:
    """Home folder of this user; None if neither HOME nor passwd has one, as for the user of a container."""
    try:
        return Path.home()
    except RuntimeError:
        return None


def expanded(path: str) -> Path:
    """Replace a leading ~ by the home folder; a user without one gets the path as it is."""
    return Path(os.path.expanduser(path))


def open_input(path: str | Path, size_max: int | None = None) -> IO[bytes]:
    """A regular file to read from, of at most `size_max` bytes; OSError for anything else, without waiting for it."""
    fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    try:
        found = os.fstat(fd)
        _check_kind(found.st_mode, "read")
        if size_max is not None and found.st_size > size_max:
            raise OSError(errno.EFBIG, f"has {found.st_size:,} bytes, {size_max:,} are the most that are read")
    except BaseException:
        os.close(fd)
        raise
    return open(fd, "rb")


def read_input(path: str | Path, size_max: int) -> bytes:
    """All of a regular file of at most `size_max` bytes; OSError for anything else."""
    with open_input(path, size_max) as file:
        data = file.read(size_max + 1)  # a file under /proc has the size 0, and one that grows another than it had
    if len(data) > size_max:
        raise OSError(errno.EFBIG, f"has more than {size_max:,} bytes, the most that are read")
    return data


@contextmanager
def new_file(path: str | Path) -> Iterator[IO[bytes]]:
    """A file to write to that appears under its name when the block ends: whole, or not at all.

    Until then it has a name that nobody can foresee. A link keeps pointing at what is replaced.
    """
    target = followed(path)
    part = target.with_name(f".{secrets.token_hex(8)}.part")
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
    fd = os.open(part, flags, 0o666)
    try:
        with open(fd, "w+b") as file:
            yield file
        os.replace(part, target)
    finally:
        part.unlink(missing_ok=True)


def open_output(path: str | Path, buffering: int = -1) -> IO[bytes]:
    """A file to write to as one goes, emptied if it is there: what is written can be read before the end."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
    fd = os.open(followed(path), flags, 0o666)
    try:
        mode = os.fstat(fd).st_mode
        if not stat.S_ISCHR(mode):  # such as /dev/null
            _check_kind(mode, "written to")
            os.ftruncate(fd, 0)
    except BaseException:
        os.close(fd)
        raise
    return open(fd, "wb", buffering)


def open_recording(path: str | Path, folder: str | Path | None = None) -> IO[bytes]:
    """A new file for what must not be lost: unbuffered, and no file that is there already; OSError otherwise.

    With `folder` the path is somebody else's wish: it is followed below that folder only, past no link and no `..`.
    """
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
    if folder is None:
        return open(os.open(path, flags, 0o666), "wb", buffering=0)
    *parents, name = Path(path).parts or ("",)
    if Path(path).is_absolute() or ".." in (*parents, name) or not name:
        raise OSError(errno.EACCES, "must be below the folder of recordings: no absolute path and no ..")
    at = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        for parent in parents:
            below = os.open(parent, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=at)
            os.close(at)
            at = below
        return open(os.open(name, flags, 0o666, dir_fd=at), "wb", buffering=0)
    finally:
        os.close(at)


def is_same_file(one: str | Path, other: str | Path) -> bool:
    """Whether two names lead to one file, be it there or not."""
    try:
        return os.path.samefile(one, other)
    except (OSError, ValueError):
        return os.path.realpath(one) == os.path.realpath(other)


def followed(path: str | Path) -> Path:
    """What a name means after links of this user, of root, or of the owner of the folder they are in.

    A link of anybody else in a folder for all, such as /tmp, is refused: it would choose what is overwritten.
    """
    at = Path(path)
    for _ in range(LINKS_MAX):
        try:
            found = os.lstat(at)
        except FileNotFoundError:
            return at
        if not stat.S_ISLNK(found.st_mode):
            return at
        if found.st_uid not in (0, os.geteuid(), os.stat(at.parent).st_uid):
            raise OSError(errno.ELOOP, f"{at} is a link that user {found.st_uid} made")
        at = at.parent / os.readlink(at)
    raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))


def _check_kind(mode: int, use: str) -> None:
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if not stat.S_ISREG(mode):
        kind = _KINDS.get(stat.S_IFMT(mode), "something else")
        raise OSError(errno.EINVAL, f"is {kind}: only a regular file can be {use}")


def check_owner(path: str | Path, status: os.stat_result, why: str) -> None:
    """Raise ConfigError for a file or folder that another user may have filled.

    why  what another user could do with it
    """
    if status.st_uid not in (0, os.geteuid()):
        raise ConfigError(f"{path}: belongs to another user ({status.st_uid}), who {why}: use one of your own")
    # In a folder as /tmp is, nobody replaces what is not his.
    kept = stat.S_ISDIR(status.st_mode) and status.st_mode & stat.S_ISVTX
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH) and not kept:
        raise ConfigError(
            f"{path}: others may write to it (mode {stat.S_IMODE(status.st_mode):o}), and so {why}: chmod go-w it"
        )
