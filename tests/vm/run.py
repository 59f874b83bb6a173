"""Boot a Debian kernel in QEMU with this machine's files, and run the tests of tests/vm in it: `make test-vm`.

    python tests/vm/run.py [--kernel PACKAGE] [--limit SECONDS] [--plain COMMAND] [words for pytest ...]

Needs no privilege and no KVM: the processor is emulated, some twenty times slower than this one. The exit code is that
of the tests; 124 when they took longer than the limit, 1 when the machine could not be made or ended without a word.
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]
ROOT = TESTS.parent
sys.path.insert(0, str(TESTS))
from vm import initramfs, kernel  # noqa: E402

QEMU = "qemu-system-x86_64"
UDEV = "/lib/systemd/systemd-udevd"
MEMORY_MB = 2048
LIMIT_S = 1500.0
SILENCE_S = 20.0
"""After so long without a line from the guest, the time is said."""
TIMED_OUT = 124
NO_WORD = 1


def cache_folder() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "softfinger-vm"


def main() -> int:
    parser = argparse.ArgumentParser(description="The tests of tests/vm, in a virtual machine with a true USB stack.")
    parser.add_argument("--kernel", help=f"Debian package of the kernel (default: what {kernel.META_PACKAGE} names)")
    parser.add_argument("--limit", type=float, default=LIMIT_S, help="seconds, then it is ended (default: %(default)g)")
    parser.add_argument("--plain", metavar="COMMAND", help="run this in the guest's shell in place of the tests")
    args, words = parser.parse_known_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # so that the emulator goes too
    try:
        return boot(args.kernel, args.limit, args.plain or shlex.join(tests(words)))
    except kernel.VmError as error:
        print(f"vm: {error}", file=sys.stderr)
        return NO_WORD


def tests(words: list[str]) -> list[str]:
    """The command of the guest."""
    modules = (
        [] if any(Path(word.split("::")[0]).exists() for word in words) else sorted(Path("tests/vm").glob("on_*.py"))
    )
    return [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *words, *map(str, modules)]


def boot(package: str | None, limit_s: float, command: str) -> int:
    """Make the machine, run the command in it; the exit code."""
    for needed in (QEMU, UDEV):
        if shutil.which(needed) is None:
            raise kernel.VmError(f"{needed} is not installed: make vm-packages")
    cache = cache_folder()
    with step("1/4 kernel"):
        found = kernel.find(cache, package)
    environment = guest_environment()
    with step("2/4 kernels of softfinger, for the guest's processor"):
        warm(cache / "kernels", environment)
    with tempfile.TemporaryDirectory(prefix="softfinger-vm-") as name:
        folder = Path(name)
        with step(f"3/4 first file system of {found.package}"):
            (folder / "initramfs").write_bytes(initramfs.build(found))
        shared = folder / "shared"
        shutil.copytree(cache / "kernels", shared / "kernels")
        exports = "".join(f"export {key}={shlex.quote(value)}\n" for key, value in environment.items())
        (shared / "command").write_text(f"{exports}cd {shlex.quote(str(ROOT))}\n{command}\n")
        said(f"4/4 {QEMU}, at most {limit_s:g} s")
        ended = stream(qemu(found, folder), limit_s)
        if not ended:
            said(f"ended after {limit_s:g} s: --limit gives more")
            return TIMED_OUT
        try:
            code = int((shared / "code").read_text())
        except (OSError, ValueError):
            said("the guest ended without a word")
            return NO_WORD
        if (figures := shared / "figures").exists():
            print(f"measured on an emulated processor, {found.package}:\n{figures.read_text()}", end="")
        return code


def guest_environment() -> dict[str, str]:
    """Variables of the guest. Compiled for any processor, kernels of this machine serve in the guest."""
    keys = ("PYTHONPATH", "PYTHONDONTWRITEBYTECODE", "VIRTUAL_ENV")
    kept = {key: os.environ[key] for key in keys if key in os.environ}
    return kept | {
        "PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin",
        "HOME": "/run/tmp",
        "TMPDIR": "/run/tmp",
        "LANG": "C.UTF-8",
        "NUMBA_CPU_NAME": "generic",
        "SOFTFINGER_CACHE_DIR": "/run/kernels",
        # Not looked for, which takes seconds: the one that pyproject.toml has a setting of is named.
        "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
        "PYTEST_PLUGINS": "pytest_timeout",
        "SOFTFINGER_VM": "1",
    }


def warm(folder: Path, environment: dict[str, str]) -> None:
    """Compile for the guest what its tests run: emulated, a compilation takes minutes."""
    changed = os.environ | environment | {"SOFTFINGER_CACHE_DIR": str(folder), "PATH": os.environ["PATH"]}
    for key in ("HOME", "TMPDIR"):
        changed[key] = os.environ.get(key, "/tmp")
    done = subprocess.run([sys.executable, TESTS / "vm/warm.py"], cwd=ROOT, env=changed, check=False)
    if done.returncode != 0:
        raise kernel.VmError(f"the kernels of softfinger cannot be compiled (exit {done.returncode})")


def qemu(found: kernel.Kernel, folder: Path) -> list[str]:
    """The command of the emulator: one serial line, two folders, no network."""
    arguments = "console=ttyS0 quiet panic=-1 mitigations=off tsc=reliable"
    root = "local,path=/,mount_tag=host,security_model=none,readonly=on,multidevs=remap"
    shared = f"local,path={folder / 'shared'},mount_tag=vm,security_model=none"
    return [
        *(QEMU, "-machine", "q35", "-accel", "tcg,thread=multi", "-cpu", "max", "-smp", "2", "-m", str(MEMORY_MB)),
        *("-display", "none", "-serial", "stdio", "-monitor", "none", "-net", "none", "-no-reboot"),
        *("-kernel", str(found.image), "-initrd", str(folder / "initramfs"), "-append", arguments),
        *("-virtfs", root, "-virtfs", shared),
    ]  # fmt: skip


def stream(command: list[str], limit_s: float) -> bool:
    """Run the emulator and show what the guest prints; False when it had to be ended at the limit."""
    begun = last = time.monotonic()
    machine = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    assert machine.stdout is not None
    closing, late = threading.Event(), False

    def watch() -> None:
        nonlocal late, last
        while not closing.wait(1.0):
            now = time.monotonic()
            if now - begun > limit_s:
                late = True
                machine.kill()
                return
            if now - last > SILENCE_S:
                last = now
                said(f"{now - begun:.0f} s ...")

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        for line in machine.stdout:
            last = time.monotonic()
            print(line.decode(errors="replace").rstrip("\r\n"), flush=True)
        machine.wait()
    finally:
        closing.set()
        machine.kill()
        machine.wait()
        watcher.join()
    return not late


def said(text: str) -> None:
    print(f"vm: {text}", file=sys.stderr, flush=True)


@contextmanager
def step(what: str) -> Iterator[None]:
    """Say what is done, and how long it took."""
    said(what)
    begun = time.monotonic()
    yield
    said(f"    {time.monotonic() - begun:.1f} s")


if __name__ == "__main__":
    sys.exit(main())
