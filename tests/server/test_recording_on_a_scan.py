"""A shipped recording over a mesh full of bumps, by the command line: no force comes of itself."""

import subprocess
import sys

import numpy as np
import pytest
from helpers import meshes
from helpers.touching import FRICTION, Array, R, saved

from softfinger.drivers.poses import load_poses
from softfinger.proxy.record import SLIDING

STIFFNESS = 1000.0
"""Of the object and of the coupling, N/m."""
BALL, BUMPS = 0.15, 0.003
DEEPER, WIDER = 0.002, 2.0
ROUNDING = 1e-9
pytestmark = pytest.mark.exhaustive  # half a minute of compiling; tests/proxy has meshes with bumps tick by tick
SCENE = f"""
[fingertip]
radius_m = {R}
[rolling]
method = "midpoint"
[coupling]
stiffness_n_per_m = {STIFFNESS}
damping_ns_per_m = 0.0
[[object]]
name = "scan"
shape = "mesh"
file = "scan.ply"
[object.material]
stiffness_n_per_m = {STIFFNESS}
friction = {{ static = {FRICTION["static"]}, kinetic = {FRICTION["kinetic"]} }}
torsion = {{ stiffness_nm_per_rad = 0.05, friction_length_m = 0.004 }}
"""


@pytest.fixture(scope="module")
def visited(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Array]:
    """Fields of all ticks: press, roll, spin and drag, twice as wide and 2 mm deeper, over 82 000 triangles."""
    folder = tmp_path_factory.mktemp("scan")
    vertices, triangles = meshes.bumpy_sphere(64, BALL, height=BUMPS, waves=80.0)
    up = np.array([0.6, 0.48, 0.64])  # where the bumps are high: they are 0 on the axes
    east = np.cross(up, (0.0, 0.0, 1.0))
    east /= np.linalg.norm(east)
    vertices = vertices @ np.stack([east, np.cross(up, east), up]).T
    under = (np.hypot(vertices[:, 0], vertices[:, 1]) < 4e-3) & (vertices[:, 2] > 0.0)
    saved(folder, vertices - (0.0, 0.0, vertices[under, 2].max()), triangles, "scan.ply")
    hand = load_poses("press-roll-spin-drag")
    places = hand.position * (WIDER, WIDER, 1.0) - (0.0, 0.0, DEEPER)
    table = np.column_stack([hand.t, places, hand.orientation])
    np.savetxt(folder / "hand.csv", table, delimiter=",", header="t,x,y,z,qw,qx,qy,qz", comments="")
    (folder / "scan.toml").write_text(SCENE)
    words = ["simulate", "--scene", "scan.toml", "--poses", "hand.csv", "--out", "out.npz"]
    command = [sys.executable, "-m", "softfinger.server.cli", *words]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=550)
    assert done.returncode == 0, done.stderr
    with np.load(folder / "out.npz") as found:
        return dict(found)


def step(values: Array) -> Array:
    """How far a field (n, k) goes in each tick."""
    return np.linalg.norm(np.diff(values, axis=0), axis=1)


def tangential(visited: dict[str, Array]) -> Array:
    """Force (n, 3) N of friction, of all patches."""
    total = np.zeros_like(visited["force"])
    for patch in range(3):
        force, normal = visited[f"contacts{patch}.force"], visited[f"contacts{patch}.normal"]
        total += force - np.einsum("ij,ij->i", force, normal)[:, None] * normal
    return total


def test_it_goes_over_bumps_as_a_hand_does(visited: dict[str, Array]) -> None:
    """A few millimetres deep; stuck, sliding and free; held by one, two and three triangles: all of it is looked at."""
    depth = np.linalg.norm(visited["proxy.position"] - visited["probe.position"], axis=1)
    assert 2e-3 < depth.max() < 6e-3
    assert set(visited["contact.mode"].astype(int)) == {0, 1, 2}
    assert (visited["contacts2.object"] >= 0).sum() > 100
    assert len(np.unique(visited["contact.normal"].round(6), axis=0)) > 1000


def test_all_is_finite_and_no_search_was_cut_short(visited: dict[str, Array]) -> None:
    """No NaN, and no tick that had to leave triangles unasked."""
    assert all(np.isfinite(values).all() for values in visited.values())
    assert not visited["contact.budget"].any()


def test_no_force_jumps_by_more_than_depth_and_slip_explain(visited: dict[str, Array]) -> None:
    """What presses is K times the way from the probe to the proxy without friction. That is not recorded, but goes no
    farther in a tick than the probe and the proxy that is, unless something is lost: |dF| <= K (|dx| + |dy|), and what
    friction changed beside. Friction's spring is wound by the same ways, and by r d(theta) where the fingertip rolls,
    and unwound by depth times the turn of the normal where it is led; where it slips, the proxy goes with it as far as
    a groove lets it, and friction that has just let go falls from one cone to the other."""
    probe, proxy = step(visited["probe.position"]), step(visited["proxy.position"])
    rolled = 2.0 * R * step(visited["probe.orientation"])  # a quaternion goes half the angle
    farther = visited["contact.normal_force"][:-1] * step(visited["contact.normal"])
    let_go = (visited["contact.cause"][:-1] != 0.0) & (visited["contact.mode"][:-1] == SLIDING)
    falls = (FRICTION["static"] - FRICTION["kinetic"]) * visited["contact.normal_force"][:-1] * let_go
    friction = step(tangential(visited))
    assert step(visited["force"]).max() > 0.1  # a slip begins: there is something to explain
    assert (step(visited["force"]) <= STIFFNESS * (probe + proxy) + friction + ROUNDING).all()
    assert (friction <= STIFFNESS * (probe + proxy + rolled) + farther + falls + ROUNDING).all()
