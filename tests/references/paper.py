"""Read the published numbers; the data file names where they were printed."""

import csv
from pathlib import Path


def published(name: str = "salvietti_2013") -> dict[str, float]:
    """Quantity -> value (SI) of one table of this folder."""
    lines = (Path(__file__).parent / f"{name}.csv").read_text(encoding="utf-8").splitlines()
    rows = csv.DictReader(line for line in lines if not line.startswith("#"))
    return {row["quantity"]: float(row["value"]) for row in rows}
