"""Parameter ramps: ramped values and exact final values; test_commands.py tests the resulting force."""

import numpy as np
import pytest

from softfinger.config.load import build, load_rig, load_scene
from softfinger.config.schema import Scene
from softfinger.proxy.kernels import model
from softfinger.proxy.kernels.jit.arrays import ReadOnly
from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.proxy.kernels.jit.pack import flatten, unflatten, unpack
from softfinger.proxy.kernels.query.container import find_object
from softfinger.proxy.scene import build_scene
from softfinger.server.loop import parameter_ramp
from softfinger.server.loop.tuning import make_tuning

TICKS = 100
DEPTH_M = 0.01 - 0.009
"""Depth of a press."""
MATERIAL = "object.table.material"


def make_scene(**changes):
    return load_scene("paper-plane", {f"{MATERIAL}.{key}": value for key, value in changes.items()})


def advance(ramp_state, tree, ticks):
    for _ in range(ticks):
        if ramp_state.ticks_left[0] > 0:
            parameter_ramp.advance(ramp_state)
    return unflatten(tree, ramp_state.now)


@pytest.mark.plain
def test_all_values_that_affect_the_force_are_ramped_together():
    old = build_scene(make_scene())
    new = build_scene(make_scene(**{"stiffness_n_per_m": 500.0, "friction.static": 0.2, "friction.kinetic": 0.1}))
    ramp_state = parameter_ramp.make_ramp(old, TICKS)
    parameter_ramp.set_target(ramp_state, flatten(new))
    half = advance(ramp_state, old, TICKS // 2)
    np.testing.assert_allclose(flatten(half), 0.5 * (flatten(old) + flatten(new)), rtol=1e-12)  # fifty additions
    assert half.objects.body.material.friction.kinetic < half.objects.body.material.friction.static
    assert flatten(advance(ramp_state, old, TICKS // 2)).tobytes() == flatten(new).tobytes()
    assert ramp_state.ticks_left[0] == -1


@pytest.mark.plain
def test_positions_and_limits_change_immediately():
    guard = load_rig("replay").guard
    old = make_tuning(make_scene(), guard)
    softer = old._replace(scene=build_scene(make_scene(stiffness_n_per_m=500.0)))
    ramp_state = parameter_ramp.make_ramp(old, TICKS)
    parameter_ramp.set_target(ramp_state, flatten(softer))
    assert advance(ramp_state, old, 60).scene.objects.body.material.normal.stiffness == pytest.approx(700.0, rel=1e-12)
    table = softer.scene.objects.body
    lifted = softer.scene._replace(objects=model.Single(table._replace(shape=table.shape._replace(offset=0.001))))
    weak = softer._replace(guards=(old.guards[0]._replace(force_max=0.0),), scene=lifted)
    parameter_ramp.set_target(ramp_state, flatten(weak))
    now = advance(ramp_state, old, 1)
    assert now.guards[0].force_max == 0.0 and now.scene.objects.body.shape.offset == 0.001
    assert now.scene.objects.body.material.normal.stiffness == pytest.approx(695.0, rel=1e-12)
    assert advance(ramp_state, old, 39) == weak


@pytest.mark.plain
def test_an_array_changes_immediately():
    """Laws of other packages refer to arrays by address, which cannot be interpolated."""
    old, new = (model.Object(None, None, None, model.Material(ReadOnly([k]), None, None), 0.0) for k in (1.0, 2.0))
    ramp_state = parameter_ramp.make_ramp(old, TICKS)
    parameter_ramp.set_target(ramp_state, flatten(new))
    parameter_ramp.advance(ramp_state)
    assert ramp_state.now.tobytes() == flatten(new).tobytes()


@pytest.mark.plain
def test_a_power_law_ramps_its_force_linearly_at_every_depth():
    ends = [
        model.Material(model.PowerNormal(k * DEPTH_M / d**p, p, 0.0), None, None)
        for k, d, p in ((1000.0, DEPTH_M, 1.5), (1000.0, DEPTH_M, 2.5))
    ]
    old, new = (model.Object(None, None, None, material, 0.0) for material in ends)
    ramp_state = parameter_ramp.make_ramp(old, TICKS)
    parameter_ramp.set_target(ramp_state, flatten(new))
    for _ in range(TICKS):
        law = advance(ramp_state, old, 1).material.normal
        assert law.coefficient * DEPTH_M**law.exponent == pytest.approx(1.0, rel=1e-12)  # one power per tick


@entry
def read_stiffness(like, values, index):
    body = find_object(unpack(like, values).objects, index)
    return body.material.normal.stiffness, body.material.friction.static


def test_many_objects_are_ramped():
    def tiles(softer):
        rubber = {"stiffness_n_per_m": 1000.0, "friction": {"static": 0.8, "kinetic": 0.1}}
        place = {"shape": "plane", "material": rubber}
        tables = [{"name": f"n{k}", "position_m": [0.0, 0.0, -k]} | place for k in range(9)]
        tables[3]["material"] = {"stiffness_n_per_m": softer, "friction": {"static": 8e-4 * softer, "kinetic": 0.1}}
        return build_scene(build(Scene, {"fingertip": {"radius_m": 0.01}, "object": tables}, "here"))

    old, new = tiles(1000.0), tiles(500.0)
    ramp_state = parameter_ramp.make_ramp(old, TICKS)
    parameter_ramp.set_now(ramp_state, parameter_ramp.flatten_tuning(old))
    parameter_ramp.set_target(ramp_state, parameter_ramp.flatten_tuning(new))
    for ticks, expected in ((TICKS // 2, 750.0), (TICKS // 2, 500.0)):
        for _ in range(ticks):
            parameter_ramp.advance(ramp_state)
        stiffness, friction = np.transpose([read_stiffness(old, ramp_state.now, float(k)) for k in range(9)])
        assert stiffness == pytest.approx([*[1000.0] * 3, expected, *[1000.0] * 5], rel=1e-12)  # fifty additions
        assert friction == pytest.approx(8e-4 * stiffness, rel=1e-12)
    assert old.objects.entries[3].normal.stiffness == 1000.0 and ramp_state.ticks_left[0] == -1


@pytest.mark.plain
def test_a_ramp_without_ticks_is_immediate():
    old, new = (build_scene(make_scene(stiffness_n_per_m=k)) for k in (1000.0, 500.0))
    ramp_state = parameter_ramp.make_ramp(old, 0)
    parameter_ramp.set_target(ramp_state, flatten(new))
    assert advance(ramp_state, old, 1) == new
