"""Study: make the figures of docs/, and the tables of accuracy and of bodies under fingers, by one command.

    python -m softfinger.tools.study docs             # or: make study

Pictures go to docs/figures/. Tables are in the pages between two comments,

    <!-- study: NAME -->
    ...
    <!-- end -->

and the study replaces the text between them. It does not change the prose: check it against the new figures.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from softfinger.config.errors import ConfigError, HapticError
from softfinger.server.arguments import add_flag
from softfinger.server.verbs.schema import format_grid
from softfinger.tools.accuracy import report
from softfinger.tools.options import POINTS
from softfinger.tools.patches_figure import draw_patches
from softfinger.tools.stability import bodies, bodies_table
from softfinger.tools.stability.maps import MAPS

BLOCK: Final = re.compile(r"(<!-- study: (?P<name>[a-z-]+) -->\n).*?(<!-- end -->)", re.S)
DRIFT_STEPS: Final = 10_000_000
PROGRAM: Final = (sys.executable, "-m", "softfinger.server.cli")
TABLES: Final = ("paper", "bodies")
"""Tables in the pages; the other tables of `softfinger accuracy` are in figures/accuracy.txt."""


def format_markdown(table: Any) -> str:
    heads = [str(column.header).replace("\n", "_") for column in table.columns]
    rows = zip(*(map(str, column.cells) for column in table.columns), strict=True)
    return format_grid(heads, [list(row) for row in rows]) + "\n"


def insert(page: str, tables: Mapping[str, str]) -> str:
    """Return the page with each marked table replaced; raises ConfigError for a mark without a table."""

    def fill(match: re.Match[str]) -> str:
        name = match["name"]
        if name not in tables:
            raise ConfigError(f"<!-- study: {name} -->: no such table; there are {', '.join(tables)}")
        return f"{match[1]}\n{tables[name]}\n{match[3]}"

    return BLOCK.sub(fill, page)


def run(*words: str) -> bytes:
    """Return the output of a command of the program, run as its users do; its progress is printed to the terminal."""
    print(f"study: softfinger {' '.join(words)}", file=sys.stderr, flush=True)
    process = subprocess.run([*PROGRAM, *words], stdout=subprocess.PIPE, check=False)
    if process.returncode != 0:
        raise HapticError(f"`softfinger {' '.join(words)}` ended with exit code {process.returncode}: see above")
    return process.stdout


def run_as_json(*words: str) -> dict[str, Any]:
    result: dict[str, Any] = json.loads(run(*words, "--json"))
    return result


def draw_shipped_run(path: Path) -> None:
    """Draw the recording that `softfinger run` plays."""
    with tempfile.TemporaryDirectory() as folder:
        out = str(Path(folder) / "run.npz")
        run("simulate", "--scene", "paper-plane", "--poses", "press-roll-spin-drag", "--out", out, "--plot", str(path))


def make_tables(figures: Path, quick: bool) -> dict[str, str]:
    """Draw every figure and return every table by its name; `quick` is a short run that only tests the commands."""
    drift, points, short = DRIFT_STEPS, str(POINTS), []
    if quick:
        drift, points, short = 20_000, "3", ["--quick", "--surface", "plane", "torus"]
    result = run_as_json("accuracy", *short, "--drift-steps", str(drift), "--figures", str(figures))
    tables = {"paper": format_markdown(report.format_paper_table(result))}
    draw_shipped_run(figures / "run.svg")
    draw_patches(figures / "patches.svg")
    run_as_json("stability", "--wall-damping", "1", "--delay", "1", "--plot", str(figures / "stability-case.svg"))
    for name in MAPS:
        plot = figures / f"stability-{name}.svg"
        run_as_json("stability", "--map", name, "--compare", "--points", points, "--plot", str(plot))
    result = run_as_json("stability", "--bodies")
    tables["bodies"] = bodies_table.format_cases([bodies.CellResult(**row) for row in result["bodies"]])
    return tables


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="study", description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("docs", type=Path, help="folder of the pages")
    add_flag(parser, "--quick", "few points, short drift: shows that all of it runs")
    args = parser.parse_args(argv)
    try:
        pages = {path: path.read_text(encoding="utf-8") for path in sorted(args.docs.rglob("*.md"))}
        if not pages:
            raise ConfigError(f"{args.docs}: contains no pages: use the folder docs of the repository")
        tables = make_tables(args.docs / "figures", args.quick)
        for path, page in pages.items():
            changed = insert(page, tables)
            if changed != page:
                path.write_text(changed, encoding="utf-8")
    except HapticError as error:
        print(f"study: {error}", file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
