"""Command line: exit codes, output streams, errors. `run` starts a program, `called` runs a verb in this process."""

import argparse
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import zmq
from helpers.called import called, read_stdout
from helpers.processes import COMMAND
from helpers.programs import run_program
from helpers.recorded import printed
from helpers.telemetry_records import synthetic

from softfinger.config.schema import Scene
from softfinger.config.sources import FOLDERS
from softfinger.server.cli import VERBS, make_parser
from softfinger.server.recording.results import read_results, write_blocks
from softfinger.server.recording.summary import summarize
from softfinger.server.wire.commands import RecordStartResult
from softfinger.server.wire.envelope import encode_answer
from softfinger.server.wire.events import make_event
from softfinger.server.wire.protocol import encode
from softfinger.tools.bench.options import KINDS

SIMULATE = ["simulate", "--scene", "paper-plane", "--poses", "tap"]


def run(*words, timeout=300):
    return run_program([*COMMAND, *words], timeout=timeout)


def test_version():
    assert run("--version").stdout == f"softfinger {version('softfinger')}\n"


BEGIN = """
import gc, os, sys
from softfinger.server import cli
early = "numpy" in sys.modules
sys.argv = ["softfinger", "scenes"]
cli.main()
print(early, os.environ["OPENBLAS_NUM_THREADS"], gc.isenabled(), gc.get_freeze_count() > 0)
"""


def test_garbage_collection_is_on_when_a_verb_runs():
    environment = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    outcome = run_program([sys.executable, "-c", BEGIN], env=environment)
    assert outcome.stdout.splitlines()[-1:] == ["False 1 True True"], outcome.stderr


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("simulat --poses tap", "(did you mean 'simulate'?)\n"),
        ("bench stp", "(did you mean 'step'?)\n"),
        ("run --secne sphere", "unrecognized arguments: --secne (did you mean '--scene'?) sphere"),
        ("run --rte=500", "unrecognized arguments: --rte=500 (did you mean '--rate'?)"),
        ("bench step --blcoks 2", "unrecognized arguments: --blcoks (did you mean '--blocks'?) 2"),
        ("check paper-plane --qxz", "unrecognized arguments: --qxz\n"),
    ],
)
def test_a_similar_name_is_suggested(line, message):
    outcome = called(*line.split())
    assert outcome.returncode == 2 and message in outcome.stderr and outcome.stdout == ""


def iter_parsers(parser, *words):
    yield words, parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, inner in action.choices.items():
                yield from iter_parsers(inner, *words, name)


def test_no_argument_may_be_empty(capsys):
    """Also the value `--`, which argparse deletes."""
    parser, cases = make_parser().complete(), []
    for words, inner in iter_parsers(parser):
        for action in inner._actions:
            if action.option_strings and action.nargs != 0:
                cases += [(*words, f"{action.option_strings[-1]}={value}") for value in ("", "--")]
            elif not action.option_strings and action.nargs != argparse.PARSER:
                cases.append((*words, ""))
    assert len(cases) > 300
    for case in cases:
        with pytest.raises(SystemExit):
            parser.parse_args(case)
        assert "give a value, or leave out the argument" in capsys.readouterr().err, case
    assert parser.parse_args(["ctl", "mark", "label=", "--", "-1"]).params == ["label=", "-1"]


@pytest.mark.parametrize("line", ["{} scenes", "scenes {}", "bench step {}", "bench {} step"])
@pytest.mark.parametrize("flag", ["-v", "--verbose", "-q", "--quiet"])
def test_verbosity_flags_work_before_and_after_a_verb(line, flag):
    args = make_parser().parse_args(line.format(flag).split())
    verbose = flag in ("-v", "--verbose")
    assert (args.verbose, args.quiet) == (verbose, not verbose)


def test_quiet_leaves_warnings_and_results(tmp_path):
    words = ["run", "--endpoint", f"ipc://{tmp_path}/t", "--commands", "off", "--realtime", "off", "--duration", "0.1"]
    outcome = run(*words, "-q")
    assert outcome.returncode == 0 and outcome.stderr == ""
    outcome = called("check", "nothing", "-q")
    assert outcome.returncode == 2 and "nothing" in outcome.stdout + outcome.stderr


def test_completion_lists_shipped_names(tmp_path):
    (tmp_path / "spherical.toml").touch()
    script = called("--print-completion", "bash").stdout
    completions = {
        "run --scene sph": ["sphere", "spherical.toml"],
        "materials sili": ["silicone", "silicone-tip"],
        "experiment weight": ["weight-of-a-box"],
        "info press-a-b": ["press-a-button"],
    }
    for words, wanted in completions.items():
        at = len(words.split())
        script_end = f"COMP_WORDS=(softfinger {words}); COMP_CWORD={at}; _shtab_softfinger; echo ${{COMPREPLY[@]}}"
        outcome = run_program(["bash", "-c", f"{script}\n{script_end}"], cwd=tmp_path, check=True)
        assert outcome.stdout.split() == wanted


HELP = """
import contextlib, io, sys
from softfinger.server.cli import VERBS, run_verb
from softfinger.tools.bench.options import KINDS
for words in [["--help"], *([verb, "--help"] for verb in VERBS), *(["bench", kind, "--help"] for kind in KINDS)]:
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
        run_verb(words)
    print(*words, {"numpy", "numba", "scipy", "rich", "zmq"} & set(sys.modules))
"""


def test_help_imports_no_compiler():
    outcome = run_program([sys.executable, "-c", HELP], check=True)
    words = ["", *(f"{verb} " for verb in VERBS), *(f"bench {kind} " for kind in KINDS)]
    assert outcome.stdout.splitlines() == [f"{prefix}--help set()" for prefix in words]


def test_run_for_a_duration_logs_plain_lines():
    result = run("run", "--duration", "0.2", "--endpoint", "tcp://127.0.0.1:*", "--realtime", "auto")
    assert result.returncode == 0 and result.stdout == ""
    for piece in (
        "paper-plane", "replay", "tcp://127.0.0.1:", "monitor --endpoint", "real time:", "stopped after 200 ticks",
    ):  # fmt: skip
        assert piece in result.stderr
    assert "\r" not in result.stderr and "\x1b" not in result.stderr


POSES = "t,x,y,z,qw,qx,qy,qz\n0,0,0,0.02,1,0,0,0\n0.1,0,0,0.009,1,0,0,0\n"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return the current folder, with poses and a link to them."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.csv").write_text(POSES)
    (tmp_path / "link.csv").symlink_to("a.csv")
    return tmp_path


REFUSED = [
    ("fly", 2, "fly", "simulate"),
    ("run --rate 7", 2, "command line --rate", "7", "100"),
    ("run --scene moon", 2, "moon", "paper-plane"),
    ("run --endpoint tcp://127.0.0.1:* --recording nothing", 3, "nothing", "tap"),
    ("run --endpoint tcp://127.0.0.1:* --device omega", 4, "omega", "replay"),
    ("run --endpoint tcp://127.0.0.1:* --rig omega-3 --once", 2, "--once", "forcedimension", "--device replay"),
    ("run --endpoint tcp://0.0.0.0:5555", 2, "0.0.0.0", "127.0.0.1"),
    ("run --duration -1", 2, "duration"),
    ("run --endpoint tcp://127.0.0.1:* --record no/a.mcap", 2, "--record no/a.mcap", "does not exist"),
    ("simulate --scene paper-plane --poses tap --out x.csv --method zxy", 2, "zxy", "euler_zxz"),
    ("simulate --poses tap --out results", 3, "results: has no suffix: use one of .csv, .npz, .mcap"),
    ("simulate --poses tap --out results.txt", 3, "results.txt: '.txt' is no format of results: use one of .csv"),
    ("simulate --scene paper-plane --out o.csv --device replay --rig replay", 2, "'replay' cannot run offline"),
    ("simulate --scene paper-plane --out o.csv --poses tap --duration 1", 2, "--duration needs --device"),
    ("simulate --scene pinch --out o.csv --poses tap", 2,
     "do not match the fingers of the scene: use poses of thumb, index"),
    ("simulate --scene pinch --out o.csv --poses thumb=tap", 2, "poses of thumb do not match the fingers"),
    ("simulate --scene pinch --out o.csv --poses thumb=tap --poses thumb=tap", 2,
     "--poses thumb=tap: use it once, or --poses NAME=FILE for each"),
    ("simulate --scene pinch --out o.csv --poses tap --poses index=tap", 2, "--poses index=tap: use it once, or"),
    ("bench loop --seconds 600 --plot out.txt", 2, "--plot: out.txt: a figure is .png or .svg by its file name"),
    ("bench loop --seconds 600 --plot no/out.png", 2, "--plot: no/out.png: the folder no does not exist"),
    ("bench step --features tosion*", 2, "--features 'tosion*': no feature has such a name", "torsion linear"),
    ("check simulated paper-plane --plot wall.png", 2, "there are 0 and 1: select one of each"),
    ("export run.mcap --out run.csv --finger thumb", 3, "no ticks of finger 'thumb': leave --finger out"),
    ("replay nowhere", 3, "recording 'nowhere' is neither a file nor a shipped recording"),
    ("replay tip", 3, "did you mean 'tap'?"),
    ("replay tap --scene paper-plane --against a.npz --rate 1", 2, "command line --rate: servo.rate_hz = 1.0"),
    ("info rum.mcap", 3, "recording 'rum.mcap': no such file (did you mean 'run.mcap'?)"),
    ("info nowhere/run.mcap", 3, "recording 'nowhere/run.mcap': no such file; `softfinger recordings`"),
    ("import table --out a.csv --columns t,x,y,z --unit-m inf", 2, "--unit-m inf: must be above 0 and finite"),
    ("import table --out a.csv --columns t,x,y,z --rate 9", 2, "either a column t or --rate, not both"),
    ("bridge foxglove trial.mcap", 2, "Foxglove opens a recording (.mcap) itself"),
    ("bridge rerun --duration 0", 2, "the duration must be above 0 s"),
    ("materials ruber", 2, "no material or fingertip is called 'ruber' (did you mean 'rubber'?); they are steel"),
    ("materials --plot all.png", 2, "softfinger materials NAME --plot FILE"),
    ("experiment friction-magnitude --no-daemon --out out", 2, "add --dry-run"),
    ("experiment friction-magnitud --out out", 2, "did you mean 'friction-magnitude'"),
    ("experiment friction-magnitude --participant 0 --out out", 2, "participant = 0"),
    ("experiment friction-magnitude --set procedure.repetitions=0 --out out", 2, "must be an integer from 1"),
    ("figure .", 2, "check that `softfinger experiment` wrote this folder"),
    *((f"{verb} --duration {value}", 2, f"argument --duration: {value}: the duration must be above 0 s")
      for verb in ("monitor", "record") for value in ("0", "nan")),
    *((f"{verb} --timeout -1", 2, "argument --timeout: -1: the duration must be above 0 s")
      for verb in ("monitor", "record")),
    *((f"{words} {path}", 2, "choose another output file") for path in ("a.csv", "./a.csv", "link.csv") for words in (
        "simulate --scene paper-plane --poses a.csv --out", "import a.csv --columns t,x,y,z --out",
        "export a.csv --out", "run --endpoint tcp://127.0.0.1:* --recording a.csv --once --forces",
    )),
]  # fmt: skip
"""Words, exit code, and parts of the message."""


@pytest.mark.parametrize("row", REFUSED, ids=[line for line, *_ in REFUSED])
def test_bad_words_give_one_clear_error_and_write_nothing(row, folder):
    line, code, *pieces = row
    (folder / "table").write_text("t x y z\n0 0 0 0\n1 0 0 0\n")
    write_blocks("run.mcap", [""], [synthetic(3)[:, None]])
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    outcome = called(*line.split())
    assert outcome.returncode == code, outcome.stderr
    assert [piece for piece in ("softfinger", *pieces) if piece not in outcome.stderr] == [], outcome.stderr
    assert "Traceback" not in outcome.stderr and {path.name: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.parametrize("line", ["simulate --poses tap --out a.csv", "run --commands off --record a.mcap"])
def test_a_removed_current_folder_is_named(line, folder):
    outcome = run_program(["sh", "-c", f'mkdir gone && cd gone && rmdir ../gone && exec "$@" {line}', "sh", *COMMAND])
    assert outcome.returncode == 11 and "the current folder was removed: change to another" in outcome.stderr


@pytest.mark.real_time
def test_a_recording_overwrites_no_file(endpoints, folder):
    to = ["--endpoint", endpoints[0], "--timeout", "60"]
    result = called("record", "a.csv", "--duration", "0.05", *to)
    assert result.returncode == 3 and "already exists" in result.stderr and (folder / "a.csv").read_text() == POSES
    result = called("record", "short.csv", "--duration", "0.0005", *to)
    assert result.returncode == 3 and "at least 2" in result.stderr and not (folder / "short.csv").exists()
    result = called("record", "--poses", "index=b.csv", "--poses", "thumb=./b.csv", *to)
    assert result.returncode == 2 and "are the same file" in result.stderr and not (folder / "b.csv").exists()
    assert called("record", "b.csv", "--duration", "0.05", *to).returncode == 0 and (folder / "b.csv").stat().st_size


def test_a_name_that_the_terminal_cannot_encode_is_escaped(tmp_path):
    scene = tmp_path / "scene.toml"
    table = 'name = "стол"\nshape = "plane"\nmaterial = "rubber"\n'
    scene.write_text(f"[fingertip]\nradius_m = 0.01\n[[object]]\n{table}", "utf-8")
    result = run_program([*COMMAND, "check", str(scene)], env=os.environ | {"PYTHONIOENCODING": "ascii"})
    assert result.returncode == 0 and "Traceback" not in result.stderr
    assert "\\u0441\\u0442\\u043e\\u043b" in result.stdout


def test_an_endpoint_in_use_gives_exit_code_7():
    with zmq.Context() as context, context.socket(zmq.PUB) as socket:
        port = socket.bind_to_random_port("tcp://127.0.0.1")
        result = run("run", "--endpoint", f"tcp://127.0.0.1:{port}", "--duration", "1")
    assert result.returncode == 7 and str(port) in result.stderr


PEAK = """
import sys
from softfinger.server.cli import main
code = main(sys.argv[1:])
peak = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(code, int(peak.split()[1]) // 1024)
"""


@pytest.mark.exhaustive  # ten minutes of ticks, written three times
@pytest.mark.parametrize("ending", [".csv", ".npz", ".mcap"])
def test_a_long_run_needs_bounded_memory(ending, tmp_path):
    t = np.arange(60_001) * 0.01
    zero, z = np.zeros_like(t), 0.0095 + 0.001 * np.sin(7.0 * t)
    poses = np.column_stack([t, 0.01 * np.sin(t), zero, z, zero + 1.0, zero, zero, zero])
    header = "t,x,y,z,qw,qx,qy,qz"
    np.savetxt(tmp_path / "poses.csv", poses, fmt="%.9g", delimiter=",", header=header, comments="")
    words = ["simulate", "--scene", "paper-plane", "--poses", "poses.csv", "--out", f"out{ending}"]
    outcome = run_program([sys.executable, "-c", PEAK, *words], cwd=tmp_path, check=True)
    code, peak = map(int, outcome.stdout.splitlines()[-1].split())
    assert code == 0 and "600001 ticks" in outcome.stdout
    assert peak <= 250


@pytest.mark.parametrize("ending", [".csv", ".npz", ".parquet"])
def test_a_shipped_recording_is_read_by_its_name(ending, tmp_path):
    output = read_stdout("info", "tap")
    assert "229 poses, 0 to 228, 2.280 s" in output and "x 0 to 0, y 0 to 0, z " in output and "unknown" not in output
    poses, out = tmp_path / f"poses{ending}", tmp_path / "out.csv"
    read_stdout("export", "tap", "--out", str(poses))
    if ending != ".parquet":
        read_stdout(*SIMULATE, "--out", str(out))
        read_stdout("replay", "tap", "--scene", "paper-plane", "--against", str(out))
        before = out.read_bytes()
        read_stdout("simulate", "--poses", str(poses), "--out", str(out))
        assert out.read_bytes() == before and "sliding" in read_stdout("info", str(out))


def test_simulate_is_deterministic_and_takes_another_rate(tmp_path):
    for program, name in ((run, "a.csv"), (called, "b.csv")):
        assert program(*SIMULATE, "--out", str(tmp_path / name)).returncode == 0
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()
    out = tmp_path / "fast.npz"
    called(*SIMULATE, "--out", str(out), "--rate", "4000")
    assert len(read_results(out)) == 4 * 2280 + 1


def test_the_forces_sent_to_a_device_equal_a_replay(tmp_path):
    for ending in ("csv", "npz"):
        forces = str(tmp_path / f"forces.{ending}")
        words = ["run", "--once", "--recording", "tap", "--realtime", "off", "--forces", forces]
        read_stdout(*words, "--endpoint", f"ipc://{tmp_path}/t")
        words = ["replay", "tap", "--scene", "paper-plane", "--tolerance", "0", "--against", forces, "--json"]
        report = printed(read_stdout(*words))
        assert report["compared"] == 2281 and set(report["largest"]) == {"force", "torque"}


def test_explain_prints_measured_costs():
    output = read_stdout("check", "--explain", "frictionless-plane", "replay")
    passive = r"1000 N/m; passive at 1000 Hz .* more than 0\.5"
    for pattern in (r"cost of a tick.*\d+ ns", r"bare contact.*\d+ ns", passive):
        assert len(re.findall(pattern, output)) == 1, output


def test_output_into_a_closed_pipe_is_no_error():
    reader, writer = os.pipe()
    process = subprocess.Popen([*COMMAND, "schema", "telemetry"], stdout=writer, stderr=subprocess.PIPE, text=True)
    os.close(writer)
    os.close(reader)
    assert process.wait(60) == 0 and process.stderr.read() == ""
    process.stderr.close()


LONG = "x" * 300


@pytest.mark.parametrize(
    ("line", "code", "message"),
    [
        ("check paper-plane >&-", 0, ""),
        ("check paper-plane 2>&-", 0, ""),
        ("schema telemetry >/dev/full", 11, "No space left on device"),
        ("run --duration 0.2 --realtime off --endpoint tcp://127.0.0.1:* <&- >&- 2>&-", 0, ""),
        ("run --duration 0.2 --realtime off --endpoint tcp://127.0.0.1:* 2>&1 | head -1", 0, "--view"),
        (f"check {LONG}", 2, "no scene, rig or experiment is named"),
        (f"check {LONG}.toml", 2, "File name too long"),
        (f"run --endpoint tcp://127.0.0.1:* --recording {LONG}.csv", 3, "File name too long"),
        (f"record --poses {LONG}.csv --timeout 0.1 --endpoint ipc:///nowhere/x", 9, "no telemetry"),
        ("NUMBA_DISABLE_JIT=1 run --endpoint tcp://127.0.0.1:*", 5, "NUMBA_DISABLE_JIT is set"),
        ("NUMBA_DISABLE_JIT=1 doctor --seconds 0.1", 5, "NUMBA_DISABLE_JIT is set"),
        ("NUMBA_DISABLE_JIT=1 stability", 5, "NUMBA_DISABLE_JIT is set"),
        ("NUMBA_DISABLE_JIT=1 accuracy", 5, "NUMBA_DISABLE_JIT is set"),
    ],
)
def test_an_unusable_stream_name_or_environment_gives_one_line(line, code, message):
    variables = "NUMBA_DISABLE_JIT=1 " * line.startswith("NUMBA")
    words = ["bash", "-c", f"set -o pipefail; {variables}{shlex.join(COMMAND)} {line.removeprefix(variables)}"]
    outcome = run_program(words)
    assert outcome.returncode == code, outcome.stderr
    assert "Traceback" not in outcome.stderr and message in outcome.stdout + outcome.stderr
    assert len([row for row in outcome.stderr.splitlines() if row.startswith("softfinger:")]) <= 1


def test_closed_streams_do_not_become_a_device(tmp_path):
    code = (
        "import os, sys\nfor fd in (0, 1, 2): os.close(fd)\nsys.stdout = sys.stderr = None\n"
        "from softfinger.server.cli import open_streams\nopen_streams()\n"
        "fd = os.open(sys.argv[1], os.O_WRONLY | os.O_CREAT)\n"
        "os.write(fd, b'%d' % fd); os.write(1, b'out'); os.write(2, b'err'); print('out')\n"
    )
    node = tmp_path / "node"
    subprocess.run([sys.executable, "-c", code, str(node)], check=True)
    assert int(node.read_text()) > 2


@pytest.mark.parametrize("words", [["check", "paper-plane"], ["run"]])
def test_a_low_limit_of_open_files_is_reported(words):
    command = f"ulimit -n 8; exec {shlex.join([*COMMAND, *words])}"
    outcome = run_program(["bash", "-c", command])
    assert outcome.returncode == 11, outcome.stderr
    assert outcome.stderr == "softfinger: this process may open 8 files, but needs 64: raise `ulimit -n`\n"


@pytest.mark.plain
def test_bench_of_the_step_prints_json(tmp_path, monkeypatch):
    from softfinger.tools.bench import step

    monkeypatch.setattr("softfinger.server.loop.servo_thread.PLAIN", False)  # only the measured times are different
    monkeypatch.setattr(step, "ROUNDS", 2)
    poses = step.make_touching_poses
    monkeypatch.setattr(step, "make_touching_poses", lambda scene: poses(scene, 50))
    monkeypatch.setattr(step, "measure_reference_ns", lambda: 100.0)  # the reference chain is fast only when compiled
    plot = tmp_path / "plot.png"
    words = ["bench", "step", "--json", "--plot", str(plot), "--blocks", "2", "--features", "torsion linear"]
    result = json.loads(read_stdout(*words))
    assert plot.read_bytes().startswith(b"\x89PNG")
    # the costs of a shipped scene, its variants without one part each, and one feature; all in contact
    assert len(result["variants"]) == 5 and {"ns_per_step", "cpu_ns_per_step"} <= result["variants"][0].keys()
    assert all(row["in_contact"] == 1.0 for row in result["variants"])
    (feature,) = result["features"]
    assert feature["feature"] == "torsion linear" and feature["in_contact"] == 1.0
    assert feature["reference_ns"] > 0.0 and {"ns_per_step", "marginal_ns"} <= feature.keys()


def test_run_is_drawn(tmp_path):
    drawn = []
    for name in ("one.svg", "two.svg"):
        read_stdout(*SIMULATE, "--out", str(tmp_path / "out.csv"), "--plot", str(tmp_path / name))
        drawn.append((tmp_path / name).read_text())
    assert drawn[0] == drawn[1]
    assert all(f">{word}</text>" in drawn[0] for word in ("penetration", "norm", "torsion", "rolling", "time [s]"))


def test_names_that_are_not_utf8(tmp_path: Path) -> None:
    """Python represents their bytes by lone surrogates, which messages and files in UTF-8 cannot contain."""
    folder = tmp_path / os.fsdecode(b"\xff")
    folder.mkdir()
    scene, recording = folder / os.fsdecode(b"scene\xff.toml"), folder / "run.mcap"
    shutil.copy(FOLDERS[Scene] / "paper-plane.toml", scene)
    words = ["--scene", str(scene), "--record", str(recording), "--endpoint", "tcp://127.0.0.1:*"]
    assert called("run", *words, "--realtime", "off", "--duration", "0.1").returncode == 0
    info = summarize(recording)
    assert info["whole"] and info["scene_name"] is not None
    event = make_event((1, 2.0), "change", "record_start", {"file": str(folder), "more": [str(folder)]})
    for encoded in (encode(event), encode_answer("1", RecordStartResult(str(folder), 0))):
        assert b"/\\udcff" in encoded
