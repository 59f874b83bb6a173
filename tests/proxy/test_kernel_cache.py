"""Compiled kernels on disk: their keys, which are loaded, which are refused, and that no problem with them prevents a
start. Uses real processes, a full disk, and real other users if the suite runs as root."""

import ast
import hashlib
import os
import pickle
import re
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numba
import pytest
from helpers.programs import run_program

from softfinger.proxy.kernels.jit import decorators
from softfinger.proxy.kernels.jit.cache import KERNEL_FOLDERS, MAGIC, Folder, UntrustedCache, kinds_in, make_private
from softfinger.proxy.kernels.jit.rows import Rows
from softfinger.proxy.kernels.model import Plane

STRANGER = 54321
"""A user without an entry in passwd."""
as_root = pytest.mark.skipif(os.geteuid() != 0, reason="makes files of other users")

INNER = """
from softfinger.proxy.kernels.jit.decorators import jit

FACTOR = 2.0

@jit
def scaled(x):
    return FACTOR * x
"""
OUTER = """
from inner import scaled
from softfinger.proxy.kernels.jit.decorators import entry

@entry
def kernel(x):
    return scaled(x) + 1.0

print(kernel(1.5), sum(kernel.stats.cache_hits.values()))
"""
ALLOCATES = """
import sys
import numpy as np
from numba import types
from softfinger.proxy.kernels.jit.decorators import c_function

@c_function(types.int64(types.int64))
def kernel(n):
    return np.zeros(n).size

compiler = {"numba.np.arraymath", "scipy.linalg"} & sys.modules.keys()
print(kernel.ctypes(1000), kernel.cache_hits, bool(compiler))
"""
PACKAGE_KERNELS = "import softfinger.drivers.replay.device as r; print('runs', r._read.address != 0)"
"""Imports a driver: four kernels with C addresses."""


@pytest.fixture
def scripts(tmp_path: Path) -> Path:
    folder = tmp_path / "scripts"
    folder.mkdir()
    (folder / "inner.py").write_text(INNER)
    (folder / "outer.py").write_text(OUTER)
    return folder


def start(
    program: Path | str, cache: Path | str, prepare: Callable[[], None] | None = None, **env: str | None
) -> tuple[str, str]:
    """Run a script or code in a new process; return its stdout and stderr. It must exit with 0."""
    command = [sys.executable, "-B", *(["-c", program] if isinstance(program, str) else [str(program)])]
    changed = {"SOFTFINGER_CACHE_DIR": str(cache), **env}
    environment = {k: v for k, v in (os.environ | changed).items() if v is not None}
    process = run_program(command, env=environment, preexec_fn=prepare, check=True)
    return process.stdout.strip(), process.stderr


def kernels(cache: Path) -> list[Path]:
    return sorted(path for path in cache.rglob("*.kernel") if not path.name.startswith("scaled-"))


def test_a_kernel_is_loaded_until_a_neighbouring_file_is_edited(scripts: Path, tmp_path: Path) -> None:
    """Folder and file are private. Editing a file of the same package, here an outside driver, compiles again. A cache
    hit imports neither numba's modules for compiling nor SciPy, which would dominate the start time."""
    (scripts / "__init__.py").touch()
    cache, outer = tmp_path / "cache", scripts / "outer.py"
    outer.write_text(f"import sys\n{OUTER}\nprint(bool({{'numba.np.arraymath', 'scipy.linalg'}} & sys.modules.keys()))")
    assert start(outer, cache) == ("4.0 0\nTrue", "") and start(outer, cache) == ("4.0 1\nFalse", "")
    (kernel,) = kernels(cache)
    for folder in (cache, kernel.parent):
        assert folder.stat().st_mode & 0o777 == 0o700
    assert kernel.stat().st_mode & 0o777 == 0o600
    inner = scripts / "inner.py"
    inner.write_text(inner.read_text().replace("FACTOR = 2.0", "FACTOR = 0.25"))
    assert start(outer, cache) == ("1.375 0\nTrue", "")


def test_a_cached_kernel_may_call_numba_s_allocator(tmp_path: Path) -> None:
    """LLVM would abort the process if the symbol of the allocator were missing."""
    script, cache = tmp_path / "allocates.py", tmp_path / "cache"
    script.write_text(ALLOCATES)
    assert start(script, cache) == ("1000 0 True", "") and start(script, cache) == ("1000 1 True", "")


def flip(place: float) -> Callable[[Path, bytes], object]:
    def change(kernel: Path, whole: bytes) -> None:
        data = bytearray(whole)
        data[int(place * len(data))] ^= 0x10
        kernel.write_bytes(data)

    return change


def lead_elsewhere(kernel: Path, whole: bytes) -> None:
    elsewhere = kernel.parents[2] / "elsewhere"
    elsewhere.write_bytes(whole)
    kernel.symlink_to(elsewhere)


def pickle_other(kernel: Path, whole: bytes) -> None:
    body = pickle.dumps("no kernel")
    kernel.write_bytes(MAGIC + hashlib.sha256(body).digest() + body)


DAMAGED: dict[str, Callable[[Path, bytes], object]] = {
    "first_bit": flip(0.0),
    "early_bit": flip(0.01),
    "middle_bit": flip(0.5),
    "last_bit": flip(0.999),
    "empty": lambda kernel, whole: kernel.touch(),
    "short": lambda kernel, whole: kernel.write_bytes(whole[: len(whole) // 2]),
    "fifo": lambda kernel, whole: os.mkfifo(kernel),
    "link": lead_elsewhere,
    "other_pickle": pickle_other,
}
"""Name of a kernel, and the damage to its cached file."""


def test_damaged_kernels_are_compiled_again(scripts: Path, tmp_path: Path) -> None:
    """Flipped bits, truncated and replaced files: each is named, compiled and cached again."""
    cache, script = tmp_path / "cache", scripts / "many.py"
    made = [f"@entry\ndef {name}(x):\n    return scaled(x) + 1.0\n" for name in DAMAGED]
    calls = [f"print({name}(1.5), sum({name}.stats.cache_hits.values()))" for name in DAMAGED]
    head = "from inner import scaled\nfrom softfinger.proxy.kernels.jit.decorators import entry\n"
    script.write_text("\n".join([head, *made, *calls]))
    assert start(script, cache) == ("\n".join(["4.0 0"] * len(DAMAGED)), "")
    by_name = {path.name.partition("-")[0]: path for path in kernels(cache)}
    assert by_name.keys() == DAMAGED.keys()
    for name, damage in DAMAGED.items():
        whole = by_name[name].read_bytes()
        if not name.endswith("_bit"):
            by_name[name].unlink()
        damage(by_name[name], whole)
    printed, log = start(script, cache)
    assert printed.splitlines() == ["4.0 0"] * len(DAMAGED)
    for name in DAMAGED:
        (line,) = (line for line in log.splitlines() if by_name[name].name in line)
        assert "compiled again" in line and ("damaged" in line or not name.endswith("_bit"))
    assert start(script, cache) == ("\n".join(["4.0 1"] * len(DAMAGED)), "")


def test_no_files_are_written_outside_the_cache(scripts: Path) -> None:
    printed, log = start(scripts / "outer.py", "/dev/null/none")
    assert printed == "4.0 0"
    assert log.count("not cached") == 1 and "SOFTFINGER_CACHE_DIR" in log
    assert sorted(path.name for path in scripts.rglob("*")) == ["inner.py", "outer.py"]


def test_a_program_runs_on_a_full_disk(tmp_path: Path) -> None:
    def no_room() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))

    printed, log = start(PACKAGE_KERNELS, tmp_path / "cache", no_room)
    assert printed == "runs True" and log.count("not cached") == 1 and "make room" in log
    assert not [path for path in (tmp_path / "cache").rglob("*") if path.is_file()]


@pytest.mark.exhaustive
def test_many_processes_may_start_at_once(scripts: Path, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    command = [sys.executable, "-B", str(scripts / "outer.py")]
    environment = os.environ | {"SOFTFINGER_CACHE_DIR": str(cache)}
    running = [subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) for _ in range(4)]
    assert [process.communicate(timeout=300)[0].split()[0] for process in running] == ["4.0"] * 4
    assert {path.suffix for path in cache.rglob("*") if path.is_file()} == {".kernel"}
    assert len(kernels(cache)) == 1 and start(scripts / "outer.py", cache) == ("4.0 1", "")


def test_a_program_runs_without_a_home(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    for name in ("HOME", "XDG_CACHE_HOME", "SOFTFINGER_CACHE_DIR"):
        monkeypatch.delenv(name, raising=False)
    with monkeypatch.context() as patch:
        patch.setattr("pwd.getpwuid", lambda uid: {}[uid])
        assert decorators._cache_root() is None
    problem = Folder(None).problem()
    assert problem is not None and "SOFTFINGER_CACHE_DIR" in problem
    unasked = Folder(None)
    for _ in range(2):
        unasked.write("a.kernel", b"")
    (log,) = caplog.messages
    assert "not cached" in log and problem in log


@as_root
def test_a_user_without_a_name_still_starts() -> None:
    def become() -> None:
        os.setgroups([])
        os.setgid(STRANGER)
        os.setuid(STRANGER)

    try:
        subprocess.run([sys.executable, "-c", "import numba"], check=True, preexec_fn=become, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("other users cannot read the files of this Python")
    nowhere = {"HOME": None, "XDG_CACHE_HOME": None, "SOFTFINGER_CACHE_DIR": None}
    printed, log = start(PACKAGE_KERNELS, "", become, **nowhere)
    assert printed == "runs True" and log.count("not cached") == 1 and "no home" in log


class Planted:
    def __init__(self, proof: Path) -> None:
        self.proof = proof

    def __reduce__(self) -> tuple[object, ...]:
        return os.mkdir, (str(self.proof),)


@as_root
def test_a_kernel_planted_by_another_user_is_not_run(scripts: Path, tmp_path: Path) -> None:
    """A pickle with a valid checksum is executed only if file and folder belong to the user. The first half shows that
    it would run otherwise; test_folders_that_others_may_write_to_are_refused checks parent folders."""
    cache, proof = tmp_path / "cache", tmp_path / "proof"
    start(scripts / "outer.py", cache)
    (kernel,) = kernels(cache)
    body = pickle.dumps(Planted(proof))
    kernel.write_bytes(MAGIC + hashlib.sha256(body).digest() + body)
    for whose in ("folder", "file"):
        shutil.copytree(cache, tmp_path / whose)
    start(scripts / "outer.py", cache)
    assert proof.is_dir()
    proof.rmdir()
    for whose in ("folder", "file"):
        (planted,) = kernels(tmp_path / whose)
        os.chown(planted.parent if whose == "folder" else planted, STRANGER, STRANGER)
        printed, log = start(scripts / "outer.py", tmp_path / whose)
        assert printed == "4.0 0" and not proof.exists()
        assert ("compiled again" if whose == "file" else f"belongs to user {STRANGER}") in log


def test_folders_that_others_may_write_to_are_refused(tmp_path: Path) -> None:
    for number, mode in enumerate((0o777, 0o775, 0o770, 0o1777)):
        folder = tmp_path / str(number)
        (folder / "own").mkdir(parents=True)
        folder.chmod(mode)
        with pytest.raises(UntrustedCache, match="can be written by other users"):
            make_private(folder)
        if mode & 0o1000:
            make_private(folder / "own")
            continue
        with pytest.raises(UntrustedCache, match="can be written by other users"):
            make_private(folder / "own")
        link = tmp_path / f"link-{number}"
        link.symlink_to(folder / "own")
        with pytest.raises(UntrustedCache, match="can be written by other users"):
            make_private(link)


def test_a_folder_created_concurrently_is_used(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    make = os.mkdir

    def second(path: Path, mode: int) -> None:
        make(path, mode)  # created by the other process
        make(path, mode)

    monkeypatch.setattr(os, "mkdir", second)
    folder = Folder(tmp_path / "new" / "kernels")
    assert folder.problem() is None and folder.path is not None and folder.path.is_dir()


def test_links_of_the_user_are_followed(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir(mode=0o700)
    (tmp_path / "link").symlink_to("disk")
    make_private(tmp_path / "link" / "new")
    assert (tmp_path / "disk" / "new").is_dir()
    (tmp_path / "circle").symlink_to("circle")
    with pytest.raises(UntrustedCache, match="without end"):
        make_private(tmp_path / "circle" / "new")


@as_root
def test_links_of_another_user_are_refused(tmp_path: Path) -> None:
    """In a folder writable by all, such as /tmp, a link of another user may be changed at any time."""
    (tmp_path / "shared").mkdir()
    (tmp_path / "shared").chmod(0o1777)
    (tmp_path / "ours").mkdir(mode=0o700)
    link = tmp_path / "shared" / "link"
    link.symlink_to(tmp_path / "ours")
    make_private(link)
    os.lchown(link, STRANGER, STRANGER)
    with pytest.raises(UntrustedCache, match=f"belongs to user {STRANGER}"):
        make_private(link)


def test_kinds_in_finds_a_class_in_any_signature() -> None:
    """A class is found in a tuple, in `Rows` and behind a TypeRef, so its file is part of the cache key."""
    plane = Plane((0.0, 0.0, 1.0), 0.0)
    for argument in (plane, (1.0, plane), Rows([plane, plane])):
        kind = numba.typeof(argument)
        assert Plane in kinds_in((kind,)) and Plane in kinds_in((numba.types.TypeRef(kind),))


ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("config", "drivers", "proxy", "server", "tools")
OURS = "softfinger."
KERNEL = re.compile(
    r"(jit|entry|outlined|outlined_where\(.*|by_\w+|c_function\(.*|\w+\.of\(.*|\w+\.otherwise)$", re.DOTALL
)
"""Decorators of kernels and of functions that select kernels."""


def hashed_with(file: str, module: str) -> bool:
    """Return True if an edit of a module invalidates the cached kernels of a file."""
    path = module.removeprefix(OURS).replace(".", "/")
    return f"{path}/".startswith(tuple(f"{folder}/" for folder in KERNEL_FOLDERS)) or (
        not file.startswith(tuple(f"{folder}/" for folder in KERNEL_FOLDERS))
        and Path(f"{path}.py").is_relative_to(Path(file).parent)
    )


def unseen(file: str, text: str) -> list[str]:
    tree, messages = ast.parse(text), []
    names = {
        alias.asname or alias.name: node.module
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(OURS)
        for alias in node.names
    }
    for function in ast.walk(tree):
        if isinstance(function, ast.FunctionDef) and any(map(KERNEL.match, map(ast.unparse, function.decorator_list))):
            used = {node.id for part in function.body for node in ast.walk(part) if isinstance(node, ast.Name)}
            lost = {name for name in used & names.keys() if not hashed_with(file, str(names[name]))}
            messages += [f"{file}: {function.name}: {name}" for name in sorted(lost)]
    return messages


@pytest.mark.plain
def test_names_in_kernels_are_from_hashed_sources() -> None:
    files = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
    texts = {str(path.relative_to(ROOT)): path.read_text("utf-8") for path in files}
    with_kernels = {file: text for file, text in texts.items() if f"{OURS}proxy.kernels.jit" in text}
    assert len(with_kernels) > 100
    assert [message for file, text in with_kernels.items() for message in unseen(file, text)] == []


SHOW = r"""
import os
import sys
from pathlib import Path
import numba
import numba.extending
package = Path(sys.argv[1])

def show():
    from softfinger.proxy.kernels.jit.decorators import CACHE_DIR
    from softfinger.proxy.kernels.jit.cache import sources_of
    print(CACHE_DIR, *(sources_of(str(package / name)) for name in sys.argv[2:]), sep="\n", flush=True)

for edited in sys.stdin:
    if edited.strip():
        with (package / edited.strip()).open("a") as text:
            text.write("\nTWICE = 2.0\n")
    child = os.fork()
    if child == 0:
        show()
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
"""
"""Prints the cache keys after each edit, each in a forked process that imports the package afresh."""


def test_an_edit_invalidates_only_the_kernels_it_concerns(tmp_path: Path) -> None:
    package = tmp_path / "softfinger"
    for folder in PACKAGES:
        shutil.copytree(ROOT / folder, package / folder, ignore=shutil.ignore_patterns("__pycache__"))
    moved_by = {
        "": [False, False, False, False],
        "proxy/kernels/friction/torsion.py": [True, False, False, False],
        "server/loop/guard.py": [True, False, False, False],
        "drivers/block.py": [True, False, False, False],
        "tools/accuracy/montana.py": [False, False, True, True],
        "server/verbs/shipped.py": [False, False, False, False],
    }
    site = os.pathsep.join([str(tmp_path), *[path for path in sys.path if path.endswith("site-packages")]])
    names = ["proxy/kernels/step.py", "tools/accuracy/measure.py", "tools/exchange.py"]
    # Without site: the installed package must not be imported first.
    command = [sys.executable, "-S", "-c", SHOW, str(package), *names]
    edits = "\n".join(["", *moved_by])
    process = run_program(command, env=os.environ | {"PYTHONPATH": site}, input=edits + "\n", check=True)
    lines = process.stdout.splitlines()
    runs = [lines[first : first + 1 + len(names)] for first in range(0, len(lines), 1 + len(names))]
    changes = [[old != new for old, new in zip(before, after, strict=True)] for before, after in pairwise(runs)]
    assert dict(zip(moved_by, changes, strict=True)) == moved_by
