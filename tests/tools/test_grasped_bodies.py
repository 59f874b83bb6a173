"""`stability --bodies`: measurement of a cell, its assessment, and the tables."""

from pathlib import Path

import numpy as np
import pytest

from softfinger.tools.stability import bodies, bodies_table
from softfinger.tools.stability.bodies import Cell, CellResult

pytestmark = pytest.mark.plain

CELL = CellResult("hold", 0.1, 1000.0, 1, 0.001, 2.0, 0.001, 0.5, 1e-5, 0, -1e-4, 0.0)


def test_a_closed_cycle_gives_the_hands_no_energy(tmp_path: Path) -> None:
    cell = Cell("hold", 0.1, 1000.0)
    approach = bodies.make_approach_path(cell)
    path = np.concatenate([approach, approach[::-1]])
    played = bodies.play(bodies.begin(cell, tmp_path), path)
    carried = played.force[len(approach) - 1].sum(axis=0)
    assert carried[2] == pytest.approx(-cell.mass * bodies.G, rel=0.05)  # it swings a little after the lift
    assert played.unbalanced <= 1e-12 and bodies.count_slips(played.mode[bodies.LEG : -bodies.LEG]) == 0
    assert np.sum(played.force[:-1] * np.diff(path, axis=0)) < 0.0


@pytest.mark.exhaustive
@pytest.mark.parametrize("case", ["drag", "hold"])
def test_a_body_comes_to_rest(case: str) -> None:
    result = bodies.measure(Cell(case, 0.1, 1000.0))
    assert (result.verdict, result.slips) == ("rests", 0)
    assert result.left is not None and result.left < bodies.REST_SPEED_SHARE
    assert bodies_table.find_wrong([result]) == []


@pytest.mark.exhaustive
def test_a_plate_on_a_finger_rocks_as_a_rigid_one(tmp_path: Path) -> None:
    cell, h = Cell("balance", 0.01, 3000.0), bodies.PLATE_HALF_M
    engine, hold = bodies.begin(cell, tmp_path), np.repeat(bodies.make_approach_path(cell)[:1], 100, axis=0)
    engine.run(bodies.make_poses(hold))
    engine.data.qvel[3] = 0.02
    turning = []
    for _ in range(800):
        engine.run(bodies.make_poses(hold[:1]))
        turning.append(engine.data.qvel[3])
    inertia = ((2.0 * bodies.HALF_M) ** 2 + (2.0 * h) ** 2) / 12.0 + h**2
    omega = np.sqrt(bodies.G * (bodies.RADIUS_M - h) / inertia)
    turns = np.flatnonzero(np.sign(turning[1:]) * np.sign(turning[:-1]) < 0)
    assert len(turns) >= 4
    assert np.mean(np.diff(turns)) * bodies.DT == pytest.approx(np.pi / omega, rel=0.02)  # a tick is 0.7 % of it
    assert np.abs(turning[-300:]).max() > 0.95 * np.abs(turning[100:400]).max()


@pytest.mark.exhaustive
def test_a_body_too_light_for_the_tick_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bodies, "LIGHT_SUBSTEPS", 1)
    assert bodies_table.find_wrong([bodies.measure(Cell("hold", 0.001, 3000.0))])


@pytest.mark.parametrize(
    ("changes", "touching", "verdict"),
    [
        ({}, True, "rests"),
        ({"left": 0.5, "grown": 1.0}, True, "swings"),
        ({"left": 0.5, "grown": 1.2}, True, "unstable"),
        ({}, False, "lost"),
    ],
)
def test_the_motion_after_a_knock_is_classified(changes: dict[str, float], touching: bool, verdict: str) -> None:
    result = bodies.judge(CELL._replace(**changes), touching)
    assert result.verdict == verdict and bool(result.reason) == (verdict != "rests")


def test_the_table_names_bodies_that_do_not_come_to_rest() -> None:
    rests, stiff = CELL._replace(verdict="rests"), {"stiffness_n_per_m": 3000.0}
    lost = CELL._replace(mass_kg=1.0, verdict="lost", reason="too deep", ripple_n=2e-3, given_j=-2.0, left=None)
    results = [rests, rests._replace(**stiff), lost, rests._replace(mass_kg=1.0, unbalanced_n=3e-12, **stiff)]
    row = bodies_table.format_cases(results).splitlines()[2]
    assert row == "| hold | 2 mN | 0 | -0.1 mJ | 3e-12 N | lost in 1 of 4: too deep |"
    assert bodies_table.find_wrong(results) == [results[3]]
    assert bodies_table.find_wrong([rests._replace(given_j=1e-9)]) != []
    assert [line.split()[:3] for line in bodies_table.format_lines(results)[2:]][2] == ["hold", "1", "kg"]


def test_a_panel_is_drawn_for_each_case(tmp_path: Path) -> None:
    bodies_table.draw(tmp_path / "bodies.svg", [CELL, CELL._replace(case="drag", left=None)])
    assert "hold" in (tmp_path / "bodies.svg").read_text() and "drag" in (tmp_path / "bodies.svg").read_text()
