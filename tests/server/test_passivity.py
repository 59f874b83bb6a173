"""The passivity observer against work summed up independently, and the controller against what it must burn."""

import msgspec
import numpy as np
import pytest

from softfinger.config import schema
from softfinger.config.errors import ConfigError
from softfinger.config.load import build, load_rig, load_scene
from softfinger.drivers.poses import load_poses
from softfinger.drivers.resample import resample
from softfinger.proxy.record import FREE, NAMED, ROLLING
from softfinger.server.loop.passivity import NO_ENERGY, Energy, Passivity, keep_passive
from softfinger.server.loop.tuning import DAMPING_MAX_NS_PER_M, make_tuning
from softfinger.server.offline.simulate import simulate

T = 0.001
PUSH = (0.0, 0.0, 2.0)
NONE = (0.0, 0.0, 0.0)


def column(records, name, size=1):
    at = NAMED[name].at
    return records[:, at : at + size] if size > 1 else records[:, at]


@pytest.mark.parametrize("mode", ["observe", "control"])
def test_energy_is_the_work_against_the_commanded_force(mode):
    """Over a recording, energy changes by minus the held force times the motion; debts alone outlive a touch."""
    scene = msgspec.structs.replace(load_scene("paper-plane"), passivity=schema.Passivity(mode=mode))
    tuning = make_tuning(scene, load_rig("replay").guard)
    records = simulate(tuning, resample(load_poses("press-roll-spin-drag"), 1000.0), 1000.0)
    work, expected = 0.0, []
    force, position = column(records, "force", 3), column(records, "probe.position", 3)
    for n, touching in enumerate(column(records, "contact.mode") != FREE):
        if n:
            work -= force[n - 1] @ (position[n] - position[n - 1])
        if not touching:
            work = min(work, 0.0)
        expected.append(work)
    # Ten thousand additions of terms around 1e-5 J.
    np.testing.assert_allclose(column(records, "passivity.energy"), expected, rtol=0, atol=1e-15)
    assert max(expected) > 1e-4  # the press alone takes f^2 / 2K = 0.5 mJ
    if mode == "observe":
        assert not column(records, "passivity.damping").any()


def test_a_scene_without_the_table_has_no_observer():
    """Without [passivity] energy stays 0, and the force is left alone to the bit."""
    assert make_tuning(load_scene("paper-plane"), load_rig("replay").guard).passivity is None
    assert keep_passive(None, NO_ENERGY, PUSH, (1.0, 1.0, 1.0), float(ROLLING), PUSH, T) == (NO_ENERGY, PUSH)


def test_a_debt_is_burnt_in_one_tick_at_the_same_speed():
    """The damper's force over a motion like the last one does exactly the work that was owed."""
    moved, owed = (0.0, 3e-5, 4e-5), 2e-7
    energy, force = keep_passive(Passivity(1e4), Energy(-owed, 0.0), NONE, moved, float(ROLLING), NONE, T)
    assert energy.work == -owed
    # Three products and their sum.
    assert -np.dot(force, moved) == pytest.approx(owed, rel=1e-14)
    assert energy.damping == pytest.approx(owed * T / np.dot(moved, moved), rel=1e-14)


def test_damping_is_bounded_however_slow_the_hand():
    """A hand at rest, or nearly, meets at most the largest damping, and no number overflows."""
    for step in (0.0, 1e-300, 1e-160, 1e-9):
        energy, force = keep_passive(
            Passivity(20.0), Energy(-1.0, 0.0), NONE, (step, 0.0, 0.0), float(ROLLING), PUSH, T
        )
        assert energy.damping == 20.0
        assert force == (-20.0 / T * step, 0.0, 2.0)


def test_release_forgets_what_was_taken_and_keeps_what_is_owed():
    """In free space energy above zero is dropped; a debt stays and is still damped."""
    for before, after in ((0.5, 0.0), (-0.5, -0.5)):
        energy, _ = keep_passive(Passivity(20.0), Energy(before, 0.0), NONE, (1e-5, 0.0, 0.0), float(FREE), PUSH, T)
        assert energy.work == after
        assert (energy.damping > 0.0) == (after < 0.0)


def test_no_time_no_damping():
    """A tick of no length has no speed to damp."""
    owed = Energy(-1.0, 0.0)
    assert keep_passive(Passivity(20.0), owed, NONE, (1e-5, 0.0, 0.0), float(ROLLING), PUSH, 0.0) == (owed, PUSH)


def test_largest_damping_is_for_control_only():
    """Observing takes no damping; control without one takes the default."""
    guard = load_rig("replay").guard
    material = {"stiffness_n_per_m": 1000.0}
    table = {"fingertip": {"radius_m": 0.01}, "object": [{"name": "a", "shape": "plane", "material": material}]}
    with pytest.raises(ConfigError, match=r"passivity.damping_max_ns_per_m = 5.0: is for mode"):
        build(schema.Scene, table | {"passivity": {"mode": "observe", "damping_max_ns_per_m": 5.0}}, "here")
    for mode, damping in (("control", DAMPING_MAX_NS_PER_M), ("observe", 0.0)):
        scene = build(schema.Scene, table | {"passivity": {"mode": mode}}, "here")
        assert make_tuning(scene, guard).passivity == Passivity(damping)


def test_the_guard_stands_after_the_controller():
    """A damper of any size ends in the guard's clamp and slew limit: what it adds is guarded like every other force."""
    scene = msgspec.structs.replace(
        load_scene("paper-plane"), passivity=schema.Passivity(mode="control", damping_max_ns_per_m=1000.0)
    )
    guard = schema.Guard(force_max_n=3.0, force_slew_n_per_s=1000.0, ramp_s=0.01)
    poses = np.zeros((400, 7))
    poses[:, 3] = 1.0
    # Torn out and pushed in again, so that more is given than was taken, at up to 0.75 m/s.
    poses[:, 2] = 0.009 + 0.003 * np.sin(0.25 * np.arange(400))
    records = simulate(make_tuning(scene, guard), poses, 1000.0)
    damper = column(records, "passivity.damping") * np.gradient(poses[:, 2]) / T
    force = column(records, "force", 3)
    assert np.abs(damper).max() > 10.0  # N: far beyond both limits
    assert np.linalg.norm(force, axis=1).max() <= 3.0 * (1 + 1e-12)  # roundings of a norm
    assert np.linalg.norm(np.diff(force, axis=0), axis=1).max() <= 1.0 * (1 + 1e-9)
