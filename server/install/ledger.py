"""Files that are written, recorded, and taken away again: those of others are not touched, edited ones are kept."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import secrets
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final, Literal, NamedTuple

from softfinger.config.errors import ConfigError

State = Literal["new", "unchanged", "outdated", "edited", "foreign"]

DONE: Final[dict[State, str]] = {"new": "written", "outdated": "renewed", "unchanged": "as it was"}


class File(NamedTuple):
    """A file to be: where, from the root of the system on, and its text."""

    path: Path
    text: str


class Act(NamedTuple):
    """What was done with a file, or why nothing was."""

    what: str
    path: Path


class Ledger:
    """What has been written below `root`, by the content of each file, as the file `record` has it.

    Raises ConfigError where the record cannot be read, and where something may not be written.
    """

    def __init__(self, root: Path, record: Path) -> None:
        self._root, self._record = root, record
        self._files: dict[str, str] = {}
        self._folders: list[str] = []
        try:
            kept = json.loads(self._at(record).read_bytes())
            self._files, self._folders = dict(kept["files"]), list(kept["folders"])
        except FileNotFoundError:
            pass
        except PermissionError as error:
            raise self._refused(record, error) from error
        except (ValueError, TypeError, KeyError) as error:
            raise ConfigError(
                f"{self._at(record)} is damaged ({error}): see what is in it, and move it away"
            ) from error

    @property
    def empty(self) -> bool:
        """Whether nothing is recorded."""
        return not self._files

    @property
    def paths(self) -> list[Path]:
        """What is recorded."""
        return [self._at(Path(path)) for path in self._files]

    def check(self, paths: Iterable[Path] = ()) -> None:
        """Raise ConfigError where what is recorded, or is to be at `paths`, may not be changed by this user."""
        for path in (*paths, *map(Path, self._files), self._record):
            self._check_writable(path)

    def state(self, file: File) -> State:
        """What writing a file would meet."""
        found = self._found(file.path)
        if found is None:
            return "new"
        if found == _digest(file.text.encode()):
            return "unchanged"
        known = self._files.get(str(file.path))
        return "foreign" if known is None else "outdated" if found == known else "edited"

    def write(self, files: Sequence[File]) -> Iterator[Act]:
        """Write what is not there, renew what was not edited, and take away what is not among the files any more.

        Nothing is written where a file is somebody else's, or may not be written.
        """
        states = [self.state(file) for file in files]
        if foreign := [file.path for file, state in zip(files, states, strict=True) if state == "foreign"]:
            raise ConfigError(
                f"{', '.join(str(self._at(path)) for path in foreign)}: there already, and not written by this "
                "command: move it away first; nothing was written"
            )
        self.check(file.path for file in files)
        named = {str(file.path) for file in files}
        try:
            yield from self._remove([path for path in self._files if path not in named])
            for file, state in zip(files, states, strict=True):
                if state == "edited":
                    yield Act("kept, for it was edited; move it away to have the new one:", self._at(file.path))
                    continue
                if state != "unchanged":
                    self._put(file.path, file.text)
                self._files[str(file.path)] = _digest(file.text.encode())
                yield Act(DONE[state], self._at(file.path))
        finally:
            self._save()

    def remove(self) -> Iterator[Act]:
        """Take away all that was written and not edited, then the folders made for it that are empty.

        Nothing is taken away where something may not be.
        """
        self.check()
        try:
            yield from self._remove(list(self._files))
        finally:
            self._save()

    def _remove(self, paths: Sequence[str]) -> Iterator[Act]:
        for path in paths:
            found = self._found(Path(path))
            if found is not None and found != self._files[path]:
                yield Act("kept, for it was edited; remove it yourself:", self._at(Path(path)))
                continue
            if found is not None:
                self._at(Path(path)).unlink()
            del self._files[path]
            yield Act("removed" if found is not None else "gone already:", self._at(Path(path)))

    def _save(self) -> None:
        if self._files:
            self._make(self._record.parent)  # first: it may be one of the folders
            self._put(self._record, json.dumps({"files": self._files, "folders": self._folders}, indent=1) + "\n")
            return
        self._at(self._record).unlink(missing_ok=True)
        for folder in sorted(self._folders, key=len, reverse=True):
            with contextlib.suppress(OSError):  # somebody else has put something into it
                self._at(Path(folder)).rmdir()

    def _put(self, path: Path, text: str) -> None:
        """A file whole or not at all, that everybody may read."""
        at = self._at(path)
        part = at.with_name(f".{at.name}.{secrets.token_hex(4)}")
        try:
            self._make(path.parent)
            with open(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o644), "wb") as file:
                os.fchmod(file.fileno(), 0o644)
                file.write(text.encode())
            os.replace(part, at)
        except OSError as error:
            with contextlib.suppress(OSError):
                part.unlink()
            raise self._refused(path, error) from error

    def _make(self, folder: Path) -> None:
        if folder == Path("/"):
            self._root.mkdir(parents=True, exist_ok=True)
        elif not self._at(folder).is_dir():
            self._make(folder.parent)
            self._at(folder).mkdir()
            self._at(folder).chmod(0o755)
            self._folders.append(str(folder))

    def _found(self, path: Path) -> str | None:
        """What is at a path, by its content; None for nothing. A link is somebody's word for another file."""
        at = self._at(path)
        try:
            return "no file" if at.is_symlink() or at.is_dir() else _digest(at.read_bytes())
        except FileNotFoundError:
            return None
        except OSError as error:
            raise self._refused(path, error) from error

    def _check_writable(self, path: Path) -> None:
        folder = self._at(path).parent
        while not folder.exists():
            folder = folder.parent
        if not os.access(folder, os.W_OK | os.X_OK, effective_ids=True):
            raise self._refused(path, PermissionError(13, "Permission denied"))

    def _refused(self, path: Path, error: OSError) -> ConfigError:
        return ConfigError(
            f"{self._at(path)} may not be changed by this user ({error.strerror}): what is for the whole machine takes "
            "root, so sudo; without --system it is for you alone"
        )

    def _at(self, path: Path) -> Path:
        return self._root / path.relative_to("/")


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
