"""Boot a Debian kernel in QEMU with this machine's files, and run the tests of tests/vm in it: `make test-vm`.

    python tests/vm/run.py [--kernel PACKAGE] [--limit SECONDS] [--busy] [--plain COMMAND] [--systemd] [pytest's words]

Needs no KVM, and for the drivers no privilege: the processor is emulated, some twenty times slower than this one. The
tests of drivers (`on_*.py`) and those of the service (`under_systemd.py`), which need systemd as the first process and
a writable file system, run in separate machines. The exit code is that of the tests; 124 if they exceeded the limit, 1
if the machine could not be made or ended without a result.
"""

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
UDEV, SYSTEMD = "/lib/systemd/systemd-udevd", "/lib/systemd/systemd"
MEMORY_MB = 2048
PARALLEL = ("-accel", "tcg,thread=multi", "-smp", "2")
COUNTED = ("-accel", "tcg", "-smp", "1", "-icount", "shift=1")
"""One processor, and a clock that counts instructions of 2 ns: time limits of the tests and of the service do not
depend on the load of this machine. Slower than without it."""
LIMIT_S = 1500.0
SILENCE_S = 20.0
"""Time without a line from the guest after which the elapsed time is printed."""
SYSTEMD_TESTS = "under_systemd.py"
TIMED_OUT = 124
NOT_ASKED_FOR = 5
"""Exit code of pytest if no test was selected."""
NO_WORD = 1


def cache_folder() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "softfinger-vm"


def main() -> int:
    parser = argparse.ArgumentParser(description="The tests of tests/vm, in a virtual machine with a true USB stack.")
    parser.add_argument("--kernel", help=f"Debian package of the kernel (default: what {kernel.META_PACKAGE} names)")
    parser.add_argument("--limit", type=float, default=LIMIT_S, help="seconds, then it is ended (default: %(default)g)")
    parser.add_argument("--busy", action="store_true", help="stop the guest's clock while it waits for a processor")
    parser.add_argument("--plain", metavar="COMMAND", help="run this in the guest's shell in place of the tests")
    parser.add_argument("--systemd", action="store_true", help="with --plain: a guest whose first process is systemd")
    args, words = parser.parse_known_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # ends the emulator, too
    try:
        if args.plain:
            return boot(args, args.plain, args.systemd)
        commands = [(tests(words, systemd), systemd) for systemd in (False, True)]
        codes = [boot(args, shlex.join(command), systemd) for command, systemd in commands if command]
        return max(code for code in codes if code != NOT_ASKED_FOR or set(codes) == {NOT_ASKED_FOR})
    except kernel.VmError as error:
        print(f"vm: {error}", file=sys.stderr)
        return NO_WORD


def tests(words: list[str], systemd: bool) -> list[str]:
    """Return the command of a guest, with or without systemd; empty if none of the named tests is for it."""
    named = [word for word in words if Path(word.split("::")[0]).exists()]
    modules = named or [*sorted(map(str, Path("tests/vm").glob("on_*.py"))), f"tests/vm/{SYSTEMD_TESTS}"]
    modules = [module for module in modules if (SYSTEMD_TESTS in module) == systemd]
    others = [word for word in words if word not in named]
    if systemd:
        others.append("--noconftest")  # the service's tests do not need it, and cannot be repeated
    # A fork of the tests (guest.py) inherits a started timer without its thread, and its own timer would wait for that
    # thread forever. Tests in the guest have other time limits.
    options = ("-p", "no:cacheprovider", "-o", "faulthandler_timeout=0")
    return [sys.executable, "-m", "pytest", *options, *others, *modules] if modules else []


def boot(args: argparse.Namespace, command: str, systemd: bool) -> int:
    """Make the machine, run the command in it, and return the exit code."""
    limit_s: float = args.limit
    for needed in (QEMU, UDEV, *([SYSTEMD] if systemd else [])):
        if shutil.which(needed) is None:
            raise kernel.VmError(f"{needed} is not installed: make vm-packages")
    if systemd and not os.access("/etc/shadow", os.R_OK):
        raise kernel.VmError(
            "the guest of the service makes an account, and reads /etc/shadow for it: run this as root"
        )
    cache = cache_folder()
    with step("1/4 kernel"):
        linux = kernel.find(cache, args.kernel)
    environment = guest_environment()
    with step("2/4 kernels of softfinger, for the guest's processor"):
        warm(cache / "kernels", environment)
    with tempfile.TemporaryDirectory(prefix="softfinger-vm-") as name:
        folder = Path(name)
        with step(f"3/4 first file system of {linux.package}"):
            (folder / "initramfs").write_bytes(initramfs.build(linux))
        shared = folder / "shared"
        shutil.copytree(cache / "kernels", shared / "kernels")
        if systemd:
            install_wheel(shared / "wheel")
        exports = "".join(f"export {key}={shlex.quote(value)}\n" for key, value in environment.items())
        (shared / "command").write_text(f"{exports}cd {shlex.quote(str(ROOT))}\n{command}\n")
        log(f"4/4 {QEMU}, at most {limit_s:g} s")
        ended = stream([*qemu(linux, folder, systemd), *(COUNTED if args.busy else PARALLEL)], limit_s)
        if not ended:
            log(f"ended after {limit_s:g} s: --limit gives more")
            return TIMED_OUT
        try:
            return int((shared / "code").read_text())
        except (OSError, ValueError):
            log("the guest ended without a word")
            return NO_WORD


def guest_environment() -> dict[str, str]:
    """Return the variables of the guest. Kernels compiled for a generic processor run here and in the guest."""
    keys = ("PYTHONPATH", "PYTHONDONTWRITEBYTECODE", "VIRTUAL_ENV")
    inherited = {key: os.environ[key] for key in keys if key in os.environ}
    return inherited | {
        "PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin",
        "HOME": "/run/tmp",
        "TMPDIR": "/run/tmp",
        "LANG": "C.UTF-8",
        "NUMBA_CPU_NAME": "generic",
        "SOFTFINGER_CACHE_DIR": "/run/kernels",
        # The search for plugins takes seconds.
        "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
        "SOFTFINGER_VM": "1",
    }


def warm(folder: Path, environment: dict[str, str]) -> None:
    """Compile the kernels of the guest's tests here: under emulation, a compilation takes minutes."""
    changed = os.environ | environment | {"SOFTFINGER_CACHE_DIR": str(folder), "PATH": os.environ["PATH"]}
    for key in ("HOME", "TMPDIR"):
        changed[key] = os.environ.get(key, "/tmp")
    process = subprocess.run([sys.executable, TESTS / "vm/warm.py"], cwd=ROOT, env=changed, check=False)
    if process.returncode != 0:
        raise kernel.VmError(f"the kernels of softfinger cannot be compiled (exit {process.returncode})")


def install_wheel(folder: Path) -> None:
    """Install the program's wheel in a folder, as a user would, without this source tree."""
    pip = (sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-index", "--no-deps")
    process = subprocess.run([*pip, "--no-build-isolation", "--target", str(folder), str(ROOT)], check=False)
    if process.returncode != 0:
        raise kernel.VmError(f"the wheel cannot be built and installed (exit {process.returncode})")


def qemu(linux: kernel.Kernel, folder: Path, systemd: bool) -> list[str]:
    """Return the command of the emulator: one serial line, two folders, no network."""
    arguments = "console=ttyS0 quiet panic=-1 mitigations=off tsc=reliable"
    if systemd:
        arguments += " softfinger.systemd systemd.unit=vm.service systemd.show_status=no fstab=no"
    root = "local,path=/,mount_tag=host,security_model=none,readonly=on,multidevs=remap"
    shared = f"local,path={folder / 'shared'},mount_tag=vm,security_model=none"
    return [
        *(QEMU, "-machine", "q35", "-cpu", "max", "-m", str(MEMORY_MB)),
        *("-display", "none", "-serial", "stdio", "-monitor", "none", "-net", "none", "-no-reboot"),
        *("-kernel", str(linux.image), "-initrd", str(folder / "initramfs"), "-append", arguments),
        *("-virtfs", root, "-virtfs", shared),
    ]  # fmt: skip


def stream(command: list[str], limit_s: float) -> bool:
    """Run the emulator and print the guest's output; return False if it was killed at the limit."""
    begun = last = time.monotonic()
    machine = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
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
                log(f"{now - begun:.0f} s ...")

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


def log(text: str) -> None:
    print(f"vm: {text}", file=sys.stderr, flush=True)


@contextmanager
def step(description: str) -> Iterator[None]:
    """Print a step, and its duration at the end."""
    log(description)
    begun = time.monotonic()
    yield
    log(f"    {time.monotonic() - begun:.1f} s")


if __name__ == "__main__":
    sys.exit(main())
