"""`check --explain`: what a scene costs, measured here."""

from __future__ import annotations

import re

from helpers.called import called


def test_a_scene_is_explained_by_measured_costs() -> None:
    """Cost of a tick and of the bare contact, and the damping that a device needs; of a scene, and of no rig."""
    done = called("check", "--explain", "frictionless-plane", "replay")
    assert done.returncode == 0, done.stderr
    for said in (r"cost of a tick.*\d+ ns", r"bare contact.*\d+ ns", r"1000 N/m; passive at 1000 Hz .* more than 0\.5"):
        assert len(re.findall(said, done.stdout)) == 1, done.stdout
