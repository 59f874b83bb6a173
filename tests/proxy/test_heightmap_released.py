"""A fingertip that has left a rough height map feels no force, whatever its searches found on the way."""

import numpy as np
import pytest
from helpers.touching import engine, make_object, spun, visit

from softfinger.proxy.record import AT, CAUSE_RESTART

LATCHED = (3, 11, 17, 18, 20, 21)
"""Maps on which the proxy once remained where its search did not finish, with up to 131 N on a probe in free space."""
MAPS, STROKES, RETREAT = 30, 12, 150


def draw_map(rng):
    """Return random heights (n, n) m with a flat rim, pitch and fingertip's radius, m."""
    size = rng.integers(16, 64)
    pitch, amplitude = 10.0 ** rng.uniform(-3.5, -2.0), 10.0 ** rng.uniform(-4.0, -1.5)
    heights = rng.normal(size=(size, size)) * amplitude
    heights[:4] = heights[-4:] = 0.0
    heights[:, :4] = heights[:, -4:] = 0.0
    return heights, float(pitch), float(10.0 ** rng.uniform(-3.0, -1.7))


def draw_stroke(rng, heights, pitch, radius):
    """Return a path (n, 3) m from above the map into it, and up again to a height that no spline of it reaches."""
    half, top = 0.5 * len(heights) * pitch, 2.0 * heights.max()
    start, turn, end = rng.uniform(-half, half, (3, 3))
    start[2] = end[2] = top + 3.0 * radius
    turn[2] = rng.uniform(heights.min() - 3.0 * radius, top)
    ticks = int(rng.integers(20, 400))
    above = end + np.array([0.0, 0.0, 2.0 * radius])
    return np.concatenate(
        [np.linspace(start, turn, ticks), np.linspace(turn, end, ticks), np.linspace(end, above, RETREAT)]
    )


@pytest.mark.scaled
@pytest.mark.parametrize("company", [(), (make_object("far", "box", size_m=[0.01] * 3, position_m=[0.0, 0.0, -9.0]),)])
def test_a_fingertip_above_a_rough_map_feels_no_force(tmp_path, company, cases):
    rng, restarts = np.random.default_rng(1), 0
    for number in range(MAPS):
        heights, pitch, radius = draw_map(rng)
        strokes = [draw_stroke(rng, heights, pitch, radius) for _ in range(STROKES)]
        turns = [spun((0.3, 0.5, 0.8), np.cumsum(0.01 * rng.normal(size=len(stroke)))) for stroke in strokes]
        if number not in LATCHED and number >= cases(0, MAPS):
            continue
        np.save(tmp_path / "rough.npy", heights)
        rough = make_object("rough", "heightmap", file=str(tmp_path / "rough.npy"), pitch_m=pitch, level_m=1.0)
        running = engine(rough, *company, fingertip={"radius_m": radius})
        for stroke, turn in zip(strokes, turns, strict=True):
            running.reset()
            records = np.asarray(visit(running, stroke, turn))
            assert not records[-1, AT.force : AT.force + 3].any()
            restarts += int((records[:, AT.contact_cause] == CAUSE_RESTART).sum())
    assert restarts > 0
