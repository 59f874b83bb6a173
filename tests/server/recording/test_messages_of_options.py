"""Messages of options of the verbs for recordings name the option, the value and the remedy."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.called import called
from helpers.telemetry_records import synthetic

from softfinger.server.recording.results import write_blocks

pytestmark = pytest.mark.plain

TABLE = "t x y z\n0 0 0 0\n1 0 0 0\n"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("export run.mcap --out run.csv --finger thumb", "no ticks of finger 'thumb': leave --finger out"),
        ("replay nowhere", "recording 'nowhere' is neither a file nor a shipped recording"),
        ("replay tip", "did you mean 'tap'?"),
        ("info rum.mcap", "recording 'rum.mcap': no such file (did you mean 'run.mcap'?)"),
        ("info nowhere/run.mcap", "recording 'nowhere/run.mcap': no such file; `softfinger recordings`"),
        ("replay tap --scene paper-plane --against a.npz --rate 1", "command line --rate: servo.rate_hz = 1.0"),
        ("import table --out a.csv --columns t,x,y,z --unit-m inf", "--unit-m inf: must be above 0 and finite"),
        ("import table --out a.csv --columns t,x,y,z --rate 9", "either a column t or --rate, not both"),
        ("simulate --poses tap --out results", "results: has no suffix: use one of .csv, .npz, .mcap"),
        ("simulate --poses tap --out results.txt", "results.txt: '.txt' is no format of results: use one of .csv"),
    ],
)  # fmt: skip
def test_a_message_is_clear(words: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("table").write_text(TABLE)
    write_blocks("run.mcap", [""], [synthetic(3)[:, None]])
    result = called(*words.split())
    assert result.returncode in (2, 3)
    assert message in result.stderr
