"""Limits of the guard from rig and device, and warnings about scenes."""

import dataclasses
import math
from pathlib import Path

import numba
import pytest

from softfinger.config import schema
from softfinger.config.load import load_scene
from softfinger.drivers.base import DeviceInfo
from softfinger.proxy.engine import Engine
from softfinger.proxy.kernels.model import State
from softfinger.server.loop.guard import Guard
from softfinger.server.loop.limits import SLOW_TIME_S, UNLIMITED, Limits, Workspace
from softfinger.server.loop.tick import begin
from softfinger.server.loop.tuning import guard_limits, make_tuning

FAR = (1.0, 1.0, 1.0)
STRONG = DeviceInfo("strong", 6, 6, 100.0, 10.0, 1e4, 10.0, (-1.0, -1.0, -1.0), FAR)
RIG = schema.Guard(
    force_max_n=7.0, torque_max_nm=0.2, force_slew_n_per_s=1234.0, torque_slew_nm_per_s=56.0, ramp_s=0.25,
    speed_max_m_per_s=4.0, turn_max_rad_per_s=30.0, frozen_s=2.0,
    handle_speed_max_m_per_s=1.5, continuous_force_n=3.0, heat_time_s=20.0, energy_max_j=0.4,
    workspace=schema.Workspace(center_m=(0.1, 0.0, 0.0), radius_m=0.05, stiffness_n_per_m=300.0, force_max_n=4.0),
    arm="command",
)  # fmt: skip
WALL = Workspace((0.1, 0.0, 0.0), (0.0, 0.0, 0.0), 0.05, 300.0, 4.0)
HAND = Limits(1.5, math.inf, 3.0, 20.0, 0.4, WALL)
LIMITS = Guard(7.0, 0.2, 1234.0, 56.0, 0.25, 1.0, 4.0, 30.0, 2.0, limits=HAND)


def test_every_limit_of_the_rig_reaches_the_guard():
    assert guard_limits(RIG, STRONG) == LIMITS
    box = schema.Guard(continuous_force_n=3.0, workspace=schema.Workspace(size_m=(0.1, 0.08, 0.06)))
    wall = Workspace((0.0, 0.0, 0.0), (0.05, 0.04, 0.03), 0.0, 500.0, 4.0)
    assert guard_limits(box, STRONG).limits == Limits(2.0, SLOW_TIME_S, 3.0, 30.0, 0.2, wall)
    assert guard_limits(schema.Guard(arm="button"), STRONG).limits.slow_s == math.inf


def test_poses_are_checked_only_with_a_force_in_a_hand():
    believing = LIMITS._replace(speed_max=math.inf, turn_max=math.inf, frozen=0.0, limits=UNLIMITED)
    recorded, puck = dataclasses.replace(STRONG, own_clock=True), dataclasses.replace(STRONG, actuated_dof=0)
    assert (
        guard_limits(RIG)
        == guard_limits(RIG, recorded)
        == guard_limits(RIG, puck)._replace(displays_torque=1.0)
        == believing
    )


@pytest.mark.parametrize(("field", "limit"), [("force_max_n", "force_max"), ("torque_max_nm", "torque_max")])
def test_limits_are_lowered_to_those_of_the_device(field, limit, caplog):
    weak = dataclasses.replace(STRONG, **{field: 0.1})
    assert guard_limits(RIG, weak) == LIMITS._replace(**{limit: 0.1})
    assert make_tuning(load_scene("paper-plane"), RIG, [weak]).guards == (guard_limits(RIG, weak),)
    assert f"guard.{field}" in caplog.text and "0.1" in caplog.text


def test_devices_without_torque_are_known():
    for driven, turns in ((3, 0.0), (6, 1.0)):
        assert guard_limits(RIG, dataclasses.replace(STRONG, actuated_dof=driven)).displays_torque == turns
    assert guard_limits(RIG).displays_torque == 1.0


@pytest.mark.parametrize(("exponent", "stiffness"), [(1.0, 1000.0), (1.5, 1.5 * 12.0 ** (1 / 3) * 1000.0)])
def test_an_object_stiffer_than_the_device_gives_a_warning(exponent, stiffness, caplog):
    scene = load_scene("paper-plane", {"object.0.material.normal.exponent": exponent})
    for limit, has_warning in ((1.001 * stiffness, False), (0.999 * stiffness, True)):
        caplog.clear()
        make_tuning(scene, schema.Guard(force_max_n=12.0), [dataclasses.replace(STRONG, stiffness_max_n_per_m=limit)])
        assert (f"'table' has {stiffness:.0f} N/m at the guard's 12 N" in caplog.text) == has_warning


def test_a_geom_without_contacts_gives_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    model = tmp_path / "model.xml"
    model.write_text(
        '<mujoco><asset><hfield name="h" nrow="3" ncol="3" size="2 1 1 1"/></asset><worldbody>'
        '<geom name="hills" type="hfield" hfield="h"/><geom name="own" type="hfield" hfield="h"/><geom size="1"/>'
        '<geom size="1" contype="0" conaffinity="0"/>'
        '<flexcomp name="cloth" type="grid" count="2 2 1" spacing="1 1 1" dim="2"/></worldbody></mujoco>'
    )
    material = {"stiffness_n_per_m": 500.0}
    own = {"name": "own", "shape": "plane", "material": material}
    world = {"model": str(model), "geom": [{"name": name, "material": material} for name in ("hills", "own")]}
    make_tuning(load_scene({"fingertip": {"radius_m": 0.01}, "world": world, "object": [own]}), RIG)
    hills, cloth = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert hills.startswith("fingers pass through geom 'hills': it is a height field with pixels of 2 m along x and")
    assert cloth == "fingers pass through geom 'cloth': it is a flexible body, which fingers cannot touch"


@pytest.mark.parametrize("name", ["paper-plane", "ball-in-a-bowl"])
def test_loop_and_engine_share_the_kernels_of_the_contact(name):
    engine, tuning = Engine(name), make_tuning(load_scene(name), RIG)
    memory = begin(tuning.scene)
    start = State(memory.world, tuple(finger.contact for finger in memory.fingers))
    assert numba.typeof((tuning.scene, start)) == numba.typeof((engine.scene, engine._begin))
