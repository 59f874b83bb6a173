"""Energy of an elastic object as the passivity layer of the whole tick observes it, and its damper."""

from typing import Any

import numpy as np
import pytest

from softfinger.config import schema
from softfinger.config.load import build, describe, load_scene
from softfinger.proxy.kernels.jit.pack import packed
from softfinger.proxy.record import NAMED, RECORD_SIZE
from softfinger.server.loop.tick import Tuning, begin
from softfinger.server.loop.tuning import make_tuning
from softfinger.server.offline.simulate import run_ticks, simulate

pytestmark = pytest.mark.plain

RATE_HZ = 1000.0
STIFFNESS = 1000.0
RADIUS = 0.01
INSIDE = (0.002, 0.0045)
"""x, y, m, in a facet of the pad, 2 mm from its edges."""


def tune_pad(mode: str = "observe", **elastic: float) -> Tuning:
    """Return the frictionless pad, whose top is z = 0, with a guard that limits nothing after 10 ticks."""
    scene = describe(load_scene("press-a-pad"))
    pad = scene["object"][0]
    pad["elastic"] |= {"damping_s": 0.0} | elastic
    pad["material"] = {"stiffness_n_per_m": STIFFNESS}
    return tune_scene(pad, mode)


def tune_scene(surface: dict[str, Any], mode: str) -> Tuning:
    table = {"object": [surface], "fingertip": {"radius_m": RADIUS}, "passivity": {"mode": mode}}
    return make_tuning(build(schema.Scene, table, "here"), schema.Guard(ramp_s=0.01, force_slew_n_per_s=1e5))


def tune_plane(mode: str, stiffness: float) -> Tuning:
    table = {"shape": "plane", "name": "a", "material": {"stiffness_n_per_m": stiffness}}
    return tune_scene(table, mode)


def make_poses(x: Any, y: Any, depth: Any) -> Any:
    track = np.zeros((len(depth), 7))
    track[:, 0], track[:, 1], track[:, 2], track[:, 3] = x, y, RADIUS - depth, 1.0
    return track


def column(records: Any, name: str, size: int = 1) -> Any:
    at = NAMED[name].at
    return records[:, at : at + size] if size > 1 else records[:, at]


def test_a_closed_path_generates_the_energy_of_sampling_alone() -> None:
    turn = np.concatenate([np.zeros(50), np.linspace(0.0, 2.0 * np.pi, 401)])
    track = make_poses(INSIDE[0] + 0.0005 * np.sin(turn), INSIDE[1], 0.001 + 0.0005 * (1.0 - np.cos(turn)))
    records = simulate(tune_pad(), track, RATE_HZ)[49:]
    force, energy = column(records, "force", 3), column(records, "passivity.energy")
    sampling = 0.5 * np.sum(np.diff(force, axis=0) * np.diff(track[49:, :3], axis=0))
    assert np.ptp(energy) > 5e-4 and sampling < -1e-7
    assert energy[-1] - energy[0] == pytest.approx(sampling, abs=1e-9)


def test_a_damped_press_dissipates_the_work_of_its_time_constant() -> None:
    """A cycle of amplitude a takes pi a^2 Im K, K = 1 / (1/k + C / (1 + i w T)), i w by the difference of two ticks."""
    time, ticks, amplitude = 0.02, 100, 0.0003
    turn = 2.0 * np.pi * np.arange(5 * ticks + 1) / ticks
    track = make_poses(*INSIDE, 0.001 + amplitude * np.sin(turn))
    still, moving = (simulate(tune_pad(damping_s=damping_s), track, RATE_HZ)[-ticks - 1 :] for damping_s in (0.0, time))
    force, depth = column(still, "force", 3)[:, 2], RADIUS - track[-ticks - 1 :, 2]
    compliance = amplitude / (0.5 * np.ptp(force)) - 1.0 / STIFFNESS
    rate = (1.0 - np.exp(-1j * turn[1])) * RATE_HZ
    stiffness = 1.0 / (1.0 / STIFFNESS + compliance / (1.0 + rate * time))
    dissipated = [
        column(records, "passivity.energy")[-1]
        - column(records, "passivity.energy")[0]
        - 0.5 * np.sum(np.diff(column(records, "force", 3)[:, 2]) * -np.diff(depth))  # of sampling
        for records in (still, moving)
    ]
    assert abs(dissipated[0]) < 1e-9
    assert dissipated[1] == pytest.approx(np.pi * amplitude**2 * stiffness.imag, rel=0.03)


def press_and_release(tunings: list[Tuning], depth: Any) -> Any:
    """Return the records (2, n) of a press under the first tuning and of the same path back under the second."""
    track = make_poses(*INSIDE, depth)[:, None]
    records, memory = np.zeros((2, len(track), 1, RECORD_SIZE)), packed(begin(tunings[0].scene))
    for stage, part, rows in zip(tunings, (track, track[::-1]), records, strict=True):
        dts = np.full(len(part), 1.0 / RATE_HZ)
        run_ticks(packed(stage), memory, np.ascontiguousarray(part), dts, 1.0 / RATE_HZ, 0, rows)
    return records[:, :, 0]


def test_the_energy_of_a_modulus_that_rises_in_contact_is_dissipated_as_on_a_rigid_object() -> None:
    n, depth = 200, 0.002
    depths = depth * np.concatenate([np.full(50, -1.0 / n), np.arange(1, n + 1) / n])
    energies = []
    for mode in ("observe", "control"):
        soft, stiff = press_and_release([tune_pad(mode, youngs_pa=modulus) for modulus in (5e4, 1e5)], depths)
        rigid = [tune_plane(mode, column(rows, "contact.normal_force").max() / depth) for rows in (soft, stiff)]
        _, back = press_and_release(rigid, depths)
        energies.append([column(rows, "passivity.energy")[n - 1] for rows in (stiff, back)])
        assert energies[-1][0] == pytest.approx(energies[-1][1], rel=0.03)
    assert energies[0][0] < -2e-4 and energies[1][0] > 0.7 * energies[0][0]
