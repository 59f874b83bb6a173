"""Replay device: samples in order, log of wrenches, zero at the end."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softfinger.config.errors import RecordingError
from softfinger.drivers.base import END, OK
from softfinger.drivers.poses import load_poses
from softfinger.drivers.replay.device import Options, Replay, open_device
from softfinger.drivers.resample import resample
from softfinger.drivers.wrench_log import FORCE_COLUMNS
from softfinger.server.driver_contract import DeviceCaller


def opened(**options: Any) -> Replay:
    return open_device(Options(**{"recording": "tap", **options}), 1000.0)


def test_reads_return_the_samples_in_order_and_then_the_end() -> None:
    wanted = resample(load_poses("tap"), 1000.0)
    with opened(loop=False) as device:
        servo = DeviceCaller(device)
        for n, pose in enumerate(wanted):
            assert servo.read() == (OK, [*pose, n * 0.001, 0.0, 0.0])
        assert device.info.own_clock and device.reads == len(wanted)
        for _ in range(3):
            assert servo.read() == (END, [*wanted[-1], (len(wanted) - 1) * 0.001, 0.0, 0.0])


def test_a_looped_recording_restarts() -> None:
    with opened() as device:
        servo, count = DeviceCaller(device), len(device.samples)
        first, second = ([servo.read() for _ in range(count)] for _ in range(2))
        assert [status for status, _ in second] == [OK] * count
        assert [x[:7] for _, x in second] == [x[:7] for _, x in first] and second[0][1][7] == count * 0.001


def test_every_wrench_is_logged_with_its_read() -> None:
    with opened(loop=False) as device:
        servo = DeviceCaller(device)
        servo.write(9.0, 0, 0, 0, 0, 0)
        for n in range(50):
            servo.read()
            assert servo.write(n, 1.0, 2.0, 3.0, 4.0, 5.0) == OK
        device.stop()
        read, wrench = device.read_log()
    assert read.tolist() == [-1, *range(50), 49]
    assert wrench[0].tolist() == [9.0, 0, 0, 0, 0, 0]
    assert wrench[1:-1].tolist() == [[n, 1.0, 2.0, 3.0, 4.0, 5.0] for n in range(50)]
    assert wrench[-1].tolist() == [0.0] * 6


def test_the_log_of_a_long_loop_contains_the_latest_wrenches() -> None:
    with opened() as device:
        servo = DeviceCaller(device)
        for n in range(15_000):
            servo.write(float(n), 0, 0, 0, 0, 0)
        device.stop()
        forces = device.forces()
        assert len(forces) >= 10_000 and device.overwritten_count == 15_001 - len(forces)
    assert forces[-1, 0] == 0.0 and forces[:-1, 0].tolist() == list(range(15_001 - len(forces), 15_000))


@pytest.mark.parametrize("ending", [".csv", ".npz"])
def test_forces_are_saved_on_close(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"forces{ending}"
    with opened(forces=str(path)) as device:
        servo = DeviceCaller(device)
        for n in range(20):
            servo.read()
            servo.write(n / 3.0, 0.1, 0.2, 0.3, 0.4, 0.5)
    read, wrench = device.read_log()
    if ending == ".csv":
        lines = path.read_text().splitlines()
        assert lines[0] == ",".join(FORCE_COLUMNS)
        table = np.array([[float(cell) for cell in line.split(",")] for line in lines[1:]])
    else:
        with np.load(path) as archive:
            table = np.column_stack((archive["read"], archive["force"], archive["torque"]))
    assert table.tobytes() == np.column_stack((read, wrench)).tobytes()
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_unusable_options_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"must end in \.csv or \.npz"):
        opened(forces="forces.txt")
    with pytest.raises(RecordingError, match=r"the folder .* does not exist"):
        opened(forces=str(tmp_path / "no" / "forces.csv"))
