"""`make page-picture`: docs/figures/experiment-{page,report}.png, a participant's page and the report of a study."""

from __future__ import annotations

import io
import tempfile
from pathlib import Path

from helpers.browser import browser, eventually
from helpers.experiment_page import EXPERIMENT, Session, session
from PIL import Image

from softfinger.server import cli
from softfinger.server.experiment.daemon import RunOptions
from softfinger.server.experiment.experiment import Experiment

FIGURES = Path(__file__).resolve().parents[1] / "docs" / "figures"
PICTURE, REPORT = FIGURES / "experiment-page.png", FIGURES / "experiment-report.png"
REPORT_SIZE = {"width": 1000, "height": 1900}
PARTICIPANTS = range(1, 7)
SIZE = {"width": 600, "height": 300}
GAP = 8
COLOURS = 32
"""Text and lines need no more, and the file is small."""


def screenshot(run: Session) -> Image.Image:
    return Image.open(io.BytesIO(run.page.screenshot())).convert("RGB")


def draw_report() -> None:
    """Rehearse the shipped study with six participants, and take the upper part of its report."""
    with tempfile.TemporaryDirectory() as folder, browser() as page:
        for participant in PARTICIPANTS:
            running = RunOptions(dry_run=True, no_daemon=True)
            Experiment("stiffness-and-workload").run(Path(folder) / "out", participant, running)
        cli.main(["-q", "figure", f"{folder}/out", "--report"])
        page.set_viewport_size(REPORT_SIZE)
        page.goto(f"file://{folder}/out/figures/report.html")
        picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
        picture.quantize(COLOURS).save(REPORT, optimize=True)
    print(f"{REPORT}: {REPORT.stat().st_size // 1024} kB")


def main() -> None:
    """Run an experiment until its first question, and take the instructions and the question side by side."""
    with tempfile.TemporaryDirectory() as folder, session(Path(folder), EXPERIMENT) as run:
        run.page.set_viewport_size(SIZE)
        assert run.waits("guess if you are not sure")
        field = run.page.get_by_text("theme", exact=True)  # the script of the page hides it a moment after it is there
        assert eventually(lambda: field.count() and field.is_hidden())
        pictures = [screenshot(run)]
        run.click("begin")
        assert run.waits("Which was stiffer?")
        pictures.append(screenshot(run))
    width = sum(picture.width for picture in pictures) + GAP
    both = Image.new("RGB", (width, pictures[0].height), "grey")
    both.paste(pictures[0], (0, 0))
    both.paste(pictures[1], (pictures[0].width + GAP, 0))
    both.quantize(COLOURS).save(PICTURE, optimize=True)
    print(f"{PICTURE}: {PICTURE.stat().st_size // 1024} kB")
    draw_report()


if __name__ == "__main__":
    main()
