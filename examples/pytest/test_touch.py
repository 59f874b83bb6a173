"""Example tests for a program based on softfinger: the daemon with recorded poses, without a device."""

import json
import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from softfinger.server.pytest_plugin import SoftfingerDaemon

Start = Callable[..., SoftfingerDaemon]

POSES = Path(__file__).parent / "press.csv"
RIG = Path(__file__).parent / "rig.toml"
SCENE = "frictionless-plane"
STIFFNESS_N_PER_M = 1000.0  # of the scene's plane: 1 mm of depth gives 1 N


def test_pressing_pushes_back(softfinger_daemon: Start) -> None:
    """1 mm of depth gives 1 N along the plane's normal."""
    daemon = softfinger_daemon(scene=SCENE, recording=POSES)
    strongest = 0.0
    for sample in daemon.subscribe():
        if sample.servo.guard == 0 and sample.contact.mode:
            expected = STIFFNESS_N_PER_M * sample.contact.penetration
            assert abs(sample["contact.normal_force"] - expected) < 1e-9 * STIFFNESS_N_PER_M
            strongest = max(strongest, sample["force"][2])
        if sample.probe.position[2] > 0.0149 and strongest:  # after press and release
            break
    assert strongest > 0.99


def test_a_softer_plane(softfinger_daemon: Start) -> None:
    """A parameter changes while the daemon runs."""
    daemon = softfinger_daemon(scene=SCENE, recording=POSES)
    changed = daemon.control.set_params({"object.ice.material.stiffness_n_per_m": 500.0}).changed
    assert changed["object.ice.material.stiffness_n_per_m"].before == STIFFNESS_N_PER_M


def test_my_rig_keeps_its_limit(softfinger_daemon: Start) -> None:
    """The hand presses, rolls and drags for four seconds: forces reach the limit, and never exceed it."""
    daemon = softfinger_daemon(scene="paper-plane", rig=RIG)
    strongest = 0.0
    for sample in daemon.subscribe():
        strongest = max(strongest, math.hypot(*sample["force"]))
        if sample.tick > 4000:
            break
    assert 0.399 < strongest < 0.4 + 1e-9


def test_nothing_has_changed(softfinger_daemon: Start, tmp_path: Path) -> None:
    """The installed version reproduces the forces of a recording. Store a recording to test later versions."""
    recording = tmp_path / "press.mcap"
    daemon = softfinger_daemon(scene=SCENE, recording=POSES, words=["--once", "--record", str(recording)])
    assert daemon.wait() == 0
    words = [sys.executable, "-m", "softfinger.server.cli", "replay", str(recording), "--json"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["compared"] > 1000
