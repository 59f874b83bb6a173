"""The kernel cache is keyed by all sources of the kernels and by nothing else."""

import ast
import os
import re
import shutil
import sys
from itertools import pairwise
from pathlib import Path

import pytest
from helpers.programs import run_program

from softfinger.proxy.kernels.jit.cache import KERNEL_FOLDERS

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
