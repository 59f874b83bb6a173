"""Exchange of `bench device` and of device reports: wrenches written, rows recorded, and ends."""

import json
import math
import re
from pathlib import Path

import numba
import numpy as np
import pytest
from helpers.compiled_code import called_in, functions
from helpers.faulty_device import Fault, FaultyDevice, Options

from softfinger.config.errors import DeviceError, DeviceLost, DeviceTimeout, SafetyStop
from softfinger.config.load import load_rig
from softfinger.drivers.base import SAMPLE_SIZE, SAMPLE_TIME, STALE, WITHHELD
from softfinger.drivers.replay import device as replay
from softfinger.proxy.kernels.jit.decorators import OPTIONS
from softfinger.server.cli import main
from softfinger.server.loop.guard import Guard
from softfinger.tools import exchange as bench
from softfinger.tools.exchange import FORCE, READ_STATUS, ROW_SIZE, SAMPLE, START, WRITE_STATUS, Exchange, Push
from softfinger.tools.exchange_figures import summarize_burst, summarize_part

pytestmark = pytest.mark.real_time  # after a pause of the loop the guard starts at zero force

RIG = load_rig("replay", {"servo.realtime": "off"})
RATE_HZ = RIG.servo.rate_hz
ARMED = Guard(5.0, 0.3, 2000.0, 50.0, 0.01, 1.0)


def recording(**options: object) -> replay.Replay:
    return replay.open_device(replay.Options(recording="tap", **options), RATE_HZ)


def test_no_force_reaches_a_device_that_is_only_measured() -> None:
    with recording() as device, Exchange(device, RIG, bench.make_disarmed_guard(RIG)) as exchange:
        rows = exchange.record(0.3, Push((1.0, 1.0, 1.0), 10.0, 0.3))
    assert rows.shape == (300, ROW_SIZE)
    logged = device.read_log().wrench
    assert len(logged) > 300 and not logged.any()
    assert not rows[:, FORCE : FORCE + 3].any()


def test_rows_contain_every_sample_in_order() -> None:
    with recording() as device, Exchange(device, RIG, bench.make_disarmed_guard(RIG)) as exchange:
        rows = exchange.record(0.2)
        first = round(rows[0, SAMPLE + SAMPLE_TIME] * RATE_HZ)
        want = device.samples[(first + np.arange(200)) % len(device.samples)]
    np.testing.assert_array_equal(rows[:, SAMPLE : SAMPLE + 7], want)
    steps = np.diff(rows[:, SAMPLE + SAMPLE_TIME])
    np.testing.assert_allclose(steps, 1.0 / RATE_HZ, rtol=1e-9)  # differences of times below 10 s: rounding
    assert (rows[:, [bench.READ, bench.WRITE, bench.EMPTY_READ, bench.EMPTY_WRITE]] > 0.0).all()
    whole = rows[:, [bench.READ, bench.WRITE, bench.EMPTY_READ, bench.EMPTY_WRITE]].sum(axis=1)
    assert (np.diff(rows[:, START]) > whole[:-1]).all()


def test_a_push_is_a_faded_sine_along_its_axis() -> None:
    newton, seconds, hertz = 2.0, 0.5, 6.0
    with recording() as device, Exchange(device, RIG, ARMED) as exchange:
        rows = exchange.record(seconds, Push((0.0, newton, 0.0), hertz, seconds))
        after = exchange.record(0.05)
    t = np.arange(len(rows)) / RATE_HZ
    ramp = np.minimum((np.arange(len(rows)) + 1.0) / RATE_HZ / ARMED.ramp, 1.0)
    want = ramp * newton * np.sin(math.pi * t / seconds) ** 2 * np.sin(2.0 * math.pi * hertz * t)
    np.testing.assert_allclose(rows[:, FORCE + 1], want, atol=1e-12)  # rounding of sums of the ramp
    assert not rows[:, [FORCE, FORCE + 2]].any()
    assert np.abs(want).max() > 0.9 * newton
    assert not after[:, FORCE : FORCE + 3].any()
    logged = device.read_log().wrench
    assert np.abs(logged[:, 1]).max() == np.abs(rows[:, FORCE + 1]).max() and not logged[-1].any()


def test_a_push_stays_below_the_guard() -> None:
    with recording() as device, Exchange(device, RIG, ARMED) as exchange:
        rows = exchange.record(0.3, Push((50.0, 0.0, 0.0), 10.0, 0.3))
    assert np.abs(rows[:, FORCE]).max() == pytest.approx(ARMED.force_max, rel=1e-12)  # rounding of a norm


def test_an_exception_during_a_push_ends_with_zero() -> None:
    device = recording()

    def interrupted() -> None:
        with device, Exchange(device, RIG, ARMED) as exchange:
            exchange.record(0.1, Push((1.0, 0.0, 0.0), 1.0, 1.0))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    logged = device.read_log().wrench
    assert logged.any() and not logged[-1].any()


def test_a_burst_is_bounded() -> None:
    with recording() as device, Exchange(device, RIG, bench.make_disarmed_guard(RIG)) as exchange:
        rows = exchange.burst()
        more = exchange.record(0.01)
    assert 100 < len(rows) <= bench.BURST_ROWS and rows[-1, START] <= bench.BURST_NS / 1e9
    assert more[0, SAMPLE + SAMPLE_TIME] > rows[-1, SAMPLE + SAMPLE_TIME]
    assert summarize_burst(rows)["exchanges_hz"] > RATE_HZ


def test_the_end_of_a_recording_is_no_failure() -> None:
    with recording(loop=False) as device, Exchange(device, RIG, bench.make_disarmed_guard(RIG)) as exchange:
        rows = exchange.record(5.0)
        assert 0 < len(rows) <= len(device.samples)
        assert len(exchange.record(0.1)) == 0 and exchange.failure() is None


@pytest.mark.parametrize(
    ("fault", "error"), [("lost", DeviceLost), ("write_lost", DeviceLost), ("timeout", DeviceTimeout)]
)
def test_a_failing_device_raises_its_error(fault: Fault, error: type[DeviceError]) -> None:
    with FaultyDevice(Options(fault=fault, at=150)) as device:
        with Exchange(device, RIG, ARMED) as exchange:
            rows = exchange.record(1.0, Push((1.0, 0.0, 0.0), 3.0, 1.0))
            assert 0 < len(rows) <= 151
            failure = exchange.failure()
            assert len(exchange.record(0.1)) == 0
        assert type(failure) is error and "faulty" in str(failure)
        assert device.wrenches.any() and not device.wrenches[-1].any()


def test_a_hanging_device_is_stopped() -> None:
    with FaultyDevice(Options(fault="stall", at=100, stall_us=800_000)) as device:
        with pytest.raises(SafetyStop, match=r"no exchange for 0\.25 s"), Exchange(device, RIG, ARMED) as exchange:
            exchange.record(1.0, Push((1.0, 0.0, 0.0), 3.0, 1.0))
        assert not device.wrenches[-1].any()


def test_the_loop_calls_only_the_clock_the_sleep_and_the_device() -> None:
    bench.compile_exchange()
    (signature,) = bench.exchange_loop.signatures
    fresh = numba.njit(**OPTIONS)(bench.exchange_loop.py_func)
    fresh.compile(signature)
    bodies = functions(next(iter(fresh.inspect_llvm().values())))
    called = {name for body in bodies.values() for name in called_in(body)}
    outside = {name for name in called if name not in bodies and not name.startswith("llvm.")}
    assert outside <= {"clock_gettime", "clock_nanosleep", "sin"}
    assert {"clock_gettime", "clock_nanosleep"} <= outside
    # Read and write of both devices, and the last zero, which has two places in code from Python 3.13's bytecode.
    assert sum(len(re.findall(r"call [\w ]*%[\w.]+\(", body)) for body in bodies.values()) in (5, 6)


def rows_of(count: int) -> np.ndarray:
    rows = np.zeros((count, ROW_SIZE))
    rows[:, START] = np.arange(count) * 1e-3
    rows[:, bench.READ], rows[:, bench.WRITE] = 2e-6, 1e-6
    rows[:, bench.EMPTY_READ] = rows[:, bench.EMPTY_WRITE] = 1e-7
    rows[3::4, READ_STATUS] = STALE
    rows[0, WRITE_STATUS] = STALE
    fresh = np.arange(count) - (np.arange(count) % 4 == 3)
    rows[:, SAMPLE + SAMPLE_TIME] = fresh * 1e-3
    assert ROW_SIZE == SAMPLE + SAMPLE_SIZE
    return rows


def test_figures_of_known_rows() -> None:
    result = summarize_part(rows_of(2000), 1000.0)
    assert result["ticks"] == 2000 and result["seconds"] == pytest.approx(2.0, rel=1e-12)
    assert result["read"]["p50"] == result["read"]["max"] == 2e-6
    assert result["cycle"]["p99"] == pytest.approx(3e-6, rel=1e-12)
    assert result["read"]["over_empty"]["p50"] == pytest.approx(20.0, rel=1e-12)
    assert result["cycle"]["over_empty"]["p50"] == pytest.approx(15.0, rel=1e-12)
    assert result["stale_share"] == 0.25 and result["limited_share"] == 1 / 2000
    assert result["new_samples_hz"] == pytest.approx(750.0, rel=1e-12)
    assert result["sample_step_s"]["min"] == pytest.approx(1e-3, rel=1e-9)  # a difference of times near 2 s
    assert result["sample_step_s"]["max"] == pytest.approx(2e-3, rel=1e-9)


def test_bench_device_prints_json_and_draws(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plot = tmp_path / "plot.png"
    words = ("--rig", "simulated", "--seconds", "0.3", "--json", "--plot", str(plot))
    assert main(["bench", "device", *words]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["device"] == "simulated omega.6" and result["ticks"] == 300
    assert {"read", "write", "cycle", "late", "new_samples_hz", "stale_share", "sample_step_s"} <= result.keys()
    assert {"p50", "p99", "p999", "max", "blocks", "empty", "over_empty", "histogram"} == result["cycle"].keys()
    assert sum(count for _, count in result["read"]["histogram"]) == 300
    assert result["without_pauses"]["exchanges"] > 0
    assert plot.read_bytes().startswith(b"\x89PNG")


def test_the_device_is_armed_right_before_its_first_exchange() -> None:
    bench.compile_exchange()
    before = len(bench.exchange_loop.signatures)
    with FaultyDevice(Options()) as device, Exchange(device, RIG, ARMED) as exchange:
        exchange.record(0.1)
        thread = exchange._thread.native_id
    assert device.acts[0] == ("arm", thread, 0)
    assert [act for act, *_ in device.acts[1:]] == ["stop", "close", "stop"]
    assert len(bench.exchange_loop.signatures) == before


def test_a_device_that_refuses_to_be_armed_ends_with_its_error() -> None:
    with FaultyDevice(Options(refuses_to_arm=True)) as device:
        with pytest.raises(DeviceError, match="force button"), Exchange(device, RIG, ARMED) as exchange:
            exchange.record(0.1)
        assert [act for act, *_ in device.acts] == ["arm", "stop"]


def test_a_device_that_fails_to_stop_gets_zero_and_is_named() -> None:
    device = FaultyDevice(Options(stop_fails=True))
    with (
        pytest.raises(DeviceError, match=r"could not be stopped.*switch it off"),
        Exchange(device, RIG, ARMED) as exchange,
    ):
        exchange.record(0.1, Push((1.0, 0.0, 0.0), 1.0, 1.0))
    assert device.wrenches[:-2].any() and not device.wrenches[-1].any()


@pytest.mark.parametrize("fault", ["withheld_read", "withheld_write"])
def test_a_push_ramps_up_after_it_was_withheld(fault: Fault) -> None:
    slow = ARMED._replace(ramp=0.5)
    with FaultyDevice(Options(fault=fault, at=800, count=5)) as device, Exchange(device, RIG, slow) as exchange:
        rows = exchange.record(1.2, Push((1.0, 0.0, 0.0), 0.01, 1.2))
    status = rows[:, READ_STATUS if fault == "withheld_read" else WRITE_STATUS]
    (withheld,) = np.nonzero(status == WITHHELD)
    first, last = withheld[0], withheld[-1]
    size = np.abs(rows[:, FORCE])
    assert last - first == 4 and size[first - 1] > 10 * size[first + 20] > 0.0
    # upper bound: a withheld read starts the ramp one tick earlier; sums round
    share = 0.002 * np.arange(2, 102) * (1 + 1e-12)
    assert (size[last + 1 : last + 101] <= share * np.abs([pushed_at(n) for n in range(last + 1, last + 101)])).all()


def pushed_at(number: int) -> float:
    t = number / RATE_HZ
    return math.sin(math.pi * t / 1.2) ** 2 * math.sin(2.0 * math.pi * 0.01 * t)
