"""Statistics of measured times: percentiles, their medians over blocks, and missed deadlines during the measurement."""

from pathlib import Path

import mujoco
import numba
import numpy as np
import pytest

from softfinger.config.load import load_scene
from softfinger.proxy.scene import build_scene
from softfinger.tools.bench.geoms import KINDS, make_scene
from softfinger.tools.bench.loop import count_missed_by_c, evaluate
from softfinger.tools.measure import compute_quantiles

pytestmark = pytest.mark.plain


def test_a_stall_spoils_the_percentiles_of_one_block_only() -> None:
    block = np.arange(1.0, 101.0)
    # the remainder is not a block
    result = compute_quantiles(np.concatenate([block, block, 100.0 * block, block, block, [7.0]]), 100)
    assert result["max"] == 10_000.0 and result["p99"] > 100.0
    # Percentiles of 1 to 100 by linear interpolation: 1 + 99 q.
    assert result["blocks"] == pytest.approx({"p50": 50.5, "p99": 99.01, "p999": 99.901, "max": 100.0}, rel=1e-12)


def test_fewer_values_than_a_block_are_one() -> None:
    result = compute_quantiles(np.array([3.0, 1.0, 2.0]), 100)
    assert result.pop("blocks") == result == {"p50": 2.0, "p99": 2.98, "p999": 2.998, "max": 3.0}


def test_deadlines_missed_before_a_measurement_do_not_count() -> None:
    rows = np.full((6, 4), 1e-5)
    rows[:, 3] = [7.0, 7.0, 9.0, 3.0, 4.0, 4.0]
    result = evaluate({"servo": rows}, 1000.0)["servo"]
    assert (result["ticks"], result["missed"]) == (6, 3)


def test_deadlines_that_the_c_loop_missed_are_counted_as_those_of_the_servo() -> None:
    rows = np.array([[1e-4, 1e-5, 4e-4], [1e-4, 1e-5, 1.1e-3], [3.4e-3, 1e-5, 1e-4]])
    assert count_missed_by_c(rows, 1e-3) == 4


def test_a_scene_of_more_geoms_has_the_same_code(tmp_path: Path) -> None:
    scenes = [build_scene(load_scene(make_scene(count, 1000.0, tmp_path))) for count in (8, 20)]
    assert numba.typeof(scenes[0]) == numba.typeof(scenes[1])


def test_bodies_of_a_bench_lie_on_their_floor(tmp_path: Path) -> None:
    described = make_scene(8, 1000.0, tmp_path)
    objects = [(entry.name, entry.shape) for entry in load_scene(described).object]
    assert [name for name, _ in objects] == [f"{kind}-{n}" for n, kind in enumerate(2 * list(KINDS))]
    model = mujoco.MjModel.from_xml_path(described["world"]["model"])
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    began = data.xpos.copy()
    for _ in range(300):
        mujoco.mj_step(model, data)
    assert model.ngeom == 9 and data.ncon >= 8
    assert np.abs(data.xpos - began).max() < 1e-3  # MuJoCo's floor is soft: a body sinks into it by that order
