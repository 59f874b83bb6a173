"""A session whose device is unplugged ends without losing an answer; compiles the loop of a serial device, 20 s."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import pytest
from emulators.hapkit import COMPILER, NO_COMPILER, Hapkit, compile_sketch
from test_trial_order import make_tables

from softfinger.config.errors import DeviceLost
from softfinger.config.schema import Rig
from softfinger.config.sources import FOLDERS
from softfinger.server.experiment.daemon import RunOptions
from softfinger.server.experiment.experiment import Experiment
from softfinger.server.experiment.journal import read

pytestmark = [pytest.mark.real_time, pytest.mark.exhaustive, pytest.mark.skipif(COMPILER is None, reason=NO_COMPILER)]
WAIT_S = 300.0


def pull_in_trial(board: Hapkit, journal: Path, trial: int) -> None:
    until = time.monotonic() + WAIT_S
    while time.monotonic() < until:
        if any(entry["kind"] == "begun" and entry["trial"] == trial for entry in read(journal)):
            board.pull()
            return
        time.sleep(0.01)


def test_a_device_unplugged_in_a_trial(tmp_path: Path) -> None:
    library, out = compile_sketch(tmp_path / "hapkit.so"), tmp_path / "out"
    rig = tmp_path / "hapkit.toml"
    rig.write_text((FOLDERS[Rig] / "hapkit.toml").read_text().replace("# path =", "path ="))
    procedure = {"kind": "constant", "levels": [0.1, 0.2], "repetitions": 2}
    made = Experiment(make_tables(factor=[], procedure=procedure, trial={"touch_s": 0.2}) | {"rig": str(rig)})
    ends = {"telemetry.endpoint": f"ipc://{tmp_path}/t", "commands.endpoint": f"ipc://{tmp_path}/c"}
    journal = out / "sub-01" / "sub-01_journal.jsonl"

    def options(board: Hapkit) -> RunOptions:
        return RunOptions(dry_run=True, doctor=False, rig=ends | {"servo.realtime": "off", "device.path": board.path})

    with Hapkit(library) as board:
        puller = threading.Thread(target=pull_in_trial, args=(board, journal, 2))
        puller.start()
        with pytest.raises(DeviceLost):
            made.run(out, 1, options(board))
        puller.join()
    assert [entry["trial"] for entry in read(journal) if entry["kind"] == "done"] == [1]
    with Hapkit(library) as board:
        rows = made.run(out, 1, options(board))
    assert [(row["trial"], row["attempt"]) for row in rows] == [(1, 1), (2, 2), (3, 1), (4, 1)]
