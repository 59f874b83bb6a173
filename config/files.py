"""Opening of files that a user names, for reading and writing, and the check of their owner.

A name may lead to anything: a pipe without a writer, a device without an end, a link that another user planted. The
type is checked before a byte is read, on the descriptor and not on the name, which may mean another file a moment
later. A refused file raises OSError with a reason in words, like a missing file.
"""

from __future__ import annotations

import errno
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Final

from softfinger.config.errors import ConfigError, Exhausted, HapticError

LINKS_MAX: Final = 40
FULL_DISK: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Reasons for which a disk accepts no more data: no room, the quota of the user, the limit of a file's size."""
_KINDS: Final = {stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket", stat.S_IFCHR: "a device", stat.S_IFBLK: "a disk"}


def find_home_folder() -> Path | None:
    """Return the home folder of this user; None if neither HOME nor passwd has one, as for the user of a container."""
    try:
        return Path.home()
    except RuntimeError:
        return None


def expand_home(path: str) -> Path:
    """Replace a leading ~ by the home folder; for a user without one, the path does not change."""
    return Path(os.path.expanduser(path))


def open_input(path: str | Path, size_max: int | None = None) -> IO[bytes]:
    """Open a regular file of at most `size_max` bytes for reading; raises OSError for other files, without waiting."""
    fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    try:
        status = os.fstat(fd)
        _check_kind(status.st_mode, "read")
        if size_max is not None and status.st_size > size_max:
            raise OSError(errno.EFBIG, f"has {status.st_size:,} bytes, at most {size_max:,} are allowed")
    except BaseException:
        os.close(fd)
        raise
    return open(fd, "rb")


def read_input(path: str | Path, size_max: int) -> bytes:
    """Read a regular file of at most `size_max` bytes; raises OSError for other files."""
    with open_input(path, size_max) as file:
        data = file.read(size_max + 1)  # files under /proc have the size 0, and a growing file has an outdated one
    if len(data) > size_max:
        raise OSError(errno.EFBIG, f"has more than {size_max:,} bytes, the limit for reading")
    return data


@contextmanager
def write_new_file(path: str | Path) -> Iterator[IO[bytes]]:
    """Open a file that appears under its name only when the block ends without an error, and then complete.

    Until then it has an unpredictable name. If the path is a link, its target is replaced and the link remains. Raises
    OSError for an existing pipe or device: root would replace /dev/null by a file.
    """
    target = follow_links(path)
    with suppress(FileNotFoundError):
        _check_kind(os.lstat(target).st_mode, "replaced")
    part = target.with_name(f".{secrets.token_hex(8)}.part")
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
    try:
        with open(os.open(part, flags, 0o666), "w+b") as file:
            yield file
        os.replace(part, target)
    except OSError as error:
        if error.filename in (None, str(part)):  # none: a refused write
            error.filename = str(path)
        raise
    finally:
        with suppress(OSError):  # none, or on a disk that became read-only
            part.unlink()


def make_write_error(name: str | Path, error: OSError, remedy: str) -> HapticError:
    """Return the error for a file that cannot be written: Exhausted if the disk is full, otherwise ConfigError."""
    kind = Exhausted if error.errno in FULL_DISK else ConfigError
    return kind(f"{name}: cannot be written: {error.strerror or error}: {remedy}")


def open_recording(path: str | Path, folder: str | Path | None = None) -> IO[bytes]:
    """Create a file for data that must not be lost: unbuffered, and new; raises OSError if the file exists.

    With `folder`, the path comes from another party: it is opened only below that folder, without any link or `..`.
    """
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
    if folder is None:
        return open(path, "wb", 0, opener=lambda name, _: os.open(name, flags, 0o666))
    *parents, name = Path(path).parts or ("",)
    if Path(path).is_absolute() or ".." in (*parents, name) or not name:
        raise OSError(errno.EACCES, "must be inside the folder of recordings, without .. and not absolute")
    at = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        for parent in parents:
            below = os.open(parent, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=at)
            os.close(at)
            at = below
        return open(Path(folder, path), "wb", 0, opener=lambda *_: os.open(name, flags, 0o666, dir_fd=at))
    finally:
        os.close(at)


def is_same_file(first_path: str | Path, second_path: str | Path) -> bool:
    """Return whether two names lead to one file, which need not exist."""
    try:
        return os.path.samefile(first_path, second_path)
    except (OSError, ValueError):
        return os.path.realpath(first_path) == os.path.realpath(second_path)


def follow_links(path: str | Path) -> Path:
    """Return the target of a path after links of this user, of root, or of the owner of the folder they are in.

    Raises OSError for a link of another user in a shared folder such as /tmp: it would choose which file is
    overwritten.
    """
    at = Path(path)
    for _ in range(LINKS_MAX):
        try:
            status = os.lstat(at)
        except FileNotFoundError:
            return at
        if not stat.S_ISLNK(status.st_mode):
            return at
        if status.st_uid not in (0, os.geteuid(), os.stat(at.parent).st_uid):
            raise OSError(errno.ELOOP, f"{at} is a link that user {status.st_uid} made")
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

    why  the possible misuse, for the message
    """
    if status.st_uid not in (0, os.geteuid()):
        raise ConfigError(
            f"{path}: belongs to another user ({status.st_uid}), who {why}: use a folder that belongs to you"
        )
    # The sticky bit, as of /tmp, prevents users from replacing files of other users.
    is_sticky = stat.S_ISDIR(status.st_mode) and status.st_mode & stat.S_ISVTX
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH) and not is_sticky:
        raise ConfigError(
            f"{path}: other users may write to it (mode {stat.S_IMODE(status.st_mode):o}), and so {why}: chmod go-w it"
        )
