"""Kernels give the same bits compiled and as plain Python: the shipped scenes, and a roll by each method."""

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.programs import run_program
from references.rolling_cases import METHODS, RADIUS, SHAPES, pairs, roll_long, touching

from softfinger.proxy.engine import Engine
from softfinger.proxy.kernels.jit.decorators import PLAIN
from softfinger.proxy.record import AT

CENTERS = {
    "paper-plane": (0.0, 0.0, 0.01),
    "corner": (0.0005, 0.0005, 0.01),
    "sphere": (0.0, 0.0, 0.01),
    "heightmap": (0.0, 0.0, 0.01),
    "ribbed-plane": (0.0, 0.0, 0.01),
    "pinch": (0.0, 0.0, 0.05),
    "press-a-pad": (0.0, 0.0, 0.0085),
}
"""Position of first touch, m, for each scene; in pinch that of the index finger."""
TICKS = 1200


def hand_path(center: Any) -> Any:
    """Poses (n, 7) that press, drag, roll, spin and lift repeatedly, with growing amplitude."""
    t = np.linspace(0.0, 12.0, TICKS)
    aside = 0.0005 * t
    away = [aside * np.sin(1.3 * t), aside * np.sin(1.7 * t), 0.004 * (0.3 - np.sin(0.9 * t))]
    points = np.array(center) + np.stack(away, axis=1)
    turned = 0.02 * t[:, None] * np.sin(t[:, None] * [1.1, 1.9, 2.3])
    return np.hstack([points, np.sqrt(1.0 - np.sum(turned**2, axis=1, keepdims=True)), turned])


def records_of(name: str) -> Any:
    engine = Engine(name)
    if len(engine.fingers) == 1:
        return engine.run(hand_path(CENTERS[name]))[:, None].copy()
    records = engine.run({"index": hand_path(CENTERS[name]), "thumb": hand_path((-0.03, 0.0, 0.0))})
    return np.stack([records[finger] for finger in engine.fingers], axis=1)


def write_records(folder: Path, names: Sequence[str]) -> None:
    assert PLAIN
    for name in names:
        np.save(folder / name, records_of(name))


@pytest.fixture(scope="module")
def plain(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the records of the selected scenes, from another process with kernels as plain Python."""
    folder = tmp_path_factory.mktemp("plain")
    test = test_records_of_a_scene_are_the_same_bits.__name__
    names = [item.callspec.params["name"] for item in request.session.items if item.originalname == test]
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    run_program([sys.executable, __file__, str(folder), *names], env=environment, check=True)
    return folder


@pytest.mark.plain
@pytest.mark.skipif("SOFTFINGER_TESTS_ARE_PLAIN" not in os.environ, reason="for the logic part of tests/run.py")
def test_logic_part_runs_plain_kernels_and_its_programs_machine_code() -> None:
    assert PLAIN and "NUMBA_DISABLE_JIT" not in os.environ


LESS = ("paper-plane", "pinch")
"""Scenes in `make test`: one object; two fingers with a fourth-order method."""


@pytest.mark.parametrize("name", [n if n in LESS else pytest.param(n, marks=pytest.mark.exhaustive) for n in CENTERS])
def test_records_of_a_scene_are_the_same_bits(plain: Path, name: str) -> None:
    compiled = records_of(name)
    assert np.load(plain / f"{name}.npy").tobytes() == compiled.tobytes()
    assert set(compiled[..., AT.contact_mode].ravel().tolist()) == {0.0, 1.0, 2.0}


SOME = {("rotation_vector", "hollow sphere"), ("euler_zyx", "plane"), ("montana_rk45", "ellipsoid")}
"""Cases in `make test`: the methods that no scene above uses."""


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("method", "name"),
    [pytest.param(*pair, marks=[] if pair in SOME else [pytest.mark.exhaustive]) for pair in pairs()],
)
@pytest.mark.skipif(PLAIN, reason="there is nothing compiled to compare with")
def test_rolls_are_the_same_numbers(method: str, name: str) -> None:
    center, normal = touching(SHAPES[name], np.random.default_rng(19))
    case = (METHODS[method], SHAPES[name], RADIUS, center, normal, (0.2, -0.15, 0.17), 8)
    (off, stretched, compiled), (plain_off, plain_stretched, plain) = roll_long(*case), roll_long.py_func(*case)
    assert (off, stretched) == pytest.approx((plain_off, plain_stretched), abs=1e-15)
    for a, b in zip(compiled, plain, strict=True):
        # No floating-point contraction, and the same sin and cos: differences of little more than the last bit.
        assert a == pytest.approx(b, rel=1e-13, abs=1e-15)


if __name__ == "__main__":
    write_records(Path(sys.argv[1]), sys.argv[2:])
