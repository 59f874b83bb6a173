"""`accuracy`: cost and error of each rolling method, on every surface.

The first part is the paper's experiment. The second part is speed against accuracy: largest error of the contact path
against an independent eighth-order reference, error of the spin, drift off the surface, and time of a step. These are
measured over the servo rate, the rotation rate, the curvature ratio and the ratio of spin to roll.
"""

from __future__ import annotations

import argparse
import os
import platform
from pathlib import Path
from typing import Any, Final

import llvmlite.binding as llvm

from softfinger.config.errors import ConfigError
from softfinger.server.loop.servo_thread import require_machine_code
from softfinger.server.offline.figures import check_figure_path
from softfinger.tools.accuracy import meshes, pixels
from softfinger.tools.accuracy.cases import RADIUS_M, TOLERANCE, Sweep, has_method, list_cases
from softfinger.tools.accuracy.figures import FIGURES, draw_fronts
from softfinger.tools.accuracy.front import find_fronts, fit_orders, list_recommendations
from softfinger.tools.accuracy.measure import DriftCase, run_block, run_drift_block
from softfinger.tools.accuracy.paper import measure_speed, run_experiment
from softfinger.tools.accuracy.report import print_report, write_report
from softfinger.tools.measure import show
from softfinger.tools.options import DRIFT_STEPS, METHODS, REPORT, SURFACES
from softfinger.tools.sweep import run_cases

RATES_HZ: Final = (4.0, 8.0, 16.0, 32.0, 64.0, 125.0, 250.0, 500.0, 1000.0, 2000.0, 4000.0, 8000.0)
QUICK_RATES_HZ: Final = (8.0, 64.0, 250.0, 1000.0)
QUICK_DRIFT_STEPS: Final = 20_000


def run(args: argparse.Namespace) -> int:
    if args.meshes:
        return meshes.run(args)
    if args.heightmap:
        return pixels.run(args)
    require_machine_code("a measurement of speed")
    sweep, drift_cases = plan_sweep(args)
    if args.figures is not None:
        prepare_figures(args.figures)
    paper, times = run_experiment(), measure_speed()
    # One thread, so that nothing runs concurrently with the timing.
    settings = {"scheduler": args.scheduler, "results": args.results, "threads": 1}
    trade = run_cases(run_block, list_cases(sweep), label="measuring speed and accuracy", **settings)
    drift = run_cases(run_drift_block, drift_cases, label="measuring drift", **settings)
    drift_by_case = {(row["surface"], row["method"]): row["drift_m"] for row in drift}
    trade = [row | {"drift_m": drift_by_case[row["surface"], row["method"]]} for row in trade]
    result: dict[str, Any] = {
        "machine": describe_machine(),
        "radius_m": RADIUS_M,
        "tolerance": TOLERANCE,
        "paper": paper,
        "speed": times,
        "trade": trade,
        "drift": drift,
        "orders": fit_orders(trade),
        "pareto": find_fronts(trade),
        "recommendations": list_recommendations(trade, args.error_below),
    }
    if args.json:
        show(result, True, ())
    else:
        print_report(result)
    if args.plot:
        draw_fronts(result, args.plot)
    if args.figures:
        for name, draw in FIGURES.items():
            draw(result, args.figures / name)
        write_report(result, args.figures / REPORT)
    return 0


def prepare_figures(folder: Path) -> None:
    """Create the folder of the figures; raises ConfigError, before any measurement, if a figure could not be saved."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--figures {folder}: {error.strerror}: use a writable folder") from error
    if (why := check_figure_path(folder / next(iter(FIGURES)))) is not None:
        raise ConfigError(f"--figures {folder}: {why}")


def plan_sweep(args: argparse.Namespace) -> tuple[Sweep, list[DriftCase]]:
    """Return the sweep for the options; raises ConfigError if nothing can be measured."""
    surfaces, methods = args.surface or list(SURFACES), args.method or list(METHODS)
    pairs = [(s, m) for s in surfaces for m in methods if has_method(s, m)]
    if not pairs:
        raise ConfigError(
            f"--method {' '.join(methods)} --surface {' '.join(surfaces)}: rotation_vector exists only for shapes with "
            "a closed form, not for ellipsoids and tori: use another method or surface"
        )
    sweep = Sweep(surfaces, methods, args.rate or (QUICK_RATES_HZ if args.quick else RATES_HZ), args.quick)
    steps = args.drift_steps or (QUICK_DRIFT_STEPS if args.quick else DRIFT_STEPS)
    return sweep, [DriftCase(surface, method, steps) for surface, method in pairs]


def describe_machine() -> dict[str, Any]:
    """Describe the machine on which the times were measured."""
    return {
        "processor": llvm.get_host_cpu_name(),
        "processors": os.cpu_count(),
        "system": platform.system(),
        "python": platform.python_version(),
    }
