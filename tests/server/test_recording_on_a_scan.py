"""A shipped recording over a bumpy mesh, by the command line: every change of the force has a cause."""

import sys

import numpy as np
import pytest
from helpers import meshes
from helpers.programs import run_program
from helpers.touching import FRICTION, Array, R, write_part

from softfinger.drivers.poses import load_poses
from softfinger.proxy.record import SLIDING

STIFFNESS = 1000.0
"""Of the object and of the coupling, N/m."""
BALL, BUMPS = 0.15, 0.003
DEEPER, WIDER = 0.002, 2.0
ROUNDING = 1e-9
pytestmark = pytest.mark.exhaustive  # half a minute of compiling; tests/proxy has bumpy meshes tick by tick
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
def scan_records(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Array]:
    folder = tmp_path_factory.mktemp("scan")
    vertices, triangles = meshes.bumpy_sphere(64, BALL, height=BUMPS, waves=80.0)
    up = np.array([0.6, 0.48, 0.64])  # where the bumps are high: they are 0 on the axes
    east = np.cross(up, (0.0, 0.0, 1.0))
    east /= np.linalg.norm(east)
    vertices = vertices @ np.stack([east, np.cross(up, east), up]).T
    under = (np.hypot(vertices[:, 0], vertices[:, 1]) < 4e-3) & (vertices[:, 2] > 0.0)
    write_part(folder, vertices - (0.0, 0.0, vertices[under, 2].max()), triangles, "scan.ply")
    hand = load_poses("press-roll-spin-drag")
    places = hand.position * (WIDER, WIDER, 1.0) - (0.0, 0.0, DEEPER)
    table = np.column_stack([hand.t, places, hand.orientation])
    np.savetxt(folder / "hand.csv", table, delimiter=",", header="t,x,y,z,qw,qx,qy,qz", comments="")
    (folder / "scan.toml").write_text(SCENE)
    words = ["simulate", "--scene", "scan.toml", "--poses", "hand.csv", "--out", "out.npz"]
    command = [sys.executable, "-m", "softfinger.server.cli", *words]
    completed = run_program(command, cwd=folder, timeout=550)
    assert completed.returncode == 0, completed.stderr
    with np.load(folder / "out.npz") as results:
        return dict(results)


def compute_steps(values: Array) -> Array:
    return np.linalg.norm(np.diff(values, axis=0), axis=1)


def compute_tangential(scan_records: dict[str, Array]) -> Array:
    total = np.zeros_like(scan_records["force"])
    for patch in range(3):
        force, normal = scan_records[f"contacts{patch}.force"], scan_records[f"contacts{patch}.normal"]
        total += force - np.einsum("ij,ij->i", force, normal)[:, None] * normal
    return total


def test_the_recording_covers_all_kinds_of_contact(scan_records: dict[str, Array]) -> None:
    depth = np.linalg.norm(scan_records["proxy.position"] - scan_records["probe.position"], axis=1)
    assert 2e-3 < depth.max() < 6e-3
    assert set(scan_records["contact.mode"].astype(int)) == {0, 1, 2}
    assert (scan_records["contacts2.object"] >= 0).sum() > 100
    assert len(np.unique(scan_records["contact.normal"].round(6), axis=0)) > 1000


def test_all_is_finite_and_no_search_was_truncated(scan_records: dict[str, Array]) -> None:
    assert all(np.isfinite(values).all() for values in scan_records.values())
    assert not scan_records["contact.budget"].any()


def test_force_steps_are_explained_by_depth_and_slip(scan_records: dict[str, Array]) -> None:
    """The change of the force per tick is bounded by the motion.

    The pressing force is K times the distance from the probe to the frictionless proxy. That proxy is not recorded, but
    moves no farther per tick than the probe and the recorded proxy: |dF| <= K (|dx| + |dy|) plus the change of the
    friction. The friction spring is loaded by the same displacements and by r d(theta) of rolling, and changes by depth
    times the rotation of the normal. When sticking ends, friction falls from the static to the kinetic cone.
    """
    probe, proxy = compute_steps(scan_records["probe.position"]), compute_steps(scan_records["proxy.position"])
    rolled = 2.0 * R * compute_steps(scan_records["probe.orientation"])  # a quaternion changes by half the angle
    farther = scan_records["contact.normal_force"][:-1] * compute_steps(scan_records["contact.normal"])
    let_go = (scan_records["contact.cause"][:-1] != 0.0) & (scan_records["contact.mode"][:-1] == SLIDING)
    falls = (FRICTION["static"] - FRICTION["kinetic"]) * scan_records["contact.normal_force"][:-1] * let_go
    friction = compute_steps(compute_tangential(scan_records))
    assert compute_steps(scan_records["force"]).max() > 0.1  # a slip starts, so there are large steps
    assert (compute_steps(scan_records["force"]) <= STIFFNESS * (probe + proxy) + friction + ROUNDING).all()
    assert (friction <= STIFFNESS * (probe + proxy + rolled) + farther + falls + ROUNDING).all()
