"""Mistakes of an experiment that are found before a session."""

from __future__ import annotations

import pytest

from softfinger.config.errors import ConfigError
from softfinger.config.sources import EXPERIMENTS
from softfinger.server.experiment.checks import load

pytestmark = pytest.mark.plain

RISES = [[0.5, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [1.5, 0.0, 0.0, 0.0]]


@pytest.mark.parametrize("table", ["motion", "turn"])
@pytest.mark.parametrize("order", [(1, 0, 2), (2, 1, 0), (0, 2, 1), (0, 0, 1)])
def test_times_of_a_path_increase(table: str, order: tuple[int, ...]) -> None:
    file, paths = EXPERIMENTS / "curvature-by-rolling.toml", {"motion": {"fingertip": RISES}, "turn": {}}
    load(file, paths)
    with pytest.raises(ConfigError, match=rf"{table}\.fingertip = .*: times must increase"):
        load(file, paths | {table: {"fingertip": [RISES[index] for index in order]}})


@pytest.mark.parametrize(("name", "rig"), [("weight-of-a-box", "simulated"), ("path-tracing", "simulated-lift-a-box")])
def test_the_rig_has_a_device_for_each_finger(name: str, rig: str) -> None:
    with pytest.raises(ConfigError, match=r"the scene has \[.*but the rig has \[device"):
        load(EXPERIMENTS / f"{name}.toml", {"rig": rig})
