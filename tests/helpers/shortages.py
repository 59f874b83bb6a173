"""Shortages of this process: no room in files, no rights, no threads."""

import os
import resource
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

NOBODY = 65534
"""User without rights."""


@contextmanager
def file_size_limit(limit: int) -> Iterator[None]:
    """Refuse writes beyond this size of a file, as a full disk does."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@contextmanager
def without_rights(*modes: tuple[Path, int]) -> Iterator[None]:
    """Change the modes of files; if run as root, which ignores modes, act as another user meanwhile."""
    user, before = os.geteuid(), [(path, path.stat().st_mode) for path, _ in modes]
    for path, mode in modes:
        path.chmod(mode)
    if user == 0:
        os.seteuid(NOBODY)
    try:
        yield
    finally:
        os.seteuid(user)
        for path, mode in before:
            path.chmod(mode)


def refuse_threads(patch: pytest.MonkeyPatch, name: str | None = None) -> None:
    """Let no thread start, or none with this name."""
    start = threading.Thread.start

    def refuse(thread: threading.Thread) -> None:
        if name in (None, thread.name):
            raise RuntimeError("can't start new thread")
        start(thread)

    patch.setattr(threading.Thread, "start", refuse)
