"""Run every test named in the fault model, and store its observations for docs/reference/faults.md.

`make faults-seen`. Arguments are passed to pytest. The machine should be idle: a stall increases the ticks.

A test notes its observations with `record_property(SEEN, {...})`: hazard, driver, fault; ticks until the device
received zero, None if it keeps a force; event, state, recovery.
"""

import json
import os
import subprocess
import sys
from ast import literal_eval
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from softfinger.tools.pages.hazards import HAZARDS, RESULTS_FILE

ROOT: Final = Path(__file__).parents[1]
FILE: Final = ROOT / "build" / "faults-seen.xml"
SEEN: Final = "fault_seen"


def main() -> int:
    """Exit code of pytest; the file of the program is written where every test has passed or was skipped."""
    tests = sorted({test for hazard in HAZARDS for test in hazard.tests})
    code, cases = run(*tests, *sys.argv[1:])
    # Tests that script the calls of an exchange run only as plain Python.
    plain_code, plain = run(*tests, "-m", "plain", *sys.argv[1:], NUMBA_DISABLE_JIT="1")
    if code == plain_code == 0:
        cases |= {name: case for name, case in plain.items() if has_passed(case)}
        RESULTS_FILE.write_text(condensed(cases), "utf-8")
        print(f"written: {RESULTS_FILE.relative_to(ROOT)}; make reference puts it into docs/reference/faults.md")
    return code or plain_code


def run(*words: str, **environment: str) -> tuple[int, dict[str, Element]]:
    """Run pytest; return its exit code and the results of the tests."""
    command = [sys.executable, "-m", "pytest", "-q", f"--junitxml={FILE}", "-o", "junit_family=xunit1", *words]
    code = subprocess.run(command, cwd=ROOT, env={**os.environ, **environment}, check=False).returncode
    return code, {f"{case.get('file')}::{case.get('name')}": case for case in ElementTree.parse(FILE).iter("testcase")}


def has_passed(case: Element) -> bool:
    return not {element.tag for element in case} & {"failure", "error", "skipped"}


def condensed(tests: dict[str, Element]) -> str:
    """Return JSON with one line per entry: the observations by hazard, and the number of passed cases of each test."""
    rows: list[dict[str, Any]] = []
    for hazard in HAZARDS:
        for test in hazard.tests:
            cases = [case for name, case in tests.items() if name.partition("[")[0] == test]
            for case in cases:
                for noted in case.findall(f".//property[@name='{SEEN}']")[-1:]:
                    row = {"hazard": hazard.name, **literal_eval(noted.get("value", ""))}
                    rows += [row] if row["hazard"] == hazard.name else []
            if cases:
                passed = sum(map(has_passed, cases))
                rows.append({"hazard": hazard.name, "test": test, "passed": passed, "of": len(cases)})
    return "[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n"


if __name__ == "__main__":
    sys.exit(main())
