"""First file system of the guest: busybox, the kernel's modules and scripts, as an archive that the kernel unpacks."""

import gzip
import stat
import struct
from pathlib import Path

from vm.kernel import Kernel, VmError

BUSYBOX = Path("/bin/busybox")
PT_INTERP = 3
SCRIPTS = {"init": "init.sh", "systemd.sh": "systemd.sh"}


def build(kernel: Kernel) -> bytes:
    """Build the archive. Raises VmError without a statically linked busybox."""
    if not BUSYBOX.exists():
        raise VmError("busybox is not installed: make vm-packages")
    busybox = BUSYBOX.read_bytes()
    if _interpreted(busybox):
        raise VmError(f"{BUSYBOX} needs libraries, which the guest does not have: make vm-packages")
    entries = [entry(folder, stat.S_IFDIR | 0o755) for folder in ("bin", "modules", "dev", "host", "above", "system")]
    entries.append(entry("bin/busybox", stat.S_IFREG | 0o755, busybox))
    entries.append(entry("bin/sh", stat.S_IFLNK | 0o777, b"busybox"))
    for name, source in SCRIPTS.items():
        entries.append(entry(name, stat.S_IFREG | 0o755, Path(__file__).with_name(source).read_bytes()))
    for number, path in enumerate(kernel.modules):
        entries.append(entry(f"modules/{number:02d}-{path.name}", stat.S_IFREG | 0o644, path.read_bytes()))
    entries.append(entry("TRAILER!!!", 0))
    return gzip.compress(b"".join(entries), compresslevel=1)


def entry(name: str, mode: int, data: bytes = b"") -> bytes:
    """Return one file of a cpio archive of the "newc" format (kernel's buffer-format.rst)."""
    title = name.encode() + b"\0"
    fields = (0, mode, 0, 0, 1, 0, len(data), 0, 0, 0, 0, len(title), 0)
    return _padded(b"070701" + b"".join(b"%08x" % field for field in fields) + title) + _padded(data)


def _interpreted(program: bytes) -> bool:
    """Return True if a program header of a 64 bit ELF program names a loader."""
    (at,) = struct.unpack_from("<Q", program, 32)
    size, count = struct.unpack_from("<HH", program, 54)
    return any(struct.unpack_from("<I", program, at + k * size)[0] == PT_INTERP for k in range(count))


def _padded(data: bytes) -> bytes:
    return data + b"\0" * (-len(data) % 4)
