"""Contents of the archive written by `softfinger report`."""

import getpass
import json
import logging
import platform
import re
import sys
import tarfile
import time
from pathlib import Path

import pytest
from helpers.forgotten import forget_user
from helpers.recorded import about, run

from softfinger.config.load import load_rig
from softfinger.config.schema import Scene
from softfinger.config.sources import find
from softfinger.proxy.kernels.jit.decorators import CACHE_DIR
from softfinger.proxy.record import AT
from softfinger.server.cli import main
from softfinger.server.recording.blackbox import BlackBox
from softfinger.server.recording.reader import Event, Note, TickBlock, read_contents

PREFIX = "softfinger-report/"


def test_the_archive_has_every_part_and_no_private_data(tmp_path, monkeypatch, caplog):
    private = [str(Path.home()), platform.node(), "SN1234567", "Project-X", "study", sys.prefix, str(CACHE_DIR)]
    words = f"{Path.home()}/study/hand.toml on {platform.node()}: serial number SN1234567, user {getpass.getuser()}"
    words += f"; Project-X/my-scene.toml, {sys.prefix}/bin/python"
    place = tmp_path / "boxes"
    place.mkdir(0o700)
    monkeypatch.setenv("SOFTFINGER_BLACKBOX_DIR", str(place))
    box, ticks = BlackBox([""], [], 1000.0), run()[:500].copy()
    ticks[:, AT.timestamp] += time.time() - ticks[-1, AT.timestamp]
    box.take(ticks)
    event = {"schema": 1, "timestamp": time.time(), "tick": 7, "kind": "fault", "name": "device_lost"}
    box.event(event | {"message": words, "blackbox": f"{Path.home()}/x.mcap"})
    box.event(event | {"kind": "device", "name": "found", "serial": "SN1234567", "node": "/dev/hidraw0"})
    box.log.handle(logging.LogRecord("softfinger", logging.WARNING, "f", 1, words, None, None))
    box.write(place / "new.mcap", about(note=words))
    (place / "broken.mcap").write_bytes(b"\x89MCAP0\r\nnothing")
    out = tmp_path / "report.tar.gz"
    rig, scene = load_rig("replay"), tmp_path / "Project-X" / "my-scene.toml"
    scene.parent.mkdir()
    scene.write_bytes(find("paper-plane", Scene).read_bytes())
    assert main(["report", "--out", str(out), "--seconds", "0.3", "--scene", str(scene)]) == 0
    assert "broken.mcap" in caplog.text
    with tarfile.open(out) as archive:
        for member in archive:
            assert member.uname == "" and member.uid == 0 and member.mtime == 0
        archive.extractall(tmp_path / "out", filter="data")
    folder = tmp_path / "out" / PREFIX
    assert {path.name for path in folder.rglob("*.*")} == {
        "report.json", "rig.json", "scene.json", "log.txt", "new.mcap",
    }  # fmt: skip
    content = json.loads((folder / "report.json").read_text())
    assert content["softfinger"] and content["doctor"]["checks"]
    assert json.loads((folder / "rig.json").read_text())["guard"]["force_max_n"] == rig.guard.force_max_n
    assert "hand.toml" in (folder / "log.txt").read_text()
    parts = list(read_contents(folder / "blackbox" / "new.mcap"))
    copied = [part.records() for part in parts if isinstance(part, TickBlock)]
    assert sum(map(len, copied)) == 500 and copied[0][0].tolist() == ticks[0].tolist()
    told_texts = json.dumps([part.event for part in parts if isinstance(part, Event)])
    told_texts += json.dumps([part.value for part in parts if isinstance(part, Note)])
    told_texts += "".join(path.read_text() for path in folder.rglob("*.*") if path.suffix != ".mcap")
    for word in filter(None, private):
        assert not re.search(rf"(?<![A-Za-z0-9]){re.escape(word)}(?![A-Za-z0-9])", told_texts), word


def test_a_user_without_a_home_reports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    forget_user(monkeypatch)
    out = tmp_path / "report.tar.gz"
    assert main(["report", "--out", str(out), "--seconds", "0.3"]) == 0
    with tarfile.open(out) as archive:
        assert not [name for name in archive.getnames() if "blackbox" in name]
