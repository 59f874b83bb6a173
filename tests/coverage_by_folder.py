"""Print the suite's coverage of lines and branches by folder, and the files below a threshold with the reasons.

    python tests/coverage_by_folder.py coverage.json

`make coverage` writes the file with `coverage json`. The exit code is 1 if a file below the threshold has no reason in
coverage_reasons.toml.
"""

import json
import sys
import tomllib
from collections import defaultdict
from pathlib import Path
from typing import Any, Final

LOW: Final = 90.0
"""Per cent; below it a folder or a file is named."""


REASONS: Final = Path(__file__).with_name("coverage_reasons.toml")


def reasons() -> dict[str, str]:
    table: list[dict[str, Any]] = tomllib.loads(REASONS.read_text(encoding="utf-8"))["reason"]
    return {file: entry["why"] for entry in table for file in entry["files"]}


def share(part: int, whole: int) -> float:
    return 100.0 * part / whole if whole else 100.0


def row(name: str, summary: dict[str, int]) -> str:
    lines = share(summary["covered_lines"], summary["num_statements"])
    branches = share(summary["covered_branches"], summary["num_branches"])
    low = "  below 90 %" if min(lines, branches) < LOW else ""
    return f"{name:<46} {summary['num_statements']:6} {lines:6.1f} % {summary['num_branches']:6} {branches:6.1f} %{low}"


def main(file: str) -> int:
    measured: dict[str, Any] = json.loads(Path(file).read_text(encoding="utf-8"))
    folders: dict[str, dict[str, int]] = defaultdict(lambda: defaultdict(int))
    low = {}
    for name, content in sorted(measured["files"].items()):
        summary = {key: value for key, value in content["summary"].items() if isinstance(value, int)}
        for key, value in summary.items():
            folders[str(Path(name).parent)][key] += value
        if share(summary["covered_lines"], summary["num_statements"]) < LOW:
            low[name] = summary
    print(f"{'folder':<46} {'lines':>6} {'run':>8} {'branches':>6} {'taken':>8}")
    for name, total in sorted(folders.items()):
        print(row(name, total))
    print(row("all", measured["totals"]))
    print(f"\n{len(low)} files below {LOW:g} % of lines:")
    known = reasons()
    by_reason: dict[str, list[str]] = defaultdict(list)
    for name in low:
        by_reason[known.get(name, "")].append(name)
    for why, names in sorted(by_reason.items(), key=lambda item: -len(item[1])):
        print(f"\n{why or 'WITHOUT A REASON: a test, or a line in tests/coverage_reasons.toml'}")
        for name in names:
            print(row(name, low[name]))
    return 1 if "" in by_reason else 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1]))
