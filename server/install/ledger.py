"""Installation of files with a record for removal, without changes to edited files and to files of other origin."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import secrets
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final, Literal, NamedTuple

from softfinger.config.errors import ConfigError, HapticError
from softfinger.config.files import make_write_error

State = Literal["new", "unchanged", "outdated", "edited", "foreign"]

ACTION_TEXTS: Final[dict[State, str]] = {"new": "written", "outdated": "renewed", "unchanged": "as it was"}


class File(NamedTuple):
    """File to install: absolute path on the installed system, and text."""

    path: Path
    text: str


class Ledger:
    """Record of the installed files below `root` with a hash of each content, stored in the file `record`.

    Raises ConfigError if the record cannot be read.
    """

    def __init__(self, root: Path, record: Path) -> None:
        self._root, self._record = root, record
        self._files: dict[str, str] = {}
        self._folders: list[str] = []
        try:
            recorded = json.loads(self._resolve(record).read_bytes())
            self._files, self._folders = dict(recorded["files"]), list(recorded["folders"])
        except FileNotFoundError:
            pass
        except PermissionError as error:
            raise self._make_error(record, error) from error
        except (ValueError, TypeError, KeyError) as error:
            raise ConfigError(
                f"{self._resolve(record)} is damaged ({error}): check its content, and move it away"
            ) from error

    @property
    def empty(self) -> bool:
        """True if nothing is recorded."""
        return not self._files

    @property
    def paths(self) -> list[Path]:
        return [self._resolve(Path(path)) for path in self._files]

    def check(self, paths: Iterable[Path] = ()) -> None:
        """Raise ConfigError if this user may not change a recorded file, the record, or one of `paths`."""
        for path in (*paths, *map(Path, self._files), self._record):
            folder = self._resolve(path).parent
            while not folder.exists():
                folder = folder.parent
            if not os.access(folder, os.W_OK | os.X_OK, effective_ids=True):
                raise self._make_error(path, PermissionError(13, "Permission denied"))

    def state(self, file: File) -> State:
        """Return how the file at the path of `file` compares with `file` and with the record."""
        digest = self._digest_at(file.path)
        if digest is None:
            return "new"
        if digest == _digest(file.text.encode()):
            return "unchanged"
        recorded_digest = self._files.get(str(file.path))
        return "foreign" if recorded_digest is None else "outdated" if digest == recorded_digest else "edited"

    def write(self, files: Sequence[File]) -> Iterator[str]:
        """Write new files, update unedited ones, remove recorded files that are not in `files`; yield each action.

        Raises ConfigError, before any change, if a file belongs to somebody else or may not be written.
        """
        states = [self.state(file) for file in files]
        if foreign := [file.path for file, state in zip(files, states, strict=True) if state == "foreign"]:
            raise ConfigError(
                f"{', '.join(str(self._resolve(path)) for path in foreign)}: already exists and was not written by "
                "this command: move it away first; nothing was written"
            )
        self.check(file.path for file in files)
        paths = {str(file.path) for file in files}
        try:
            yield from self._remove([path for path in self._files if path not in paths])
            for file, state in zip(files, states, strict=True):
                if state == "edited":
                    remedy = "edited, therefore not replaced; move it away to install the new one"
                    yield f"{remedy}: {self._resolve(file.path)}"
                    continue
                if state != "unchanged":
                    self._write_file(file.path, file.text)
                self._files[str(file.path)] = _digest(file.text.encode())
                yield f"{ACTION_TEXTS[state]} {self._resolve(file.path)}"
        finally:
            self._save()

    def remove(self) -> Iterator[str]:
        """Remove all unedited files that were written, then the empty folders made for them; yield each action.

        Raises ConfigError, before any change, if something may not be removed.
        """
        self.check()
        try:
            yield from self._remove(list(self._files))
        finally:
            self._save()

    def _remove(self, paths: Sequence[str]) -> Iterator[str]:
        for path in paths:
            digest = self._digest_at(Path(path))
            if digest is not None and digest != self._files[path]:
                yield f"edited, therefore not removed; remove it yourself: {self._resolve(Path(path))}"
                continue
            if digest is not None:
                self._resolve(Path(path)).unlink()
            del self._files[path]
            yield f"{'removed' if digest is not None else 'gone already:'} {self._resolve(Path(path))}"

    def _save(self) -> None:
        if self._files:
            self._make_folder(self._record.parent)  # first, since it may add to the recorded folders
            self._write_file(
                self._record, json.dumps({"files": self._files, "folders": self._folders}, indent=1) + "\n"
            )
            return
        self._resolve(self._record).unlink(missing_ok=True)
        for folder in sorted(self._folders, key=len, reverse=True):
            with contextlib.suppress(OSError):  # not empty: it has files of other origin
                self._resolve(Path(folder)).rmdir()

    def _write_file(self, path: Path, text: str) -> None:
        """Write a file atomically, readable by everybody."""
        at = self._resolve(path)
        part = at.with_name(f".{at.name}.{secrets.token_hex(4)}")
        try:
            self._make_folder(path.parent)
            with open(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o644), "wb") as file:
                os.fchmod(file.fileno(), 0o644)
                file.write(text.encode())
            os.replace(part, at)
        except OSError as error:
            with contextlib.suppress(OSError):
                part.unlink()
            raise self._make_error(path, error) from error

    def _make_folder(self, folder: Path) -> None:
        if folder == Path("/"):
            self._root.mkdir(parents=True, exist_ok=True)
        elif not self._resolve(folder).is_dir():
            self._make_folder(folder.parent)
            self._resolve(folder).mkdir()
            self._resolve(folder).chmod(0o755)
            self._folders.append(str(folder))

    def _digest_at(self, path: Path) -> str | None:
        """Return the digest of the content at a path, or None if it does not exist. Links are not followed."""
        at = self._resolve(path)
        try:
            return "no file" if at.is_symlink() or at.is_dir() else _digest(at.read_bytes())
        except FileNotFoundError:
            return None
        except OSError as error:
            raise self._make_error(path, error) from error

    def _make_error(self, path: Path, error: OSError) -> HapticError:
        if not isinstance(error, PermissionError):
            return make_write_error(self._resolve(path), error, "correct it and repeat the command")
        return ConfigError(
            f"{self._resolve(path)} may not be changed by this user ({error.strerror}): use sudo, or omit --system to "
            "install for this user; without --system the folder must belong to this user"
        )

    def _resolve(self, path: Path) -> Path:
        return self._root / path.relative_to("/")


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
