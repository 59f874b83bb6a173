"""Results of `bodies` as text, as a Markdown table, and as a figure."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from softfinger.server.offline.figures import make_figure, save
from softfinger.server.verbs.schema import format_grid
from softfinger.tools.stability.bodies import BALANCE_N, REST_SPEED_SHARE, CellResult

UNSTABLE: Final = ("unstable", "failed")


def find_wrong(results: Sequence[CellResult]) -> list[CellResult]:
    """Return the cells that grow or fail, give energy to the hands, or have unbalanced forces."""
    return [
        row
        for row in results
        if row.verdict in UNSTABLE or (row.given_j or 0.0) > 0.0 or (row.unbalanced_n or 0.0) > BALANCE_N
    ]


def format_mass(row: CellResult) -> str:
    mass = f"{row.mass_kg:g} kg" if row.mass_kg >= 1.0 else f"{1e3 * row.mass_kg:g} g"
    return mass if row.substeps == 1 else f"{mass}, {row.substeps} substeps"


def format_lines(results: Sequence[CellResult]) -> list[str]:
    heads = ("left", "ripple, mN", "slips", "given, mJ", "unbalanced, N")
    text = ["knocked, and the remaining motion after a second; energy given to the hands in a closed cycle"]
    text.append(f"  {'case':<9}{'mass':<17}{'K, N/m':>7}" + "".join(f"{head:>15}" for head in heads) + "  verdict")
    for row in results:
        numbers = (
            ("-",) * len(heads)
            if row.left is None or row.ripple_n is None or row.given_j is None
            else (
                f"{100.0 * row.left:.3g} %", f"{1e3 * row.ripple_n:.3g}", f"{row.slips}", f"{1e3 * row.given_j:.3g}",
                f"{row.unbalanced_n:.2g}",
            )
        )  # fmt: skip
        why = f": {row.reason}" if row.reason else ""
        text.append(
            f"  {row.case:<9}{format_mass(row):<17}{row.stiffness_n_per_m:>7g}"
            + "".join(f"{number:>15}" for number in numbers)
            + f"  {row.verdict}{why}"
        )
    return text


def format_cases(results: Sequence[CellResult]) -> str:
    """Return the worst measured values of each case, and the bodies that do not come to rest, with the reason."""
    head = [
        "case", "largest ripple", "slips", "energy given, at most", "forces opposite to", "not at rest after a second"
    ]  # fmt: skip
    lines = []
    for case in dict.fromkeys(row.case for row in results):
        rows = [row for row in results if row.case == case]
        ripple, work, unbalanced = (
            max((value for row in rows if (value := getattr(row, key)) is not None), default=float("nan"))
            for key in ("ripple_n", "given_j", "unbalanced_n")
        )
        slips = sum(row.slips or 0 for row in rows)
        open_ends = [(row.verdict, row.reason) for row in rows if row.verdict != "rests"]
        faults = "; ".join(
            f"{verdict} in {open_ends.count((verdict, reason))} of {len(rows)}: {reason}"
            for verdict, reason in dict.fromkeys(open_ends)
        )
        numbers = [f"{1e3 * ripple:.2g} mN", f"{slips}", f"{1e3 * work:.2g} mJ", f"{unbalanced:.1g} N"]
        lines.append([case, *numbers, faults or "-"])
    return format_grid(head, lines) + "\n"


def draw(path: Path, results: Sequence[CellResult]) -> None:
    """Draw a panel for each case: remaining speed after a knock against the stiffness, a line for each mass."""
    cases = list(dict.fromkeys(row.case for row in results))
    drawing = make_figure(4.0 * len(cases), 4.0)
    panels = drawing.subplots(1, len(cases), squeeze=False, sharey=True)[0]
    for axes, case in zip(panels, cases, strict=True):
        for mass in dict.fromkeys(row.mass_kg for row in results):
            rows = [row for row in results if (row.case, row.mass_kg) == (case, mass)]
            remaining = [np.nan if row.left is None else max(row.left, 1e-6) for row in rows]
            axes.loglog([row.stiffness_n_per_m for row in rows], remaining, "o-", label=format_mass(rows[0]))
        axes.axhline(REST_SPEED_SHARE, color="0.4", linewidth=0.8)
        stiffnesses = sorted({row.stiffness_n_per_m for row in results})
        axes.set_xticks(stiffnesses, [f"{value:g}" for value in stiffnesses])
        axes.set_xticks([], minor=True)
        axes.set(title=case, xlabel="stiffness, N/m")
        axes.grid(True, alpha=0.3)
    panels[0].set_ylabel("share of a knock's speed after 1 s")
    panels[0].legend(fontsize="small")
    save(drawing, path)
