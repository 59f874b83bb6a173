"""Command lines of tools that cannot be run: one error each, exit code 2, and no file."""

import pytest

from softfinger.server.cli import main


@pytest.mark.parametrize(
    ("words", "pieces"),
    [
        ("doctor --with-force 1", ["--with-force", "--device-report"]),
        ("doctor --device-report --rig simulated --with-force 13", ["--with-force 13", "guard.force_max_n = 12"]),
        ("doctor --device-report --rig simulated --with-force -1", ["--with-force -1", "above 0"]),
        ("doctor --device-report --with-force 1 --seconds 0.5", ["--seconds 0.5", "at least 1"]),
        ("doctor --device-report /no/such/folder/x.json", ["/no/such/folder", "no folder"]),
        ("doctor --device-report --rig simulated-falcon --with-force 10 --seconds 1", ["10", "8 N"]),
        ("devices --push", ["--push belongs to a probe"]),
        ("devices --probe /no/such/folder/x.json --rig simulated", ["--probe /no/such/folder", "no folder"]),
        ("accuracy --figures /dev/null/figures", ["--figures /dev/null/figures: Not a directory"]),
        ("accuracy --surface torus --method rotation_vector", ["rotation_vector exists only for shapes with a closed"]),
        ("stability --mass 0 --delay 17", ["2 faults"]),
        ("stability --mass 0", ["command line --mass: mass_kg = 0.0: must be a number from 0.001 to 100 kg"]),
        ("stability --cases 9 --plot a.png", ["--plot: random runs have no plot"]),
        ("forward", ["nothing to do: add --to, --commands-to or --lsl"]),
        ("stability --scheduler here", ["must be 'local' or the address of a dask scheduler"]),
    ],
)
def test_invalid_arguments_give_one_clear_error(words, pieces, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(words.split()) == 2
    output, errors = capsys.readouterr()
    assert output == ""
    assert errors.startswith("softfinger: ") and all(piece in errors for piece in pieces), errors
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "limits"),
    [
        ("bench loop --seconds 0", "at least 0.1"),
        ("bench loop --geoms 25", "from 1 to 24"),
        ("bench telemetry --subscribers 0", "at least 1"),
        ("bench telemetry --seconds nan", "at least 0.1"),
        ("bench device --seconds 1000", "from 0.1 to 60: a row of every tick is stored in memory"),
        ("bench soak --minutes 0", "from 0.1 to 10000"),
        ("bench mesh --levels 0", "from 1 to 9"),
        ("bench simulate --ticks 10", "at least 1000"),
        ("bench view --viewers 0", "at least 1"),
        ("accuracy --rate 0", "from 4 to 100000"),
        ("accuracy --drift-steps 10", "from 1000 to 1e+10"),
        ("calibrate --mass 1", "from 0.02 to 0.4: use another weight"),
        ("doctor --seconds 0", "from 0.1 to 60: a row of every tick is stored in memory"),
        ("report --boxes -1", "at least 0"),
        ("stability --cases 0", "at least 1"),
    ],
)
def test_numbers_out_of_range_are_refused(words: str, limits: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(words.split())
    *_, option, number = words.split()
    assert caught.value.code == 2
    assert f"argument {option}: {number}: must be {limits}\n" in capsys.readouterr().err
