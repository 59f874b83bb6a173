"""`make page-picture`: docs/figures/page.jpg and elastic-*.jpg, the page in the browser with shipped recordings."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from helpers.browser import Screen, eventually, served
from helpers.recorded import EPOCH_S, about
from PIL import Image

from softfinger.config.load import describe, load_scene
from softfinger.proxy.record import AT
from softfinger.server.offline.simulate import run_recording
from softfinger.server.recording.writer import RecordingFile

FIGURES = Path(__file__).resolve().parents[1] / "docs" / "figures"
RECORDING, TICK = "press-roll-spin-drag", 8900
"""It is dragged along, still wound up from the spin."""
SIZE = {"width": 1100, "height": 760}
ELASTIC = {
    "press-a-pad": {"": "press-a-pad"},
    "bend-a-strip": {"": "bend-a-strip"},
    "squeeze-a-ball": {"thumb": "squeeze-thumb", "index": "squeeze-index"},
}
"""Recordings of the fingers of each scene with an elastic object."""
CROP = slice(150, 610), slice(0, 706)
"""Rows and columns of the picture with the object."""
QUALITY = 82


def settled(screen: Screen, tick: int) -> None:
    """Wait until the page has drawn a tick."""
    screen.page.set_viewport_size(SIZE)
    eventually(lambda: screen.shows(f"tick {tick}"))
    eventually(lambda: (screen.picture().std(axis=(0, 1)) > 5.0).all())


def draw_page() -> Path:
    file = FIGURES / "page.jpg"
    with served(RECORDING, "--tick", str(TICK)) as screen:
        settled(screen, TICK)
        eventually(lambda: screen.page.locator(".uplot").count() >= 3)
        screen.page.screenshot(path=file, type="jpeg", quality=QUALITY)
    return file


def draw_elastic(scene: str, recordings: dict[str, str], folder: Path) -> Path:
    file, path = FIGURES / f"elastic-{scene.rpartition('-')[2]}.jpg", folder / f"{scene}.mcap"
    several = len(recordings) > 1
    records_of = run_recording(recordings if several else recordings[""], scene)
    records = {name: np.asarray(records_of[name] if several else records_of) for name in recordings}
    moved = [np.linalg.norm(record[:, AT.contact_displacement :][:, :3], axis=1) for record in records.values()]
    tick = int(np.sum(moved, axis=0).argmax())
    header = about(scene=describe(load_scene(scene)), scene_name=scene)
    recording = RecordingFile(path.open("wb", buffering=0), tuple(records), header)
    for name, record in records.items():
        record[:, AT.timestamp] += EPOCH_S
        recording.ticks(record, name)
    recording.close()
    with served(str(path), "--tick", str(tick)) as screen:
        settled(screen, tick)
        picture = Image.fromarray(screen.picture().astype(np.uint8)[CROP])
    picture.save(file, quality=QUALITY)
    return file


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        drawn = [draw_page(), *(draw_elastic(*item, Path(folder)) for item in ELASTIC.items())]
    for file in drawn:
        print(f"{file}: {file.stat().st_size // 1024} kB")


if __name__ == "__main__":
    main()
