"""Sessions with a daemon, killed at random moments: no trial is lost or run twice, and the order is unchanged."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from itertools import groupby
from pathlib import Path

import pandas as pd
import pytest
from helpers.processes import COMMAND, list_children

from softfinger.server.experiment.experiment import Experiment, load_results
from softfinger.server.experiment.journal import read

pytestmark = [pytest.mark.real_time, pytest.mark.scaled]

WAIT_S = 300.0
EXPERIMENT = """
title = "killed"
scene = "paper-plane"
rig = "rig.toml"
[task]
kind = "rate"
parameter = "object.table.material.stiffness_n_per_m"
question = "How stiff?"
[procedure]
kind = "constant"
levels = [200.0, 500.0, 900.0]
repetitions = {repetitions}
[design]
seed = 3
[trial]
touch_s = 0.03
gap_s = 0.0
[motion]
fingertip = [[0.0, 0.0, 0.0, 0.009]]
"""
RIG = """
[device]
driver = "simulated"
preset = "omega.6"
position_m = [0.0, 0.0, 0.009]
[device.hand]
mass_kg = 0.1
damping_ns_per_m = 8.0
stiffness_n_per_m = 1000.0
[guard]
ramp_s = 0.01
[commands]
ramp_s = 0.0
[servo]
realtime = "off"
"""


def kill_while_running(words: list[str], journal: Path, rng: random.Random) -> None:
    size = lambda: journal.stat().st_size if journal.exists() else 0  # noqa: E731
    process = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    until = size() + (rng.randrange(1, 1500) if rng.random() < 0.8 else 0)
    over = time.monotonic() + WAIT_S
    while size() < until and process.poll() is None:
        time.sleep(1e-3)
        if time.monotonic() > over:
            process.kill()
            pytest.fail("the session does not go on")
    time.sleep(rng.random() * (0.1 if until else 2.0))
    if rng.random() < 0.3:
        for child in list_children(process.pid):
            with suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)
        time.sleep(rng.random() * 0.1)
    process.send_signal(signal.SIGKILL)
    process.wait()


@pytest.mark.exhaustive
def test_a_session_with_a_daemon_survives_kills(tmp_path: Path, cases: Callable[[int, int], int]) -> None:
    kills = cases(1, 50)  # each kill costs a start of the program, about 2 s of processor time
    (tmp_path / "rig.toml").write_text(RIG)
    file = tmp_path / "killed.toml"
    file.write_text(EXPERIMENT.format(repetitions=2 * kills))
    words = [*COMMAND, "-q", "experiment", str(file), "--dry-run", "--no-doctor"]
    words += ["--out", str(tmp_path / "out"), "--endpoint", f"ipc://{tmp_path}/t", "--commands", f"ipc://{tmp_path}/c"]
    own, rng = tmp_path / "out" / "sub-01", random.Random(11)
    for _ in range(kills):
        kill_while_running(words, own / "sub-01_journal.jsonl", rng)
    assert subprocess.run(words, check=False, stdout=subprocess.DEVNULL, timeout=WAIT_S).returncode == 0
    rows = load_results(tmp_path / "out")
    assert [(row["trial"], row["level"], row["answer"]) for row in rows] == [
        (row["trial"], row["level"], row["answer"]) for row in Experiment(file).rehearse()
    ]
    steps = [entry for entry in read(own / "sub-01_journal.jsonl") if entry["kind"] in ("begun", "done")]
    for number, (trial, group) in enumerate(groupby(steps, lambda entry: entry["trial"]), 1):
        entries = list(group)
        assert trial == number  # never an earlier trial
        assert [entry["kind"] for entry in entries] == ["begun"] * (len(entries) - 1) + ["done"]
        assert [entry["attempt"] for entry in entries[:-1]] == list(range(1, len(entries)))
        assert entries[-1]["attempt"] == len(entries) - 1
    for row in rows:
        suffix = f"_attempt-{row['attempt']}" if row["attempt"] > 1 else ""
        ticks = pd.read_csv(own / "trials" / f"sub-01_trial-{row['trial']:04d}{suffix}.csv")
        assert len(ticks) + row["lost_ticks"] == row["last_tick"] - row["first_tick"] + 1
