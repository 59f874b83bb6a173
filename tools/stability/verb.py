"""`stability`: the stiffest stable wall of a device, for one case or as maps, and random closed-loop runs.

softfinger stability --mass 0.2 --damping 2 --rate 1000
softfinger stability --map all --plot map.svg
softfinger stability --cases 10000 --ticks 1000 --scheduler local
softfinger stability --bodies
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from softfinger.config.errors import ConfigError
from softfinger.config.load import FaultyConfig
from softfinger.config.schema import find_unit
from softfinger.config.validate import examine
from softfinger.server.offline.figures import make_figure, save
from softfinger.tools.measure import show, show_and_draw
from softfinger.tools.options import FLAGS
from softfinger.tools.stability import bodies, bodies_table, extremes, runs
from softfinger.tools.stability.limit import WallCase, compile_search, find_limits
from softfinger.tools.stability.maps import MAPS, VARIANTS, draw_maps, list_cases
from softfinger.tools.stability.predicted import compute_spectral_radius
from softfinger.tools.sweep import run_cases


def run(args: argparse.Namespace) -> int:
    case = parse_case(args)
    if args.cases is not None:
        if args.plot:
            raise ConfigError("command line --plot: random runs have no plot: remove --plot or --cases")
        result = runs.measure(args.cases, args.ticks, args.seed, args.scheduler, args.results)
        show({"runs": result}, args.json, runs.format_table(result))
        return 0
    if args.bodies:
        return run_bodies(args)
    if args.extremes:
        if args.plot:
            raise ConfigError("command line --plot: the extremes have no plot: remove --plot or --extremes")
        return run_extremes(args)
    rows = measure(case, args)
    if args.map is None:
        return show_and_draw(args, {"cases": rows}, format_table(rows), lambda path: draw_radius(path, case, rows[0]))
    return show_and_draw(args, {"cases": rows}, format_table(rows), lambda path: draw_maps(path, rows, case))


def run_extremes(args: argparse.Namespace) -> int:
    """Run every extreme and some garbage; returns exit code 1 if a condition failed."""
    results, hostile_rows = extremes.try_extremes(), runs.try_hostile(args.garbage, args.seed)
    result = {"extremes": [row._asdict() for row in results], "hostile": hostile_rows}
    show(result, args.json, [extremes.format_table(results), runs.format_hostile_table(hostile_rows)])
    return int(any(row.wrong for row in results) or any(row["broken"] for row in hostile_rows))


def run_bodies(args: argparse.Namespace) -> int:
    """Run every case of a body.

    Returns exit code 1 if a body is unstable, gives energy to the hands, or has unbalanced forces.
    """
    cells = bodies.measure_all()
    result = {"bodies": [row._asdict() for row in cells]}
    show_and_draw(args, result, bodies_table.format_lines(cells), lambda path: bodies_table.draw(path, cells))
    return int(bool(bodies_table.find_wrong(cells)))


def parse_case(args: argparse.Namespace) -> WallCase:
    """Return the case of the command line; raises ConfigError with every value that is out of range."""
    values = {key: getattr(args, flag.replace("-", "_")) for flag, key in FLAGS.items()}
    case, faults = examine(
        WallCase, values, "command line", {key: f"command line --{flag}" for flag, key in FLAGS.items()}
    )
    if faults:
        raise FaultyConfig(faults)
    assert isinstance(case, WallCase)
    return case


def measure(case: WallCase, args: argparse.Namespace) -> list[dict[str, Any]]:
    """Return a row for each case: `find_limits` and, for a map, its name and the variant."""
    marks: list[dict[str, str]] = [{}]
    cases = [case]
    if args.map is not None:
        variants = VARIANTS if args.compare else {next(iter(VARIANTS)): {}}
        marks, cases = [], []
        for name in MAPS if args.map == "all" else [args.map]:
            for variant, changes in variants.items():
                points = list_cases(name, case, args.points)
                cases += [msgspec.structs.replace(point, **changes) for point in points]
                marks += [{"map": name, "variant": variant}] * len(points)
    if args.scheduler in (None, "local"):
        compile_search()
    rows = run_cases(find_limits, cases, label="finding limits", scheduler=args.scheduler, results=args.results)
    return [{**mark, **row} for mark, row in zip(marks, rows, strict=True)]


def format_table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Format the limits, a case per line: for a map with the varied value, else with all values that are not 0."""
    lines = ["stiffest stable wall, N/m: found on the servo step, exact limit of the linear loop, passive below"]
    section = None
    for row in rows:
        keys = [MAPS[row["map"]].key] if "map" in row else [key for key in FLAGS.values() if row[key]]
        if section != (row.get("map"), row.get("variant")):
            section = row.get("map"), row.get("variant")
            if "map" in row:
                lines.append(f"{row['map']}, {row['variant']}")
            heads = [*map(_format_head, keys), "found", "linear", "passive"]
            lines.append("  " + "".join(f"{head:>{_measure_width(head)}}" for head in heads))
        cells = [f"{row[key]:>{_measure_width(_format_head(key))}.6g}" for key in keys]
        limit = row["limit_n_per_m"]
        cells.append(f"{'no limit':>14}" if limit is None else f"{limit:>14.2f}")
        cells += [f"{row[key]:>14.2f}" for key in ("predicted_n_per_m", "passive_n_per_m")]
        lines.append("  " + "".join(cells))
    return lines


def _format_head(key: str) -> str:
    flag = next(flag for flag, name in FLAGS.items() if name == key)
    return f"{flag}, {find_unit(key)}" if find_unit(key) else flag


def _measure_width(head: str) -> int:
    return max(14, len(head) + 2)


def draw_radius(path: Path, case: WallCase, row: Mapping[str, Any]) -> None:
    """Draw the spectral radius of the linear loop against the stiffness, with the limit and the passivity bound."""
    drawing = make_figure()
    axes = drawing.add_subplot()
    limit = row["limit_n_per_m"]
    top = 2.0 * max(limit or 0.0, row["predicted_n_per_m"], 1.0)
    stiffness = np.linspace(top / 400.0, top, 400)
    axes.plot(stiffness, compute_spectral_radius(case.linear(), stiffness), label="linear loop")
    axes.axhline(1.0, color="0.4", linewidth=0.8)
    if limit is not None:
        axes.axvline(limit, color="C1", label="unstable above: found on the servo step")
    axes.axvline(row["passive_n_per_m"], color="0.4", linestyle="--", label="passive below")
    axes.set(xlabel="stiffness of the wall, N/m", ylabel="spectral radius")
    axes.legend()
    axes.grid(True, alpha=0.3)
    save(drawing, path)
