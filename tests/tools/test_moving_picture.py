"""The animation in the README is simulated, and its file is small."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import pytest

from softfinger.tools.pages import moving

pytestmark = pytest.mark.plain

SVG = "{http://www.w3.org/2000/svg}"


@pytest.mark.exhaustive
def test_the_moving_picture_shows_a_box_that_hangs_and_one_that_swings(tmp_path: Path) -> None:
    moving.draw(tmp_path / "lift.svg")
    assert (tmp_path / "lift.svg").stat().st_size < 60_000
    moves = list(ElementTree.parse(tmp_path / "lift.svg").iter(f"{SVG}animateTransform"))
    values = [move.get("values", "").split(";") for move in moves]
    assert len(values) == 6 and len({len(series) for series in values}) == 1  # box, its turn and the fingers, twice
    turns = [[abs(float(value)) for value in values[place]] for place in (1, 4)]
    assert max(turns[0]) < 5.0 and max(turns[1]) > 90.0
    heights = [[float(value.split()[1]) for value in values[place]] for place in (0, 3)]
    assert all(min(series) < moving.FLOOR - moving.PIXELS_PER_M * 0.1 for series in heights)
