"""Scene and simulated device in one loop, compared with the daemon, a linear sampled system, and records."""

from collections.abc import Iterable
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import paper_mapping
from helpers.called import read_stdout
from scipy.signal import cont2discrete

from softfinger.config.load import build, load_rig, load_scene
from softfinger.config.schema import Scene
from softfinger.drivers.poses import load_poses
from softfinger.drivers.resample import resample
from softfinger.drivers.simulated import plant as simulation
from softfinger.drivers.simulated.device import open_device
from softfinger.drivers.simulated.options import Options, Simulation, make_simulation
from softfinger.drivers.simulated.plant import Handle, Impedance, make_plant, make_rest_state
from softfinger.proxy.kernels.jit.pack import PackedTree, flatten
from softfinger.proxy.record import AT
from softfinger.proxy.scene import build_scene
from softfinger.server.loop.guard import Guard
from softfinger.server.loop.servo_thread import FINISHED, ServoThread
from softfinger.server.loop.tick import Tuning, begin
from softfinger.server.loop.tuning import make_tuning
from softfinger.server.offline.closed_loop import FIGURES, close_many, run_closed_loop

OPEN_GUARD = Guard(1e9, 1e9, 1e12, 1e12, 0.0, 1.0)
ALOFT = simulation.Intention(1.0, 0.0, (0.0, 0.0, 0.0), 0.0, 0.0)
FORCE = slice(AT.force, AT.force + 3)
POSITION = slice(AT.probe_position, AT.probe_position + 3)


def tune_ice(stiffness: float = 1000.0, damping: float = 0.0, time_constant: float = 0.0) -> Tuning:
    material = {"stiffness_n_per_m": stiffness, "damping_ns_per_m": damping, "friction": None, "torsion": None}
    mapping = paper_mapping(material=material, rolling=None, probe={"velocity_time_constant_s": time_constant})
    return Tuning(build_scene(build(Scene, mapping, "test scene")), (OPEN_GUARD,))


def whole(blocks: Iterable[np.ndarray]) -> np.ndarray:
    """Return the records (n, RECORD_SIZE) of the only finger from blocks (m, 1, RECORD_SIZE)."""
    return np.concatenate([*blocks])[:, 0]


def make_rest_pose(z: float) -> np.ndarray:
    return np.array([0.0, 0.0, z, 1.0, 0.0, 0.0, 0.0])


def test_servo_and_closed_loop_are_bit_identical() -> None:
    ticks = 3000
    options = Options(preset="omega.6", delay_ticks=2, sway_m=(0.0, 0.0, 1e-4), sway_hz=7.0)
    with open_device(options, 1000.0) as device:
        tuning = make_tuning(load_scene("paper-plane"), load_rig("replay").guard, [device.info])
        servo = ServoThread([device], tuning, 1000.0, ticks)
        servo.compile()
        servo.start()
        assert servo.join(60.0).ending == FINISHED
        servo.close()
        written = device.read_log()
    records = whole(run_closed_loop(tuning, [make_simulation(options, 1000.0)], 1000.0, ticks))
    assert np.abs(records[:, FORCE]).max() > 0.1
    assert written.read[:ticks].tolist() == list(range(ticks))
    assert written.wrench[:ticks, :3].tobytes() == records[:, FORCE].tobytes()
    assert not written.wrench[ticks:].any() and len(written.wrench) > ticks


def test_simulate_verb_runs_the_device(tmp_path: Path) -> None:
    words = ["simulate", "--scene", "paper-plane", "--device", "simulated", "--out", str(tmp_path / "out.npz")]
    assert "2000 ticks at 1000 Hz" in read_stdout(*words, "--duration", "2")
    options = build(Options, load_rig("simulated").device.options, "rig")
    with open_device(options, 1000.0) as device:
        tuning = make_tuning(load_scene("paper-plane"), load_rig("simulated").guard, [device.info])
        records = whole(run_closed_loop(tuning, [device.simulation], 1000.0, 2000))
    with np.load(tmp_path / "out.npz") as saved:
        np.testing.assert_array_equal(saved["force"], records[:, FORCE])
    rig = tmp_path / "rig.toml"
    rig.write_text('[device]\ndriver = "simulated"\nrecording = "tap"\nloop = false\n')
    output = read_stdout(*words, "--duration", "60", "--rig", str(rig))
    assert f"{len(resample(load_poses('tap'), 1000.0))} ticks" in output


@pytest.mark.plain
@pytest.mark.parametrize("delay", [0, 1, 2])
@pytest.mark.parametrize("damping", [0.0, 2.0])
def test_pressed_wall_is_the_linear_sampled_system(delay: int, damping: float) -> None:
    """m x'' + b x' = F, F = -K x[k-d] - B (x[k-d] - x[k-d-1]) / T constant over a tick: the same x at every tick."""
    m, b, k, period, count = 0.2, 1.0, 1000.0, 0.001, 18
    tuning = tune_ice(k, damping)
    plant = make_plant(period, Handle((m,) * 3, (b,) * 3, delay=delay))
    device = Simulation(plant, make_rest_state((0.0, 0.0, 0.008)), ALOFT, make_rest_pose(0.008))
    records = whole(run_closed_loop(tuning, [device], 1.0 / period, count))

    a, g, *_ = cont2discrete(
        (np.array([[0.0, 1.0], [0.0, -b / m]]), np.array([[0.0], [1.0 / m]]), np.eye(2), 0), period
    )
    x, previous_x, under_way, expected = np.array([-0.002, 0.0]), -0.002, [0.0] * delay, []
    for _ in range(count):
        expected.append(x[0])
        under_way.append(-k * x[0] - damping * (x[0] - previous_x) / period)
        previous_x, x = x[0], a @ x + g[:, 0] * under_way.pop(0)
    assert min(expected) < -0.001 and max(expected) < 0.0  # always in contact, and moving
    # Positions are of 10 mm and forces of 2 N: a few roundings of 1e-18 m in each of 18 ticks.
    np.testing.assert_allclose(records[:, POSITION][:, 2] - 0.01, expected, atol=1e-15)


def compute_figures(
    tunings: PackedTree, plant: Any, state: Any, pose: np.ndarray, ticks: int, bound: float
) -> np.ndarray:
    figures = np.zeros((len(tunings.values), len(FIGURES)))
    drive = simulation.PlantInputs(ALOFT, pose, np.zeros(simulation.DELAY_LINE_SIZE))
    tables = (PackedTree(plant, flatten(plant)[None]), PackedTree(state, flatten(state)[None]))
    close_many(tunings, begin(tunings.like.scene), *tables, drive, ticks, bound, figures)
    return figures


def test_figures_equal_those_computed_from_records() -> None:
    tuning, ticks = tune_ice(2000.0, 1.0, 0.002), 2000
    plant = make_plant(0.001, Handle((0.2,) * 3, (1.0,) * 3), Impedance(mass=0.1, damping=2.0, stiffness=300.0))
    pose = make_rest_pose(0.008)
    device = Simulation(plant, make_rest_state((0.0, 0.0, 0.02))._replace(goal=(0.0, 0.0, 0.008)), ALOFT, pose)
    records = whole(run_closed_loop(tuning, [device], 1000.0, ticks + 1))
    tunings = PackedTree(tuning, flatten(tuning)[None])
    (row,) = compute_figures(tunings, plant, device.state, pose, ticks, inf)
    end = dict(zip(FIGURES, row, strict=True))
    x, force = records[:, POSITION], records[:-1, FORCE]
    assert (end["ticks"], end["exit_tick"]) == (ticks, -1.0)
    assert end["excursion"] == pytest.approx(np.linalg.norm(x[1:] - x[0], axis=1).max(), rel=1e-15)
    assert end["force"] == pytest.approx(np.linalg.norm(force, axis=1).max(), rel=1e-15) and end["force"] > 1.0
    # The sum of 2000 products, each with every bit of position and force.
    assert end["energy"] == pytest.approx(np.sum(force * np.diff(x, axis=0)), rel=1e-12)


def test_cases_do_not_affect_each_other() -> None:
    stiffness = np.array([500.0, 40000.0, 1000.0, 40000.0, 500.0])
    tuning = tune_ice()
    plant = make_plant(0.001, Handle((0.1,) * 3, (1.0,) * 3), Impedance(damping=1.0, stiffness=100.0))
    state = make_rest_state((0.0, 0.0, 0.009))
    tunings = PackedTree(tuning, np.array([flatten(tune_ice(k)) for k in stiffness]))
    figures = compute_figures(tunings, plant, state, make_rest_pose(0.009), 5000, 0.005)
    exit_ticks = figures[:, FIGURES.index("exit_tick")]
    assert (exit_ticks[[0, 2, 4]] == -1.0).all() and (exit_ticks[[1, 3]] > 0.0).all()
    assert figures[0].tolist() == figures[4].tolist() and figures[1].tolist() == figures[3].tolist()
    assert (figures[[0, 2], FIGURES.index("ticks")] == 5000.0).all()
    assert figures[1, FIGURES.index("ticks")] == figures[1, FIGURES.index("exit_tick")]
    assert figures[1, FIGURES.index("excursion")] > 0.005
