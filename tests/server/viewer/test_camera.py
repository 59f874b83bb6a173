"""Initial camera of a scene: everything that can be touched is in view and large enough."""

from __future__ import annotations

from math import sin, tan
from typing import Any

import numpy as np
import pytest

from softfinger.config.load import load_scene
from softfinger.config.schema import Scene
from softfinger.config.sources import list_shipped
from softfinger.server.viewer.nodes.bodies import list_visual_geoms
from softfinger.server.viewer.nodes.camera import Camera, place_camera
from softfinger.server.viewer.nodes.glyphs import rotate
from softfinger.server.viewer.nodes.looks import CM

pytestmark = pytest.mark.plain

RADIUS = 0.01


def project(camera: Camera, point: Any) -> tuple[float, float]:
    look = np.subtract(camera.look_at, camera.position)
    depth = look / np.linalg.norm(look)
    right = np.cross(depth, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    offset = CM * np.asarray(point) - camera.position
    scale = tan(0.5 * camera.fov) * float(offset @ depth)
    return float(offset @ right) / scale, float(offset @ np.cross(right, depth)) / scale


@pytest.mark.parametrize("name", list_shipped(Scene))
def test_a_fingertip_on_top_is_in_the_picture_and_large_enough(name: str) -> None:
    scene = load_scene(name)
    camera = place_camera(scene)
    touched = next(element for element in scene.object if not getattr(element, "inside", False))
    half = {"sphere": 0.02, "cylinder": 0.02, "box": 0.04}.get(touched.shape, 0.0)
    up = np.array([0.0, 0.0, 1.0])
    middle = np.array(touched.position_m) + (half + RADIUS) * up
    for end in (-RADIUS, 0.0, RADIUS):
        for direction in np.eye(3):
            assert max(map(abs, project(camera, middle + end * direction))) < 1.0
    height = project(camera, middle + RADIUS * up)[1] - project(camera, middle - RADIUS * up)[1]
    assert height > 0.1  # of 2


def test_the_camera_looks_at_the_pose_of_a_body() -> None:
    scene = load_scene("open-a-door")
    (door,) = scene.object
    upright = (1.0, 0.0, 0.0, 0.0)
    opened, shut = (place_camera(scene, None, [(door, ((x, 0.0, 0.0), upright))]).look_at[0] for x in (0.08, 0.0))
    assert opened - shut == pytest.approx(CM * 0.08) and abs(shut) < 0.5 * CM * 2.0 * RADIUS
    stack = load_scene("stack-boxes")
    boxes = [(box, ((0.0, 0.0, 0.015 + 0.03 * k), upright)) for k, box in enumerate(list_visual_geoms(stack))]
    camera = place_camera(stack, None, [*boxes, (stack.object[1], ((0.0, 0.0, 0.075), upright))])
    assert max(map(abs, (*project(camera, (0.0, 0.0, 0.0)), *project(camera, (0.0, 0.0, 0.18))))) < 1.0


def test_the_camera_looks_at_walls_from_the_front() -> None:
    scene = load_scene("corner")
    position = np.array(place_camera(scene).position)
    for wall in scene.object:
        normal = rotate(wall.orientation_wxyz, np.array([0.0, 0.0, 1.0]))
        assert normal @ (position - CM * np.array(wall.position_m)) > 0.0


def test_the_camera_fits_a_mesh_once_it_is_drawn() -> None:
    scene = load_scene("heightmap")
    flat = np.array([(x, y, 0.0) for x in (-0.1, 0.0, 0.1) for y in (-0.1, 0.0, 0.1)])
    hill = np.array([(0.0, 0.0, 0.06)])
    near, far = place_camera(scene, {0: flat}), place_camera(scene, {0: np.concatenate([flat, hill])})

    def distance(camera: Camera) -> float:
        return float(np.linalg.norm(np.subtract(camera.position, camera.look_at)))

    assert distance(far) > distance(near) >= distance(place_camera(scene))
    assert distance(far) * sin(0.5 * far.fov) >= CM * 0.03  # half the hill fits
