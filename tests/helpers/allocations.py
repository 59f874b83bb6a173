"""Count the malloc calls of a thread with a shim in front of the C library's functions."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

HAS_COMPILER = shutil.which("cc") is not None

SHIM = """
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stddef.h>
static __thread long count;
long allocations(void) { return count; }
extern void *__libc_malloc(size_t), *__libc_calloc(size_t, size_t), *__libc_realloc(void *, size_t);
void *malloc(size_t n) { count++; return __libc_malloc(n); }
void *calloc(size_t n, size_t m) { count++; return __libc_calloc(n, m); }
void *realloc(void *p, size_t n) { count++; return __libc_realloc(p, n); }
"""


def counted(folder: Path, code: str, *words: str) -> str:
    """Run a Python program and return its output; `allocations()` of the process counts the calls of the calling
    thread."""
    source, library = folder / "shim.c", folder / "shim.so"
    source.write_text(SHIM)
    subprocess.run(["cc", "-shared", "-fPIC", "-o", str(library), str(source)], check=True)
    return subprocess.run(
        [sys.executable, "-c", code, *words],
        cwd=folder,
        env=os.environ | {"LD_PRELOAD": "./shim.so"},  # a list separated by spaces, which the folder's name may contain
        capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
