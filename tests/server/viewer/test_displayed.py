"""Forces that devices of one or two degrees of freedom can display. The browser test compiles the paper's plane."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfinger.config.load import describe, load_rig, load_scene
from softfinger.drivers.kinematics.options import Paddle
from softfinger.drivers.kinematics.subspace import make_subspace
from softfinger.drivers.mounting import Mounting
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.server.viewer.displayed import find_low_dof_devices
from softfinger.server.viewer.nodes.bodies import BodyNodes, SceneStart
from softfinger.server.viewer.nodes.fingers import FingerNodes
from softfinger.server.viewer.nodes.glyphs import make_dashes, rotate
from softfinger.server.viewer.nodes.looks import Looks

numbers = st.floats(-1.0, 1.0)
vectors = st.tuples(numbers, numbers, numbers).map(np.array)
turns = st.tuples(numbers, numbers, numbers, numbers).filter(lambda q: np.linalg.norm(q) > 0.1)


@pytest.mark.plain
@given(turns, vectors, st.floats(-1.2, 1.2), vectors)
def test_a_paddle_displays_the_force_along_its_arc(
    turn: Any, origin: np.ndarray, angle: float, force: np.ndarray
) -> None:
    radius, step = 0.09, 1e-6
    mounting = Mounting(position_m=tuple(origin.tolist()), orientation_wxyz=turn)
    _, unit = mounting.frame()

    def place(a: float) -> np.ndarray:
        return origin + rotate(unit, radius * np.array([np.sin(a), 0.0, np.cos(a) - 1.0]))

    tangent = (place(angle + step) - place(angle - step)) / (2.0 * step * radius)
    freedom = make_subspace(Paddle(length_m=radius, torque_max_nm=0.2), mounting)
    assert freedom is not None
    # rounding of positions of 1 m over steps of 90 nm
    np.testing.assert_allclose(freedom.project_force(place(angle), force), (force @ tangent) * tangent, atol=1e-7)


@pytest.mark.plain
@given(vectors)
def test_a_pantograph_displays_the_force_in_its_plane(force: np.ndarray) -> None:
    (handle,) = find_low_dof_devices({"rig": describe(load_rig("haply-2diy"))}).values()
    row = np.zeros(RECORD_SIZE)
    row[AT.force : AT.force + 3], row[AT.probe_position] = force, 0.03
    np.testing.assert_allclose(handle.displayed_force(row), force * (1.0, 0.0, 1.0), atol=1e-12)
    assert find_low_dof_devices({"rig": describe(load_rig("woodenhaptics-v3"))}) == {}
    assert find_low_dof_devices({"rig": {"device": {"driver": "of somebody else", "kinematics": 3}}}) == {}
    assert find_low_dof_devices({}) == {}


@pytest.mark.plain
def test_the_arrow_shows_the_displayed_force_and_dashes_the_rest() -> None:
    viser = pytest.importorskip("viser")
    server = viser.ViserServer(port=0, verbose=False)
    try:
        scene = load_scene("paper-plane")
        nodes = FingerNodes(
            server.scene, scene, scene.fingers[0], BodyNodes(server.scene, scene, SceneStart(0, 0, 1e-3, True))
        )
        (handle,) = find_low_dof_devices({"rig": describe(load_rig("haply-2diy"))}).values()
        nodes.displayed_force = handle.displayed_force
        row = np.zeros(RECORD_SIZE)
        row[AT.probe_orientation] = 1.0
        row[AT.force : AT.force + 3] = (3.0, 4.0, 1.0)
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
        assert nodes._force_label.visible and nodes._force_label.text == "1.0 N"
        assert not nodes._patch.visible
        # In contact with a patch of 3 mm, a disc of 1 m in the page's units is scaled by its radius.
        row[AT.contact_mode], row[AT.contact_normal + 2], row[AT.contact_patch_radius] = 1.0, 1.0, 0.003
        row[AT.contact_torsion] = -0.004
        nodes.show(row[None], Looks(), 2.0)
        assert nodes._patch.visible and nodes._patch.scale == pytest.approx(0.003)
        np.testing.assert_allclose(np.linalg.norm(nodes._patch.vertices, axis=1).max(), 100.0)
        assert nodes._torsion_label.visible and nodes._torsion_label.text == "-4.0 mN m"
    finally:
        server.stop()


@pytest.mark.plain
def test_a_dashed_line_has_gaps_as_long_as_its_dashes() -> None:
    line = make_dashes(np.array([1.0, 0.0, 0.0]), np.array([0.0, 15.0, 0.0]))
    np.testing.assert_allclose(line[:, :, 1], [[2.0 * k, 2.0 * k + 1.0] for k in range(8)])
