"""Debian kernel to boot: image and required modules of the package that apt names."""

import lzma
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

META_PACKAGE = "linux-image-amd64"
"""Depends on the latest kernel. The kernels for clouds have no dummy_hcd."""

WANTED = (
    *("virtio_pci", "9pnet_virtio", "9p", "overlay"),
    *("dummy_hcd", "libcomposite", "usb_f_fs", "usb_f_hid", "usb_f_acm", "cdc-acm"),
    *("hid-generic", "usbhid", "uhid"),
)
"""The file systems of this machine, and one above them; a bus with both ends in the guest, and the drivers of each."""


class VmError(Exception):
    """The virtual machine cannot be made; the message contains instructions."""


class Kernel(NamedTuple):
    """An image and its modules, in an order in which they can be loaded."""

    package: str
    image: Path
    modules: tuple[Path, ...]


def find(cache: Path, package: str | None = None) -> Kernel:
    """Return the kernel of `package`, or the latest one that apt knows; from `cache` if it is there.

    Raises VmError if apt has none, or if it lacks a module.
    """
    name = package or newest()
    folder = cache / name
    wanted = folder / "wanted"  # names of the modules in this folder
    if not wanted.exists() or tuple(wanted.read_text().split()) != WANTED:
        unpack(name, folder)
    order = (folder / "order").read_text().split()
    return Kernel(name, folder / "vmlinuz", tuple(folder / module for module in order))


def newest() -> str:
    output = _output("apt-cache", "depends", META_PACKAGE)
    match = re.search(r"Depends: (linux-image-\d\S+)", output)
    if match is None:
        raise VmError(f"apt knows no kernel ({META_PACKAGE}): run `apt-get update`, or name one with --kernel")
    return match[1]


def unpack(package: str, folder: Path) -> None:
    """Download a kernel package, and copy its image and modules to `folder`."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix="unpacking-") as name:
        work = Path(name)
        _output("apt-get", "download", "-qq", package, cwd=work)
        (archive,) = work.glob("*.deb")
        whole, reduced = work / "whole", work / "kept"
        _output("dpkg-deb", "-x", str(archive), str(whole))
        reduced.mkdir()
        (image,) = (whole / "boot").glob("vmlinuz-*")
        shutil.copy(image, reduced / "vmlinuz")
        (tree,) = whole.glob("**/lib/modules/*")
        order = [_keep(path, reduced) for path in in_order(tree, WANTED, package)]
        (reduced / "order").write_text("\n".join(order))
        (reduced / "wanted").write_text("\n".join(WANTED))
        if folder.exists():
            shutil.rmtree(folder)
        reduced.rename(folder)


def in_order(tree: Path, wanted: tuple[str, ...], package: str) -> list[Path]:
    """Return the modules `wanted` below a kernel's folder of modules, each after its dependencies."""
    files = {_name(path): path for path in tree.rglob("*.ko*")}
    built_in = {_name(Path(line)) for line in (tree / "modules.builtin").read_text().split()}
    ordered: dict[str, Path] = {}

    def add(module: str) -> None:
        name = module.replace("-", "_")
        if name in ordered or name in built_in:
            return
        if name not in files:
            raise VmError(f"{package} has no module {module}: name another package with --kernel, not one for clouds")
        for dependency in _depends(files[name]):
            add(dependency)
        ordered[name] = files[name]

    for module in wanted:
        add(module)
    return list(ordered.values())


def _name(path: Path) -> str:
    return path.name.split(".ko")[0].replace("-", "_")


def _depends(path: Path) -> Iterator[str]:
    """Yield the dependencies of a module, from its .modinfo."""
    match = re.search(rb"\0depends=([^\0]*)\0", _read(path))
    yield from filter(None, match[1].decode().split(",")) if match else ()


def _read(path: Path) -> bytes:
    data = path.read_bytes()
    return lzma.decompress(data) if path.suffix == ".xz" else data


def _keep(path: Path, folder: Path) -> str:
    name = f"{_name(path)}.ko"
    (folder / name).write_bytes(_read(path))
    return name


def _output(*command: str, cwd: Path | None = None) -> str:
    try:
        process = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
    except FileNotFoundError as error:
        raise VmError(f"{command[0]} is not installed: the virtual machine boots a kernel of Debian") from error
    if process.returncode != 0:
        raise VmError(f"{' '.join(command)}: {process.stderr.strip() or f'exit {process.returncode}'}")
    return process.stdout
