"""Run a complete experiment through the participant's page: daemon, page and a real browser."""

import math
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from PIL import Image

from helpers.browser import browser, eventually, shown

EXPERIMENT = """
title = "Which plate is stiffer?"
scene = "paper-plane"
instructions = "Press on the plate twice.\\nSay which of the two was stiffer; guess if you are not sure."
[task]
kind = "compare"
parameter = "object.table.material.stiffness_n_per_m"
reference = 500.0
question = "Which was stiffer?"
[procedure]
kind = "constant"
levels = [0.5, 1.0]
[[factor]]
name = "damping"
parameter = "object.table.material.damping_ns_per_m"
levels = [0.0, 2.0]
[design]
seed = 1
order = "given"
break_every = 2
[trial]
touch_s = 0.3
gap_s = 0.0
[motion]
fingertip = [[0.0, 0.0, 0.0, 0.015], [0.1, 0.0, 0.0, 0.008]]
"""

STUDY = EXPERIMENT.replace(
    "[task]",
    """consent = "Your answers are stored without <b>your name</b>."
debriefing = "The plates had other <i>damping</i>."
[confidence]
[screen]
masking_noise = "pink"
volume = 0.5
image = "plate.png"
by = { "0.0" = { colour = "#4477aa" }, "2.0" = { colour = "#ee6677" } }
[[survey]]
name = "about"
title = "About you"
at = ["before"]
[[survey.question]]
name = "remark"
kind = "text"
prompt = "Which hand?"
[[survey.question]]
name = "age"
kind = "number"
prompt = "How old?"
min = 18
max = 99
[[survey]]
name = "workload"
at = ["between"]
[[survey.question]]
name = "effort"
kind = "likert"
prompt = "How hard was it?"
min = 0
max = 100
step = 5
labels = ["very low", "very high"]
[task]""",
    1,
)


class Session:
    """A running session and its participant's page in the browser."""

    def __init__(self, page: Any, folder: Path, process: subprocess.Popen[str]) -> None:
        self.page, self.folder, self.process = page, folder, process

    def click(self, label: str) -> None:
        self.page.get_by_role("button", name=label, exact=True).click()

    def middle(self, label: str) -> float:
        """Return the horizontal centre of a button in pixels from the left of the window; nan while it is hidden."""
        box = self.page.get_by_role("button", name=label, exact=True).bounding_box()
        return math.nan if box is None else float(box["x"] + 0.5 * box["width"])

    def waits(self, *texts: str) -> bool:
        """Wait for all these texts; return whether they appeared."""
        return bool(eventually(lambda: all(self.page.get_by_text(text).count() for text in texts)))

    def write(self, label: str, text: str) -> None:
        self.page.locator(f"xpath=//label[normalize-space()={label!r}]/following::input[1]").fill(text)


@contextmanager
def session(folder: Path, experiment: str) -> Iterator[Session]:
    """Run an experiment with `--view`, and open its page."""
    folder.mkdir(exist_ok=True)
    file = folder / "plates.toml"
    file.write_text(experiment)
    Image.new("RGB", (40, 20), "green").save(folder / "plate.png")
    words = [sys.executable, "-m", "softfinger.server.cli", "experiment", str(file), "--no-doctor", "--view"]
    words += ["--out", str(folder / "out"), "--endpoint", f"ipc://{folder}/t", "--commands", f"ipc://{folder}/c"]
    process = subprocess.Popen(
        words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        matches = (re.search(r"http://\S+/", line) for line in process.stderr)
        address = next(match for match in matches if match)[0]
        with browser() as page:
            shown(page, address)
            yield Session(page, folder, process)
    finally:
        process.kill()
        process.communicate()
