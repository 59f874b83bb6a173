"""`make page-picture`: the screenshots of docs/figures/.

page.jpg, elastic-*.jpg            the page in the browser with shipped recordings
experiment-{page,report}.png       a participant's page, and the report of a study
"""

import io
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from helpers.browser import Screen, browser, eventually, served
from helpers.experiment_page import EXPERIMENT, session
from helpers.recorded import EPOCH_S, about
from PIL import Image

from softfinger.config.load import describe, load_scene
from softfinger.proxy.record import AT
from softfinger.server import cli
from softfinger.server.experiment.daemon import RunOptions
from softfinger.server.experiment.experiment import Experiment
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
REPORT_SIZE = {"width": 1000, "height": 1900}
PARTICIPANTS = range(1, 7)
PARTICIPANT_SIZE = {"width": 600, "height": 300}
GAP = 8
COLOURS = 32
"""Text and lines need no more, and the file is small."""


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


def screenshot(page: Any) -> Image.Image:
    return Image.open(io.BytesIO(page.screenshot())).convert("RGB")


def draw_experiment(folder: Path) -> Path:
    """Run an experiment until its first question, and take the instructions and the question side by side."""
    file = FIGURES / "experiment-page.png"
    with session(folder / "session", EXPERIMENT) as run:
        run.page.set_viewport_size(PARTICIPANT_SIZE)
        assert run.waits("guess if you are not sure")
        field = run.page.get_by_text("theme", exact=True)  # the script of the page hides it a moment after it is there
        assert eventually(lambda: field.count() and field.is_hidden())
        pictures = [screenshot(run.page)]
        run.click("begin")
        assert run.waits("Which was stiffer?")
        pictures.append(screenshot(run.page))
    width = sum(picture.width for picture in pictures) + GAP
    both = Image.new("RGB", (width, pictures[0].height), "grey")
    both.paste(pictures[0], (0, 0))
    both.paste(pictures[1], (pictures[0].width + GAP, 0))
    both.quantize(COLOURS).save(file, optimize=True)
    return file


def draw_report(folder: Path) -> Path:
    """Rehearse the shipped study with six participants, and take the upper part of its report."""
    file, out = FIGURES / "experiment-report.png", folder / "study"
    with browser() as page:
        for participant in PARTICIPANTS:
            running = RunOptions(dry_run=True, no_daemon=True)
            Experiment("stiffness-and-workload").run(out, participant, running)
        cli.main(["-q", "figure", str(out), "--report"])
        page.set_viewport_size(REPORT_SIZE)
        page.goto(f"file://{out}/figures/report.html")
        screenshot(page).quantize(COLOURS).save(file, optimize=True)
    return file


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        drawn = [draw_page(), *(draw_elastic(*item, folder) for item in ELASTIC.items())]
        drawn += [draw_experiment(folder), draw_report(folder)]
    for file in drawn:
        print(f"{file}: {file.stat().st_size // 1024} kB")


if __name__ == "__main__":
    main()
