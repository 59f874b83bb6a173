"""What the suite ran of the program, by folder: lines and branches, and the files below a share of them.

    python tests/coverage_by_folder.py coverage.json

The file is what `coverage json` writes; `make coverage` makes it.
"""

from __future__ import annotations

import json
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any, Final

LOW: Final = 90.0
"""Per cent; below it a folder or a file is named."""


def share(part: int, whole: int) -> float:
    return 100.0 * part / whole if whole else 100.0


def row(name: str, found: dict[str, int]) -> str:
    lines = share(found["covered_lines"], found["num_statements"])
    branches = share(found["covered_branches"], found["num_branches"])
    low = "  below 90 %" if min(lines, branches) < LOW else ""
    return f"{name:<46} {found['num_statements']:6} {lines:6.1f} % {found['num_branches']:6} {branches:6.1f} %{low}"


def main(file: str) -> None:
    measured: dict[str, Any] = json.loads(Path(file).read_text(encoding="utf-8"))
    folders: dict[str, dict[str, int]] = defaultdict(lambda: defaultdict(int))
    low = []
    for name, found in sorted(measured["files"].items()):
        summary = {key: value for key, value in found["summary"].items() if isinstance(value, int)}
        for key, value in summary.items():
            folders[str(Path(name).parent)][key] += value
        if share(summary["covered_lines"], summary["num_statements"]) < LOW:
            low.append((name, summary))
    print(f"{'folder':<46} {'lines':>6} {'run':>8} {'branches':>6} {'taken':>8}")
    for name, total in sorted(folders.items()):
        print(row(name, total))
    print(row("all", measured["totals"]))
    print(f"\n{len(low)} files below {LOW:g} % of lines:")
    for name, summary in low:
        print(row(name, summary))


if __name__ == "__main__":
    main(sys.argv[1])
