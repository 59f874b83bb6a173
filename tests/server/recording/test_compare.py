"""Replay of a recording: equal without changes, first difference at its tick, ticks that cannot be compared."""

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest
from helpers.called import called, read_stdout
from helpers.recorded import EPOCH_S, about, event, printed, recorded, run

from softfinger.config.errors import Different, RecordingError
from softfinger.config.load import apply_overrides, describe, load_rig, load_scene
from softfinger.drivers.base import HELD
from softfinger.drivers.poses import load_poses
from softfinger.drivers.resample import resample
from softfinger.proxy.kernels.jit.pack import packed
from softfinger.proxy.record import AT, CAUSE_TOUCH, FREE
from softfinger.server.loop.guard import POSE_REFUSED
from softfinger.server.loop.tick import make_start_memory
from softfinger.server.loop.tuning import make_tuning
from softfinger.server.offline.simulate import load_finger_poses, run_ticks, simulate
from softfinger.server.options import TOLERANCE
from softfinger.server.recording.compare import ReplayComparison, compare, compare_run
from softfinger.server.recording.replay import READ_FIELDS, _select_recorded
from softfinger.server.recording.results import read_results
from softfinger.server.recording.run import load_run
from softfinger.server.recording.writer import RecordingFile

pytestmark = pytest.mark.plain

STIFFNESS = "object.0.material.stiffness_n_per_m"
SETTLE_TICKS = 499
"""The ramp of half a second at 1 kHz ends at its 500th tick; the filter settles much earlier."""


def replay_and_compare(path: Path, **changes: float) -> ReplayComparison:
    scene = load_scene("paper-plane")
    past = load_run(path, READ_FIELDS)
    scene = apply_overrides(scene, changes, "test") if changes else scene
    return compare(past, compare_run(past, scene, load_rig("replay")), _select_recorded(past), TOLERANCE)


def find_touches() -> list[int]:
    return np.flatnonzero(run()[:, AT.contact_cause] == CAUSE_TOUCH).tolist()


def test_a_replay_equals_its_recording(tmp_path: Path) -> None:
    outcome = replay_and_compare(recorded(tmp_path / "a.mcap", run()))
    assert outcome.ticks == outcome.compared == len(run())
    assert (outcome.different, outcome.first, outcome.left_out) == (0, None, [])


def test_the_first_difference_is_the_first_touch(tmp_path: Path) -> None:
    outcome = replay_and_compare(recorded(tmp_path / "a.mcap", run()), **{STIFFNESS: 1100.0})
    first = outcome.first
    assert first is not None and (first.tick, first.key) == (find_touches()[0], "force[2]")
    assert first.seconds == pytest.approx(find_touches()[0] * 1e-3, abs=1e-9)  # sum of a thousand periods
    # The normal force is stiffness times depth, so f' / f = k' / k up to rounding.
    assert first.now / first.recorded == pytest.approx(1.1, rel=1e-9)
    peak = np.abs(run()[:, AT.force + 2]).max()
    assert outcome.largest["force"] == pytest.approx(0.1 * peak, rel=1e-6)
    in_contact = np.count_nonzero(run()[:, AT.contact_mode] != FREE)
    # It includes slides at which forces differ, and no tick in free space.
    assert 0.9 * in_contact <= outcome.different <= in_contact + 3


def test_nan_differs_from_every_number(tmp_path: Path) -> None:
    past = load_run(recorded(tmp_path / "a.mcap", run()), READ_FIELDS)
    now, then = compare_run(past, load_scene("paper-plane"), load_rig("replay")), _select_recorded(past)
    row = find_touches()[0]
    force = then[""]["force"].copy()
    force[row, 1] = np.nan
    broken = {"": then[""] | {"force": force}}
    outcome = compare(past, now, broken, TOLERANCE)
    assert outcome.different == 1 and outcome.largest["force"] == np.inf
    assert outcome.first is not None and (outcome.first.tick, outcome.first.key) == (row, "force[1]")
    now.field("force", 0)[row, 1] = np.nan
    assert compare(past, now, broken, TOLERANCE).different == 0


def test_ticks_after_a_gap_are_skipped_until_the_state_is_known(tmp_path: Path) -> None:
    middle = find_touches()[1] + 20
    holed = np.delete(run(), [middle, middle + 1], axis=0)
    outcome = replay_and_compare(recorded(tmp_path / "a.mcap", holed))
    assert outcome.first is None
    (span,) = outcome.left_out
    assert span.first == middle + 2 and span.why == "2 ticks before it are missing"
    assert span.last - span.first + 1 >= SETTLE_TICKS and run()[span.last + 1, AT.contact_mode] == FREE
    assert outcome.compared == len(holed) - (span.last - span.first + 1) and outcome.compared > middle


def test_a_recording_from_the_middle_of_a_run(tmp_path: Path) -> None:
    part = run()[find_touches()[0] + 30 :]
    outcome = replay_and_compare(recorded(tmp_path / "a.mcap", part))
    (span,) = outcome.left_out
    assert span.first == part[0, AT.tick] and span.why == "the recording starts in the middle of a run"
    assert outcome.first is None and outcome.compared == part[-1, AT.tick] - span.last > 0


OTHER = "another scene or rig was set"


def test_ticks_after_a_change_of_the_rig_are_skipped(tmp_path: Path) -> None:
    tick, rig = find_touches()[1] - 100, load_rig("replay")
    weak = msgspec.structs.replace(rig.guard, force_max_n=0.3)
    poses, scene = resample(load_poses("tap"), 1000.0), load_scene("paper-plane")
    records = np.vstack([run()[:tick], simulate(make_tuning(scene, weak), poses, 1000.0)[tick:]])
    assert records[tick, AT.contact_mode] == FREE
    quiet = replay_and_compare(recorded(tmp_path / "quiet.mcap", records))
    assert quiet.first is not None and quiet.first.tick > tick
    replacement = event("lifecycle", "replaced", tick, device="replay", first=tick)
    outcome = replay_and_compare(recorded(tmp_path / "told.mcap", records, [replacement]))
    assert outcome.first is None and 0 < outcome.compared < tick
    assert (outcome.left_out[-1].last, outcome.left_out[-1].why) == (len(records) - 1, OTHER)


def test_commands_are_replayed(tmp_path: Path) -> None:
    tick = (find_touches()[1] + find_touches()[2]) // 2
    while run()[tick, AT.contact_mode] != FREE:
        tick += 1
    softer = apply_overrides(load_scene("paper-plane"), {STIFFNESS: 700.0}, "test")
    after = simulate(make_tuning(softer, load_rig("replay").guard), resample(load_poses("tap"), 1000.0), 1000.0)
    records = np.vstack([run()[:tick], after[tick:]])
    records[:, AT.timestamp] = after[:, AT.timestamp]
    changes = {"object.table.material.stiffness_n_per_m": {"from": 1000.0, "to": 700.0}}
    set_params = event("command", "set_params", tick, command_id="a", what=changes)
    quiet = replay_and_compare(recorded(tmp_path / "quiet.mcap", records))
    assert quiet.first is not None and quiet.first.tick > tick
    outcome = replay_and_compare(recorded(tmp_path / "told.mcap", records, [set_params]))
    assert outcome.first is None and outcome.compared > 0
    why = "the time of the following command is not recorded, or it was not yet executed"
    assert why in {span.why for span in outcome.left_out}
    set_scene = event("command", "set_scene", tick, command_id="a", what={"scene": "sphere", "tick": tick})
    outcome = replay_and_compare(recorded(tmp_path / "other.mcap", records, [set_scene]))
    assert outcome.first is None
    assert (outcome.left_out[-1].last, outcome.left_out[-1].why) == (len(records) - 1, OTHER)


def test_forces_withheld_by_the_driver_are_skipped(tmp_path: Path) -> None:
    records = run().copy()
    at = find_touches()[0] + 10
    records[at, AT.servo_device] = HELD
    records[at, AT.force : AT.force + 3] = 0.0
    outcome = replay_and_compare(recorded(tmp_path / "held.mcap", records))
    assert outcome.first is None and outcome.compared < len(records) and "withheld" in outcome.left_out[-1].why

    poses = resample(load_poses("tap"), 1000.0)
    poses[at] = np.nan
    tuning = make_tuning(load_scene("paper-plane"), load_rig("replay").guard)
    refused, dts = np.zeros_like(run()), np.full(len(poses), 1e-3)
    run_ticks(packed(tuning), packed(make_start_memory(tuning.scene)), poses[:, None], dts, 1e-3, 0, refused[:, None])
    assert int(refused[at, AT.servo_guard]) & POSE_REFUSED
    outcome = replay_and_compare(recorded(tmp_path / "refused.mcap", refused))
    assert (outcome.first, outcome.compared) == (None, len(refused))


def test_several_fingers(tmp_path: Path) -> None:
    scene, names = load_scene("pinch"), ["thumb", "index"]
    played = [resample(load_poses(f"pinch-{name}"), 1000.0)[:1500] for name in names]
    records = simulate(make_tuning(scene, load_rig("replay").guard), np.stack(played, axis=1), 1000.0)
    records[:, :, AT.timestamp] += EPOCH_S
    path = tmp_path / "pinch.mcap"
    with path.open("wb", buffering=0) as file:
        recording = RecordingFile(file, names, about(scene=describe(scene), fingers=[{"name": name} for name in names]))
        for place, name in enumerate(names):
            recording.ticks(records[:, place], name)
        recording.close()
    past = load_run(path, READ_FIELDS)
    replay_result = compare_run(past, scene, load_rig("replay"))
    outcome = compare(past, replay_result, _select_recorded(past), TOLERANCE)
    assert (outcome.compared, outcome.first) == (1500, None)
    deviating = _select_recorded(past)
    deviating["index"]["force"] = deviating["index"]["force"] + [0.0, 0.1, 0.0]
    first = compare(past, replay_result, deviating, TOLERANCE).first
    assert first is not None and (first.finger, first.key, first.tick) == ("index", "force[1]", 0)
    for place, name in enumerate(names):
        assert resample(load_poses(path, name), 1000.0).tobytes() == played[place].tobytes()
    assert load_finger_poses(names, {"": str(path)}, 1000.0).tobytes() == np.stack(played, axis=1).tobytes()


def test_the_verb(tmp_path: Path) -> None:
    path = recorded(tmp_path / "a.mcap", run())
    assert f"{len(run())} of {len(run())} ticks compared, 0 differ" in read_stdout("replay", str(path))
    path.write_bytes(path.read_bytes()[:-2000])
    assert printed(read_stdout("replay", str(path), "--json"))["equal"] is True

    touch = find_touches()[0]
    result = called("replay", str(recorded(tmp_path / "touch.mcap", run()[touch + 1 : touch + 50])), "--json")
    report = printed(result.stdout)
    assert result.returncode == RecordingError.exit_code and "no tick can be compared" in result.stderr
    assert (report["equal"], report["compared"]) == (False, 0)

    softer = describe(apply_overrides(load_scene("paper-plane"), {STIFFNESS: 700.0}, "test"))
    softer_path = recorded(tmp_path / "b.mcap", run(), scene=softer)
    picture = tmp_path / "b.svg"
    result = called("replay", str(softer_path), "--json", "--plot", str(picture))
    report = printed(result.stdout)
    assert result.returncode == Different.exit_code
    assert report["equal"] is False and report["first"]["tick"] == find_touches()[0]
    assert f"softfinger: tick {find_touches()[0]} (" in result.stderr and "force[2]" in result.stderr
    assert "difference [N]" in picture.read_text()

    results = str(tmp_path / "golden.npz")
    read_stdout("simulate", "--scene", "paper-plane", "--poses", "tap", "--out", results)
    read_stdout("replay", "tap", "--scene", "paper-plane", "--against", results)
    result = called("replay", "tap", "--scene", "plane-at-60mm", "--against", results)
    assert result.returncode == Different.exit_code
    assert called("replay", "tap", "--scene", "paper-plane").returncode == 2


@pytest.mark.parametrize("ending", [".csv", ".npz", ".parquet"])
def test_exports_have_every_bit(ending: str, tmp_path: Path) -> None:
    path, out = recorded(tmp_path / "a.mcap", run()), tmp_path / f"out{ending}"
    assert f"{len(run())} ticks" in read_stdout("export", str(path), "--out", str(out))
    if ending == ".parquet":
        from pyarrow import parquet

        table = parquet.read_table(out)
        assert str(table.schema.field("tick").type) == "int64"
        assert np.column_stack([column.to_numpy() for column in table.columns]).tobytes() == run().tobytes()
    else:
        assert read_results(out).tobytes() == run().tobytes()
    assert called("export", str(path), "--out", str(out), "--finger", "thumb").returncode == 3
    assert called("export", str(path), "--out", str(tmp_path / "out.txt")).returncode == 2


def test_info_summarizes_a_recording(tmp_path: Path) -> None:
    holed = np.delete(run(), slice(100, 110), axis=0)
    mark = event("mark", "mark", 9, command_id="a", label="trial 7", data={})
    path = recorded(tmp_path / "a.mcap", holed, [mark], versions={"softfinger": "0.0"})
    report = json.loads(read_stdout("info", str(path), "--json"))
    assert (report["ticks"], report["missing"], report["gaps"], report["whole"]) == (len(holed), 10, 1, True)
    force = np.linalg.norm(holed[:, AT.force : AT.force + 3], axis=1).max()
    assert report["fingers"][""]["force_max_n"] == force
    assert sum(report["fingers"][""]["modes"].values()) == len(holed)
    assert report["duration_s"] == pytest.approx((len(run()) - 1) * 1e-3, abs=1e-6)  # difference of clock readings
    assert report["scene"] == about()["scene"] and report["marks"] == [{"tick": 9, "label": "trial 7"}]
    output = read_stdout("info", str(path))
    assert "10 ticks are missing in 1 gaps" in output and "scene paper-plane" in output and "softfinger 0.0" in output
