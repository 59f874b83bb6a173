"""The convergence tool: its table of orders, its paper table and its plot."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from softfinger.tools import convergence


def test_orders_of_a_few_methods(monkeypatch: pytest.MonkeyPatch) -> None:
    """At a constant rate the tool finds orders 2 and 1 on a plane; at a changing one no method has more than 2."""
    monkeypatch.setattr(convergence, "SHAPES", {"plane": convergence.SHAPES["plane"]})
    found = {(row["motion"], row["method"]): row["order"] for row in convergence.measure()}
    # The next order's share at 256 ticks.
    assert found["constant", "euler_zxz"] == pytest.approx(2.0, abs=0.01)
    assert found["constant", "euler_zyx"] == pytest.approx(1.0, abs=0.01)
    assert found["constant", "rotation_vector"] is None
    for method in ("euler_zxz", "rotation_vector", "midpoint", "montana_rk4", "montana_rk45"):
        assert found["changing", method] == pytest.approx(2.0, abs=0.01)


def test_changing_motion_turns_at_the_rates_it_says() -> None:
    """The orientations' difference quotient is the angular velocity, for both motions."""
    h, t = 1e-5, np.linspace(0.1, 0.9, 5)
    for kind in ("constant", "changing"):
        (before, _), (after, _), (_, rates) = (convergence.motion(kind, t + s) for s in (-h, h, 0.0))
        for a, b, w in zip(before, after, rates, strict=True):
            step = convergence.rotations.relative(tuple(b.tolist()), tuple(a.tolist()))
            # Central differences: h^2 times the third derivative.
            assert np.array(convergence.rotations.log(step)) / (2 * h) == pytest.approx(w, abs=1e-8)


def test_paper_table_is_the_documented_one(capsys: pytest.CaptureFixture[str]) -> None:
    """`--paper --json` prints what docs/rolling.md says, to 1e-5 mm."""
    assert convergence.run(options(paper=True, json=True)) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    text = (Path(__file__).parents[1] / "docs" / "rolling.md").read_text(encoding="utf-8")
    for row in rows:
        x, y = row["largest_mm"]
        assert f"| `{row['method']}` | {x:.5f} | {y:.5f} |" in text


def test_plot_is_drawn(tmp_path: Path) -> None:
    """The plot is a picture file of the rows it is given."""
    row = {"shape": "torus", "method": "midpoint", "error_m": [1.0 / n**2 for n in convergence.TICKS]}
    convergence.draw([row | {"motion": kind} for kind in ("constant", "changing")], tmp_path / "orders.png")
    assert (tmp_path / "orders.png").read_bytes().startswith(b"\x89PNG")


def options(**given: object) -> object:
    """Parsed command line with these flags."""
    import argparse

    parser = argparse.ArgumentParser()
    convergence.configure(parser)
    args = parser.parse_args([])
    for name, value in given.items():
        setattr(args, name, value)
    return args
