"""Initial camera of a scene, elastic objects, bodies of a [world] and displayed forces as the page draws them."""

from math import sin, tan
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfinger.config.load import describe, load_rig, load_scene
from softfinger.config.schema import Scene
from softfinger.config.sources import list_shipped
from softfinger.drivers.kinematics.options import Paddle
from softfinger.drivers.kinematics.subspace import make_subspace
from softfinger.drivers.mounting import Mounting
from softfinger.proxy.elastic.prepared import prepare_body
from softfinger.proxy.engine import Engine
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.server.surface_meshes import SurfaceMesh
from softfinger.server.viewer.displayed import find_low_dof_devices
from softfinger.server.viewer.nodes.bodies import BodyNodes, SceneStart, list_visual_geoms
from softfinger.server.viewer.nodes.camera import Camera, place_camera
from softfinger.server.viewer.nodes.fingers import FingerNodes
from softfinger.server.viewer.nodes.glyphs import make_dashes, rotate
from softfinger.server.viewer.nodes.looks import CM, Looks

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


class Nodes:
    def __init__(self) -> None:
        self.drawn = SimpleNamespace()

    def __getattr__(self, name: str) -> Any:
        return lambda *args, **kwargs: self.drawn if name == "add_mesh_simple" else SimpleNamespace()


def test_an_elastic_object_returns_to_its_shape() -> None:
    scene, nodes = load_scene("press-a-pad"), Nodes()
    pad = scene.object[0]
    surface = prepare_body(pad).surface
    mesh = SurfaceMesh(surface.vertices.astype("<f4").astype(float), surface.triangles.astype(np.uint32))
    still = (CM * mesh.vertices).astype(np.float32)
    poses = np.tile([0.0, 0.0, 0.008, 1.0, 0.0, 0.0, 0.0], (80, 1))  # until the damping has decayed
    poses[-1, 2] = 0.03
    pressed, free = np.asarray(Engine("press-a-pad").run(poses))[-2:]
    displacement = pressed[AT.contact_displacement : AT.contact_displacement + 3]
    assert displacement[2] < -5e-4 and free[AT.contact_mode] == 0.0
    for tick in (0, 5000):
        bodies = BodyNodes(nodes, scene, SceneStart(tick, 0, 1e-3, True))
        bodies.draw(0, mesh)
        for _ in range(2):
            bodies.deform({"": pressed})
            moved = (nodes.drawn.vertices - still) / CM
            lowest = int(moved[:, 2].argmin())
            assert moved[lowest, 2] == pytest.approx(displacement[2], rel=0.2)
            assert np.linalg.norm(mesh.vertices[lowest, :2]) < 0.01
            assert abs(moved[mesh.vertices[:, 2] < 1e-6]).max() < 1e-8
            bodies.deform({"": free})
            assert (nodes.drawn.vertices == still).all()


def test_boxes_without_contacts_are_drawn_at_their_poses() -> None:
    scene = load_scene("stack-boxes")
    assert [element.name for element in scene.object] == ["floor", "top"]
    assert [element.name for element in list_visual_geoms(scene)] == ["bottom", "middle"]
    viser = pytest.importorskip("viser")
    server = viser.ViserServer(port=0, verbose=False)
    try:
        bodies = BodyNodes(server.scene, scene, SceneStart(0, 0, 1e-3, True))
        upright = (1.0, 0.0, 0.0, 0.0)
        bodies.move_bodies(dict.fromkeys(("bottom", "middle"), ((0.0, 0.1, 0.2), upright)))
        assert [place[0] for place in bodies.poses[2:]] == [(0.0, 0.1, 0.2)] * 2
        for point, height in (((0.1, 0.0, 0.1), 0.0), ((0.0, 0.1, 0.3), 0.215)):  # next to them, and on one of 30 mm
            foot = bodies.below(np.array(point))
            assert foot is not None and foot.point.tolist() == pytest.approx([*point[:2], height])
    finally:
        server.stop()


def test_a_missing_model_draws_no_more_bodies() -> None:
    """The model may be missing if the daemon runs on another machine."""
    scene = load_scene("stack-boxes")
    elsewhere = msgspec.structs.replace(scene.world, model="/no/such/place.xml")
    assert list_visual_geoms(msgspec.structs.replace(scene, world=elsewhere)) == []


numbers = st.floats(-1.0, 1.0)
vectors = st.tuples(numbers, numbers, numbers).map(np.array)
turns = st.tuples(numbers, numbers, numbers, numbers).filter(lambda q: np.linalg.norm(q) > 0.1)


@given(turns, vectors, st.floats(-1.2, 1.2), vectors)
def test_a_paddle_displays_the_force_along_its_arc(turn, origin, angle, force):
    radius, step = 0.09, 1e-6
    mounting = Mounting(position_m=tuple(origin.tolist()), orientation_wxyz=turn)
    _, unit = mounting.frame()

    def place(a: float) -> np.ndarray:
        return origin + rotate(unit, radius * np.array([np.sin(a), 0.0, np.cos(a) - 1.0]))

    tangent = (place(angle + step) - place(angle - step)) / (2.0 * step * radius)
    freedom = make_subspace(Paddle(length_m=radius, torque_max_nm=0.2), mounting)
    # rounding of positions of 1 m over steps of 90 nm
    np.testing.assert_allclose(freedom.project_force(place(angle), force), (force @ tangent) * tangent, atol=1e-7)


@given(vectors)
def test_a_pantograph_displays_the_force_in_its_plane(force: np.ndarray) -> None:
    (handle,) = find_low_dof_devices({"rig": describe(load_rig("haply-2diy"))}).values()
    row = np.zeros(RECORD_SIZE)
    row[AT.force : AT.force + 3], row[AT.probe_position] = force, 0.03
    np.testing.assert_allclose(handle.displayed_force(row), force * (1.0, 0.0, 1.0), atol=1e-12)
    assert find_low_dof_devices({"rig": describe(load_rig("woodenhaptics-v3"))}) == {}
    assert find_low_dof_devices({"rig": {"device": {"driver": "of somebody else", "kinematics": 3}}}) == {}
    assert find_low_dof_devices({}) == {}


def test_the_arrow_shows_the_displayed_force_and_dashes_the_rest() -> None:
    viser = pytest.importorskip("viser")
    server, scene = viser.ViserServer(port=0, verbose=False), load_scene("paper-plane")
    try:
        bodies = BodyNodes(server.scene, scene, SceneStart(0, 0, 1e-3, True))
        nodes = FingerNodes(server.scene, scene, scene.fingers[0], bodies)
        (handle,) = find_low_dof_devices({"rig": describe(load_rig("haply-2diy"))}).values()
        nodes.displayed_force = handle.displayed_force
        row = np.zeros(RECORD_SIZE)
        row[AT.probe_orientation], row[AT.force : AT.force + 3] = 1.0, (3.0, 4.0, 1.0)
        nodes.show(row[None], Looks(), 2.0)
        begin, end = nodes._force.points[0]
        np.testing.assert_allclose(end - begin, [1.5, 0.0, 0.5], atol=1e-6)
        lost = nodes._missing_force.points
        np.testing.assert_allclose(lost[-1, 1] - lost[0, 0], [0.0, 2.0, 0.0], atol=1e-6)
        assert nodes._missing_force.visible
        assert "displayed: 3.16 N in its plane" in handle.format_html(row) and "4.00 N" in handle.format_html(row)
        row[AT.force : AT.force + 3] = (0.0, 0.0, 1.0)
        nodes.show(row[None], Looks(), 2.0)
        assert not nodes._missing_force.visible and nodes._force.visible
        assert nodes._force_label.visible and nodes._force_label.text == "1.0 N" and not nodes._patch.visible
        # In contact with a patch of 3 mm, a disc of 1 m in the page's units is scaled by its radius.
        row[AT.contact_mode], row[AT.contact_normal + 2], row[AT.contact_patch_radius] = 1.0, 1.0, 0.003
        row[AT.contact_torsion] = -0.004
        nodes.show(row[None], Looks(), 2.0)
        assert nodes._patch.visible and nodes._patch.scale == pytest.approx(0.003)
        np.testing.assert_allclose(np.linalg.norm(nodes._patch.vertices, axis=1).max(), 100.0)
        assert nodes._torsion_label.visible and nodes._torsion_label.text == "-4.0 mN m"
    finally:
        server.stop()


def test_a_dashed_line_has_gaps_as_long_as_its_dashes() -> None:
    line = make_dashes(np.array([1.0, 0.0, 0.0]), np.array([0.0, 15.0, 0.0]))
    np.testing.assert_allclose(line[:, :, 1], [[2.0 * k, 2.0 * k + 1.0] for k in range(8)])
