"""Endpoints of this program: validated, bound, protected against a second server, and freed."""

from __future__ import annotations

import errno
import fcntl
import ipaddress
import os
import socket
import stat
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final, NamedTuple

from softfinger.config.errors import AddressInUse, ConfigError
from softfinger.config.files import check_owner
from softfinger.config.schema import find_runtime_folder
from softfinger.drivers.closeable import undo_on_error
from softfinger.drivers.system.discovery import find_holder, read_process

LISTEN_BACKLOG: Final = 128
"""Connections that the system queues until they are accepted."""
LISTENING_STATE: Final = "0A"
"""State of a listening socket in proc_pid_net(5)."""


class BoundSocket(NamedTuple):
    """Listening socket, the stack that closes it and frees the endpoint, and the endpoint with its final port.

    file  its file; None for tcp
    """

    listener: socket.socket
    files: ExitStack
    endpoint: str
    file: SocketFile | None = None

    @property
    def fd(self) -> int:
        return self.listener.fileno()

    def rebind(self) -> bool:
        """Bind again, with the same descriptor, if the socket file was removed or replaced; return whether it was.

        Raises the errors of `listen`; then the next call tries again.
        """
        if self.file is None or self.file.is_bound():
            return False
        with _explain_refusal(self.endpoint, self.file.key), self.file.bind() as listener:
            listener.listen(LISTEN_BACKLOG)
            os.dup2(listener.fileno(), self.fd, inheritable=False)
        return True


def check_endpoint(endpoint: str, key: str, public: bool = False) -> None:
    """Raise ConfigError unless an endpoint may be bound: an ipc path, or tcp, on loopback unless `public`.

    key  name of the key with this value, for messages
    """
    scheme, _, address = endpoint.partition("://")
    if scheme == "ipc" and address and address[0] not in "@*":
        return
    if scheme == "ipc" and address:
        raise ConfigError(
            f"{key} = {endpoint!r} has no file, so no file mode can limit who connects: use ipc:///path/to/socket"
        )
    host, _, port = address.rpartition(":")
    if scheme != "tcp" or not host or not (port == "*" or (port.isdecimal() and int(port) < 65536)):
        raise ConfigError(
            f"{key} = {endpoint!r} is not an endpoint: "
            "use tcp://127.0.0.1:PORT (0 to 65535, or * for a free one) or ipc:///path/to/socket"
        )
    if not public and not _is_loopback(host):
        raise ConfigError(
            f"{key} = {endpoint!r} can be reached from other machines, which needs CURVE keys, but none "
            f"are configured: use tcp://127.0.0.1:{port} or an ipc:// path; docs/operate/network.md describes keys "
            "and access through an SSH tunnel"
        )


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def make_runtime_folder() -> None:
    """Create the folder, mode 700, if it is missing; raises ConfigError, also as `check_runtime_folder` does."""
    folder = find_runtime_folder()
    try:
        folder.mkdir(mode=0o700)
    except FileExistsError:
        pass  # its owner and type are checked in both cases
    except OSError as error:
        raise ConfigError(
            f"{folder}: cannot be created for the socket of commands: {error.strerror}; set XDG_RUNTIME_DIR "
            "to a folder that belongs to you, or set [commands] endpoint"
        ) from error
    check_runtime_folder()


def check_runtime_folder() -> None:
    """Raise ConfigError if the folder is a link or no folder, or if another user may have put a socket into it.

    A missing folder is valid.
    """
    folder = find_runtime_folder()
    try:
        status = folder.lstat()
    except FileNotFoundError:
        return
    except OSError as error:
        raise ConfigError(f"{folder}: {error.strerror}; set XDG_RUNTIME_DIR to a folder that belongs to you") from error
    if not stat.S_ISDIR(status.st_mode):
        raise ConfigError(
            f"{folder}: is not a folder: move it away, or set XDG_RUNTIME_DIR to a folder that belongs to you"
        )
    check_owner(folder, status, "could receive commands instead of the daemon")


def listen(endpoint: str, key: str, public: bool = False, private: bool = False) -> BoundSocket:
    """Bind an endpoint.

    key      key of the rig with this value, for messages
    public   whether other machines may reach it: then the server checks keys
    private  whether an ipc socket is for this user only; otherwise the group may connect, too

    Raises AddressInUse if another process uses the endpoint, ConfigError if it cannot or may not be bound.
    """
    check_endpoint(endpoint, key, public)
    scheme, _, address = endpoint.partition("://")
    file = SocketFile(Path(address), endpoint, key, private) if scheme == "ipc" else None
    with ExitStack() as files, _explain_refusal(endpoint, key):
        if file is not None:
            files.callback(file.close)
            listener = files.enter_context(file.bind())
        else:
            listener = files.enter_context(_listen_tcp(address))
            address = address.rpartition(":")[0] + f":{listener.getsockname()[1]}"
        listener.listen(LISTEN_BACKLOG)
        return BoundSocket(listener, files.pop_all(), f"{scheme}://{address}", file)


@contextmanager
def _explain_refusal(endpoint: str, key: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise _make_in_use_error(endpoint, key) from error
        raise ConfigError(f"{key} = {endpoint!r} cannot be bound: {error.strerror or error}; choose another") from error


def _listen_tcp(address: str) -> socket.socket:
    host, _, port = address.rpartition(":")
    listener = socket.socket(socket.AF_INET6 if "[" in host else socket.AF_INET)
    with undo_on_error(listener.close):
        # A port with connections in TIME_WAIT is free; one with a listener is not.
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        host = {"localhost": "127.0.0.1", "*": "0.0.0.0"}.get(host, host.strip("[]"))
        listener.bind((host, 0 if port == "*" else int(port)))
    return listener


class SocketFile:
    """File of an ipc socket, and the lock file next to it."""

    def __init__(self, path: Path, endpoint: str, key: str, private: bool) -> None:
        self.key: Final = key
        self._path, self._endpoint, self._private = path, endpoint, private
        self._folder_mode = 0o700
        self._lock_file: int | None = None
        self._status: os.stat_result | None = None

    def bind(self) -> socket.socket:
        """Lock and bind the path; also after the file, or its folder, was removed."""
        self._unlock()
        folder = self._path.parent
        if self._status is not None:
            folder.parent.mkdir(0o700, exist_ok=True)
            folder.mkdir(self._folder_mode, exist_ok=True)
        if folder == find_runtime_folder():
            make_runtime_folder()
        self._lock_file = _claim(self._path, self._endpoint, self.key)
        self._path.unlink(missing_ok=True)  # left by a server that has exited: this process has the lock
        listener = socket.socket(socket.AF_UNIX)
        with undo_on_error(listener.close):
            listener.bind(str(self._path))
            # Only the user, and the group unless `private`, may connect; nobody can before the caller listens.
            os.chmod(self._path, 0o600 if self._private else 0o660)
        self._status, self._folder_mode = self._path.lstat(), stat.S_IMODE(folder.stat().st_mode)
        return listener

    def is_bound(self) -> bool:
        """Return whether clients find this socket at its path, and other servers its lock."""
        if self._lock_file is None or self._status is None:
            return False
        try:
            lock = os.stat(f"{self._path}.lock", follow_symlinks=False)
            return os.path.samestat(self._path.lstat(), self._status) and os.path.samestat(
                lock, os.fstat(self._lock_file)
            )
        except OSError:
            return False

    def close(self) -> None:
        """Remove the file, unless it was replaced, and unlock the path."""
        if self.is_bound():
            self._path.unlink(missing_ok=True)
        self._unlock()

    def _unlock(self) -> None:
        if self._lock_file is not None:
            os.close(self._lock_file)
            self._lock_file = None


def _claim(path: Path, endpoint: str, key: str) -> int:
    """Lock `path`.lock, because a socket file does not show whether a server still listens on it.

    The lock file is never removed: otherwise two processes could lock two files of one name.
    """
    try:
        if os.path.lexists(path) and not stat.S_ISSOCK(path.lstat().st_mode):
            raise ConfigError(f"{key} = {endpoint!r}: {path} exists and is not a socket; choose another")
        # Another user may have planted a link in its place, to have another file created.
        lock_file = os.open(f"{path}.lock", os.O_CREAT | os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW, 0o660)
    except OSError as error:
        raise ConfigError(
            f"{key} = {endpoint!r} cannot be bound: {error}; choose a folder that you may write to"
        ) from error
    try:
        fcntl.flock(lock_file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(lock_file)
        raise _make_in_use_error(endpoint, key) from error
    return lock_file


def _make_in_use_error(endpoint: str, key: str) -> AddressInUse:
    scheme, _, address = endpoint.partition("://")
    program = find_holder(f"{address}.lock") if scheme == "ipc" else _find_listener(int(address.rpartition(":")[2]))
    free = "another path" if endpoint.startswith("ipc:") else "another port (tcp://127.0.0.1:* selects a free one)"
    return AddressInUse(
        f"{key} {endpoint} is in use: stop {program or 'the softfinger or other program that holds it'}, "
        f"or set {key} to {free}"
    )


def _find_listener(port: int) -> str:
    """Return the process that listens on a TCP port, as text for messages; empty if it belongs to another user."""
    sockets = _list_listening_sockets(port)
    for folder in Path("/proc").glob("[0-9]*/fd"):
        try:
            if any(os.readlink(entry) in sockets for entry in folder.iterdir()):
                return str(read_process(int(folder.parent.name)))
        except OSError:  # it has exited, or belongs to another user
            continue
    return ""


def _list_listening_sockets(port: int) -> set[str]:
    """Return the links in /proc/PID/fd of the sockets that listen on a port."""
    links = set()
    for table in ("tcp", "tcp6"):
        try:
            lines = Path("/proc/net", table).read_text().splitlines()[1:]
        except OSError:
            continue
        for words in map(str.split, lines):
            if words[3] == LISTENING_STATE and int(words[1].rpartition(":")[2], 16) == port:
                links.add(f"socket:[{words[9]}]")
    return links
