"""Command lines of tools that cannot be run: one error each, exit code 2, and no file."""

import pytest

from softfinger.server.cli import main


@pytest.mark.parametrize(
    ("words", "pieces"),
    [
        ("doctor --seconds 0", ["--seconds 0", "0.1 to 60"]),
        ("doctor --with-force 1", ["--with-force", "--device-report"]),
        ("doctor --device-report --rig simulated --with-force 13", ["--with-force 13", "guard.force_max_n = 12"]),
        ("doctor --device-report --rig simulated --with-force -1", ["--with-force -1", "above 0"]),
        ("doctor --device-report --with-force 1 --seconds 0.5", ["--seconds 0.5", "at least 1"]),
        ("doctor --device-report /no/such/folder/x.json", ["/no/such/folder", "no folder"]),
        ("doctor --device-report --rig simulated-falcon --with-force 10 --seconds 1", ["10", "8 N"]),
        ("bench device --seconds 1000", ["--seconds 1000", "0.1 to 60"]),
        ("bench soak --minutes 0", ["--minutes 0"]),
        ("devices --push", ["--push belongs to a probe"]),
        ("devices --probe /no/such/folder/x.json --rig simulated", ["--probe /no/such/folder", "no folder"]),
        ("accuracy --rate 0", ["--rate 0: must be from 4 to 100000 Hz"]),
        ("accuracy --drift-steps 10", ["--drift-steps 10: must be from 1000"]),
        ("accuracy --figures /dev/null/figures", ["--figures /dev/null/figures: Not a directory"]),
        ("accuracy --surface torus --method rotation_vector", ["rotation_vector exists only for shapes with a closed"]),
        ("stability --mass 0 --delay 17", ["2 faults"]),
        ("stability --mass 0", ["command line --mass: mass_kg = 0.0: must be a number from 0.001 to 100 kg"]),
        ("stability --cases 0", ["--cases: 0: must be an integer of at least 1"]),
        ("stability --cases 9 --plot a.png", ["--plot: random runs have no plot"]),
        ("stability --scheduler here", ["must be 'local' or the address of a dask scheduler"]),
        ("bench mesh --levels 0", ["--levels"]),
        ("bench simulate --ticks 10", ["1000 or more"]),
    ],
)
def test_invalid_arguments_give_one_clear_error(words, pieces, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(words.split()) == 2
    output, errors = capsys.readouterr()
    assert output == ""
    assert errors.startswith("softfinger: ") and all(piece in errors for piece in pieces), errors
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("words", ["loop --seconds 0", "telemetry --subscribers 0", "telemetry --seconds nan"])
def test_numbers_below_the_minimum_are_refused(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["bench", *words.split()])
    option, number = words.split()[1:]
    assert caught.value.code == 2
    assert (
        f"argument {option}: {number}: must be at least {0.1 if option == '--seconds' else 1}"
        in capsys.readouterr().err
    )
