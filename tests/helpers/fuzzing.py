"""Mutate valid bytes at random and pass them to every reader of files, messages and packets.

python -m helpers.fuzzing TARGET SECONDS SEED FOLDER

A reader must accept them or raise its own error with a message, within limits of CPU time and memory and without
warnings. FOLDER contains the current bytes, so an input that ends the process is known as well.

This is not atheris, which follows branches of Python code: these readers spend their time in msgspec, numpy, MuJoCo and
expat.
"""

import random
import re
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple

ROOT: Final = Path(__file__).resolve().parents[2]
HANGS_S: Final = 10.0
"""CPU time (s) for one input: longer than any input within the readers' limits takes."""
GROWTH_MAX: Final = 600 << 20
"""Bytes: the readers' largest array, 160 MB, may exist twice, in addition to the reader's own memory."""
SEED_MAX: Final = 1 << 16
"""Size (bytes) of a seed: a defect that shows in a long file shows in a short one."""
SAID_MAX: Final = 4000
"""Characters of a clear error message."""

_TOKENS: Final = (
    b"nan", b"inf", b"-inf", b"-1", b"0", b"1e308", b"1e-320", b"9" * 25, b"0x10", b"true", b"''", b'""', b"[]", b"{}",
    b"[[", b"\x00", b"\xff" * 8, b"\x7f\xff\xff\xff", b"\xc3\x28", "é".encode(), b"\r\n", b"=", b".", b",",
    b"../../etc/passwd", b"\xdd\xff\xff\xff\xff", b"\xc1", b"\x80", b"\x93", b"name", b"[" * 50,
)  # fmt: skip
TABLES: Final = [
    b"0,1,2,3,1,0,0,0\n10,1,2,3,1,0,0,0\n",
    b"0;1,5;2,5;3,5;1;0;0;0\n10;1,5;2,5;3,5;1;0;0;0\n",
    b'"0","1","2","3","1","0","0","0"\r\n"10","1","2","3","1","0","0","0"\r\n',
    b"0\t1\t2\t3\t1\t0\t0\t0\n10\t1\t2\t3\t1\t0\t0\t0\n",
]
"""Tables of other programs, with commas, semicolons and decimal commas, quotation marks, and tabs."""
_NUMBER: Final = re.compile(rb"-?\d+(\.\d+)?(e-?\d+)?")


def mutated(seeds: list[bytes], chance: random.Random) -> bytes:
    data = bytearray(chance.choice(seeds))
    for _ in range(chance.choice((1, 1, 1, 2, 3, 6))):
        _spoil(data, chance, seeds)
    return bytes(data)


def _spoil(data: bytearray, chance: random.Random, seeds: list[bytes]) -> None:
    at = chance.randrange(len(data) + 1)
    end = min(len(data), at + chance.choice((1, 1, 2, 4, 8, 64, 1000)))
    match chance.randrange(8):
        case 0 if at < len(data):
            data[at] ^= 1 << chance.randrange(8)
        case 1 if at < len(data):
            data[at] = chance.randrange(256)
        case 2:
            del data[at:end]
        case 3:
            data[at:at] = data[at:end] * chance.choice((1, 2, 20))
        case 4:
            data[at:at] = chance.choice(_TOKENS)
        case 5:
            del data[at:]
        case 6:
            donor = chance.choice(seeds)
            start = chance.randrange(len(donor) + 1)
            data[at:end] = donor[start : start + chance.choice((4, 64, 1000))]
        case 7 if numbers := list(_NUMBER.finditer(bytes(data))):
            where = chance.choice(numbers)
            data[where.start() : where.end()] = chance.choice(_TOKENS[:15])


class Target(NamedTuple):
    """Seeds, reader of a file, errors by which it may refuse (naming the file if `named`), suffix."""

    seeds: Callable[[], list[bytes]]
    take: Callable[[Path, bytes], object]
    refusals: tuple[type[Exception], ...]
    ending: str = ".bin"
    named: bool = True


def _shipped(*patterns: str) -> Callable[[], list[bytes]]:
    def read() -> list[bytes]:
        files = [path for pattern in patterns for path in sorted(ROOT.glob(pattern))]
        seeds = [path.read_bytes() for path in files]
        short = [seed for seed in seeds if len(seed) <= SEED_MAX]
        return short or [seed[:SEED_MAX] for seed in seeds]

    return read


def _written(write: Callable[[Path], object], ending: str) -> Callable[[], list[bytes]]:
    def made() -> list[bytes]:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, f"seed{ending}")
            write(path)
            return [path.read_bytes()]

    return made


def _records() -> Any:
    from helpers.telemetry_records import put, synthetic

    records = synthetic(20)
    put(records, "probe.orientation", (1.0, 0.0, 0.0, 0.0))
    put(records, "tick", range(20))
    put(records, "timestamp", [1.7e9 + tick / 1000.0 for tick in range(20)])
    return records


def _results(path: Path) -> None:
    from softfinger.server.recording.results import write_blocks

    write_blocks(path, [""], [_records()[:, None]])


def _run(path: Path) -> None:
    from helpers.recorded import about, event, recorded

    recorded(path, _records(), [event("user", "mark", 3, label="a")], **about())


def _journal(path: Path) -> None:
    from softfinger.server.experiment.journal import Journal

    answer = {"trial": 1, "practice": False, "condition": "all", "level": 0.5, "answer": "first", "right": True}
    with Journal(path) as journal:
        journal.write("started", run=1, dry_run=True, time=0.0)
        journal.write("begun", trial=1, attempt=1)
        journal.write("done", **answer)
        journal.write("survey", survey="a", block=0, condition=None, question="age", answer=30.0)
        journal.write("finished", trials=1)


def _load_poses(path: Path, _: bytes) -> None:
    import numpy as np

    from softfinger.drivers.poses import load_poses

    poses = load_poses(path)
    assert np.isfinite(np.column_stack((poses.t, poses.position, poses.orientation))).all()
    assert (np.diff(poses.t) > 0.0).all()


def _read_picture(path: Path, _: bytes) -> None:
    from softfinger.config.arrays.grids import read_grid

    assert read_grid(path).ndim == 2


@cache
def targets() -> dict[str, Target]:
    """Return the targets by name; their imports take a second."""
    from helpers import fuzzed_packets as packets
    from softfinger.config.arrays.grids import read_grid
    from softfinger.config.errors import ConfigError, RecordingError
    from softfinger.config.load import load_faults, load_rig, load_scene
    from softfinger.config.mjcf import compile_model
    from softfinger.proxy.meshes.reading import parse_mesh
    from softfinger.server.experiment import journal
    from softfinger.server.recording.compare import READ_FIELDS
    from softfinger.server.recording.reader import read_contents
    from softfinger.server.recording.results import read_results
    from softfinger.server.recording.run import load_run
    from softfinger.server.recording.summary import summarize
    from softfinger.server.recording.tables import make_table_format, read_table
    from softfinger.server.wire.envelope import DeclinedRequest, parse

    config, recording = (ConfigError,), (RecordingError,)
    layout = make_table_format("t,x,y,z,qw,qx,qy,qz", 1e-3, 1e-3, None, 0)

    def every(path: Path, _: bytes) -> None:
        refusal = None
        for read in (lambda: list(read_contents(path)), lambda: summarize(path), lambda: load_run(path, READ_FIELDS)):
            try:
                read()
            except RecordingError as error:
                refusal = error
        if refusal is not None:
            raise refusal

    return {
        "scene": Target(_shipped("config/scenes/*.toml"), lambda path, _: load_scene(path), config, ".toml"),
        "rig": Target(_shipped("config/rigs/*.toml"), lambda path, _: load_rig(path), config, ".toml"),
        "faults": Target(_shipped("config/faults/*.toml"), lambda path, _: load_faults(path), config, ".toml"),
        "poses-csv": Target(_shipped("config/recordings/*.csv"), _load_poses, recording, ".csv"),
        "poses-results": Target(_written(_results, ".csv"), _load_poses, recording, ".csv"),
        "poses-npz": Target(_written(_results, ".npz"), _load_poses, recording, ".npz"),
        "poses-mcap": Target(_written(_results, ".mcap"), _load_poses, recording, ".mcap"),
        "table": Target(lambda: TABLES, lambda path, _: read_table(path, layout), recording, ".txt"),
        "journal": Target(_written(_journal, ".jsonl"), lambda path, _: journal.read(path), config, ".jsonl"),
        "results-csv": Target(_written(_results, ".csv"), lambda path, _: read_results(path), recording, ".csv"),
        "results-mcap": Target(_written(_results, ".mcap"), lambda path, _: read_results(path), recording, ".mcap"),
        "recording": Target(_written(_run, ".mcap"), every, recording, ".mcap"),
        "mjcf": Target(lambda: packets.MODELS, lambda path, _: compile_model(str(path)), config, ".xml"),
        "mesh-stl": Target(lambda: packets.STL, parse_mesh, config, ".stl"),
        "mesh-obj": Target(lambda: packets.OBJ, parse_mesh, config, ".obj"),
        "mesh-ply": Target(lambda: packets.PLY, parse_mesh, config, ".ply"),
        "mesh-glb": Target(lambda: packets.GLB, parse_mesh, config, ".glb"),
        "grid-png": Target(packets.pictures, _read_picture, config, ".png"),
        "grid-npy": Target(packets.arrays, lambda path, _: read_grid(path), config, ".npy"),
        "command": Target(packets.commands, lambda _, data: parse(data), (DeclinedRequest,), named=False),
        **packets.targets(Target),
    }


def verdict(target: Target, path: Path, data: bytes) -> str:
    """Return the fault of a reader's response, or an empty text if it accepts or refuses correctly."""
    path.write_bytes(data)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.filterwarnings("ignore", "Inertia matrix")  # MuJoCo warns of a model that it accepts
            target.take(path, data)
    except target.refusals as error:
        message = str(error)
        if not message.strip() or len(message) > SAID_MAX:
            return f"an error of {len(message)} characters: {message[:200]!r}"
        if target.named and path.name not in message:
            return f"the error does not name the file: {message[:200]!r}"
    except Exception:
        return traceback.format_exc()
    return ""


def seeds_of(target: Target) -> list[bytes]:
    return [seed for seed in target.seeds() if b"[world]" not in seed]  # these would need their model as a file


def bound_memory() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + GROWTH_MAX
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def main(name: str, seconds: float, seed: int, folder: Path) -> int:
    chance, target = random.Random(seed), targets()[name]
    path, seeds = folder / f"input{target.ending}", seeds_of(target)
    if wrong := next(filter(None, (verdict(target, path, seed) for seed in seeds)), ""):
        print(f"of the seeds: {wrong}")
        return 1
    bound_memory()
    count, until = 0, time.monotonic() + seconds
    while time.monotonic() < until:
        data = mutated(seeds, chance)
        signal.setitimer(signal.ITIMER_PROF, HANGS_S)  # the signal ends the process
        if wrong := verdict(target, path, data):
            print(wrong)
            return 1
        count += 1
    print(count)
    return 0


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT / "tests"))
    raise SystemExit(main(sys.argv[1], float(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4])))
