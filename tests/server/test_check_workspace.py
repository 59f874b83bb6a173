"""`check` of a rig and a scene: position of the soft wall relative to the objects, as text and as a figure."""

from pathlib import Path

import numpy as np
import pytest
from conftest import paper_mapping
from helpers.called import read_stdout

from softfinger.config.load import build
from softfinger.config.schema import Scene, Workspace
from softfinger.drivers.kinematics.subspace import MotionSubspace
from softfinger.server.offline import workspace

pytestmark = pytest.mark.plain

SPHERE = Workspace(radius_m=0.04, center_m=(0.01, 0.0, 0.02))
BOX = Workspace(size_m=(0.1, 0.06, 0.08))
STEP_M = 1e-3
"""Spacing of the points on a drawn sphere, and the error of its chords."""


def make_scene(**ball: object) -> Scene:
    table = {"name": "ball", "shape": "sphere", "radius_m": 0.01, **ball}
    return build(Scene, paper_mapping(table=table, material={"torsion": None}), "test scene")


@pytest.mark.parametrize(
    ("place", "description"),
    [
        ((0.01, 0.0, 0.02), "inside"),
        ((0.05, 0.0, 0.02), "inside and outside"),
        ((0.08, 0.0, 0.02), "outside: its nearest point is 20 mm behind the wall"),  # 70 mm away, less 40 and 10
    ],
)
def test_objects_are_described_relative_to_the_wall(place: tuple[float, float, float], description: str) -> None:
    objects = workspace.place_objects(SPHERE, make_scene(position_m=list(place)))
    assert workspace.make_rows(SPHERE, objects) == [("1 'ball'", description)]
    away = workspace.compute_signed_distance(SPHERE, objects[0].points)
    apart = float(np.linalg.norm(np.array(place) - np.array(SPHERE.center_m)))
    assert away.max() == pytest.approx(apart + 0.01 - 0.04, abs=STEP_M)
    assert away.min() == pytest.approx(abs(apart - 0.01) - 0.04, abs=STEP_M) or apart < 0.01


def test_signed_distance_of_a_box() -> None:
    points = np.array([[0.0, 0.0, 0.0], [0.06, 0.0, 0.0], [0.08, 0.07, 0.0], [0.045, 0.0, 0.0]])
    assert workspace.compute_signed_distance(BOX, points) == pytest.approx([-0.03, 0.01, 0.05, -0.005])


def test_text_draws_wall_and_objects_to_scale() -> None:
    turned = make_scene(position_m=[0.01, 0.03, 0.02], orientation_wxyz=[0.0, 1.0, 0.0, 0.0])
    lines = workspace.draw_text(SPHERE, workspace.place_objects(SPHERE, turned))
    assert lines[0].startswith("from the front: x to the right, z up; 100 mm wide")
    middle = lines[1 + workspace.ROWS // 2].ljust(2 * workspace.COLUMNS + 3)
    front, right = middle[: workspace.COLUMNS], middle[-workspace.COLUMNS :]
    cell = 100.0 / (workspace.COLUMNS - 1)
    assert len(front.strip()) == 2 * int(40.0 / cell) + 1
    # From the front the ball is in the middle; from the right 20 to 40 mm to the right of it.
    assert [k - workspace.COLUMNS // 2 for k, c in enumerate(front) if c == "1"] == [*range(-5, 0), *range(1, 6)]
    positions_mm = [cell * (k - workspace.COLUMNS // 2) for k, c in enumerate(right) if c == "1"]
    assert min(positions_mm) == pytest.approx(20.0, abs=cell) and max(positions_mm) == pytest.approx(40.0, abs=cell)


def test_the_command_line_draws_each_rig_in_each_scene(tmp_path: Path) -> None:
    picture = tmp_path / "wall.svg"
    output = read_stdout("check", "falcon", "paper-plane", "--plot", str(picture))
    assert "the soft wall of falcon in paper-plane\n  1 'table'  inside and outside\n" in output
    assert "1" * (workspace.COLUMNS // 2) + "+" + "1" * (workspace.COLUMNS // 2) in output
    drawing = picture.read_text()
    assert "soft wall" in drawing and "table" in drawing and "from the right" in drawing
    assert "the soft wall of" not in read_stdout("check", "falcon")


def test_reachable_curve_is_the_arc_or_plane_inside_the_workspace() -> None:
    """A plane cuts a sphere in a circle or misses it; points of an arc have the handle's length as radius."""
    normal, up = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    for away, radius in ((0.0, 0.04), (0.024, 0.032), (0.05, None)):
        point = np.array([0.3, away, -0.2])  # anywhere in the plane
        points = workspace.compute_reachable_curve(SPHERE, MotionSubspace(2, normal, point, point))
        if radius is None:
            assert len(points) == 0
            continue
        np.testing.assert_allclose(points[:, 1], away, atol=1e-15)
        sizes = np.linalg.norm(points - (0.01, away, 0.02), axis=1)
        np.testing.assert_allclose(sizes, radius, atol=0.08 / (workspace.DIRECTIONS - 1))  # steps of the search
    middle = np.array([0.01, 0.0, 0.02])
    points = workspace.compute_reachable_curve(SPHERE, MotionSubspace(1, normal, middle - 0.09 * up, middle))
    np.testing.assert_allclose(np.linalg.norm(points - middle + 0.09 * up, axis=1), 0.09, atol=1e-15)
    # the end of a chord of 40 mm from the middle: 2 asin(20 / 90)
    assert points[:, 0].max() - 0.01 == pytest.approx(0.09 * np.sin(2.0 * np.arcsin(0.02 / 0.09)), abs=STEP_M)


def test_the_plane_of_a_device_is_drawn() -> None:
    output = read_stdout("check", "haply-2diy", "paper-plane")
    assert "edge of the plane in which the handle moves; other forces are not displayed" in output
    begins = 2 + workspace.COLUMNS + 3
    drawn = output.partition("the soft wall of")[2].splitlines()
    views = [line for line in drawn if workspace.CURVE_MARK in line and "handle" not in line]
    places = {k for line in views for k, c in enumerate(line[begins:]) if c == workspace.CURVE_MARK}
    assert places == {workspace.COLUMNS // 2}
    assert all(line[:begins].count(workspace.CURVE_MARK) >= 2 for line in views)
