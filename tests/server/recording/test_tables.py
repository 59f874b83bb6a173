"""Import of tables from other programs: columns, units, dialects and refused files."""

from pathlib import Path

import numpy as np
import pytest
from helpers.called import called, read_stdout

from softfinger.config.errors import ConfigError, RecordingError
from softfinger.drivers.poses import load_poses
from softfinger.server.recording.tables import TableFormat, make_layout, read_table

TXYZ = TableFormat(("t", "x", "y", "z"))
COUNT = 200
TIME = np.arange(COUNT) * 1e-3
PLACE = np.stack([0.03 * np.sin(TIME), 0.02 * np.cos(TIME), 0.01 + TIME / 7.0], axis=1)
TURN = np.stack([np.cos(TIME), np.sin(TIME), 0.0 * TIME, 0.0 * TIME], axis=1)


def write_table(path: Path, rows: np.ndarray, between: str = " ", before: str = "") -> Path:
    path.write_text(before + "".join(between.join(f"{x:.17g}" for x in row) + "\n" for row in rows))
    return path


@pytest.mark.parametrize("between", [" ", "\t", ",", ";", ", ", "   "])
def test_columns_and_units_are_as_they_are_named(between: str, tmp_path: Path) -> None:
    rows = np.column_stack((PLACE[:, 1] * 1e3, np.full(COUNT, 7.0), 500.0 + TIME * 1e3, PLACE[:, [0, 2]] * 1e3))
    file = write_table(tmp_path / "theirs.txt", rows, between, "# made by hand\n\n")
    poses = read_table(file, make_layout("y,-,t,x,z", 1e-3, 1e-3, None, 0))
    # rounding of 500 ms plus t, and of one multiplication per unit
    np.testing.assert_allclose(poses.t, TIME, rtol=0, atol=1e-15)
    np.testing.assert_allclose(poses.position, PLACE, rtol=4e-16)
    assert (poses.orientation == [1.0, 0.0, 0.0, 0.0]).all()


@pytest.mark.parametrize("between", [";", "\t", " ", " ; "])
def test_decimal_commas_are_read(between: str, tmp_path: Path) -> None:
    lines = [between.join(f"{x:.17g}" for x in row).replace(".", ",") for row in np.column_stack((TIME, PLACE))]
    heading, empty = between.join(["Zeit(s)", "X(m)", "Y(m)", "Z(m)"]), between.strip(" ") * 2
    file = tmp_path / "theirs.csv"
    file.write_bytes(b"\xef\xbb\xbf" + "\r\n".join([heading, *(line + empty for line in lines), ""]).encode())
    message = r"line 1, column 't': 'Zeit\(s\)' is not a number; --skip N skips a heading"
    with pytest.raises(RecordingError, match=message):
        read_table(file, TXYZ)
    poses = read_table(file, TableFormat(("t", "x", "y", "z"), skip=1))
    np.testing.assert_array_equal(poses.position, PLACE)
    file.write_text("\n".join([*lines[:3], lines[3].replace(",", "."), ""]))
    with pytest.raises(RecordingError, match="line 4: has decimal commas and decimal points"):
        read_table(file, TXYZ)


def test_quoted_cells_may_have_decimal_commas(tmp_path: Path) -> None:
    file = tmp_path / "theirs.csv"
    file.write_text('"0,0","0,001",0,"0,01","a, b"\n"0,1","0,002",0,"0,02",""\n')
    poses = read_table(file, TableFormat(("t", "x", "y", "z", "-")))
    assert poses.position.tolist() == [[0.001, 0.0, 0.01], [0.002, 0.0, 0.02]]


def test_a_column_that_is_sometimes_empty_is_skipped(tmp_path: Path) -> None:
    file = tmp_path / "theirs.csv"
    file.write_bytes(b"\xef\xbb\xbf0.0,0,0,0.01,\n0.1,0,0,0.02,\n0.2,0,0,0.03,press\n0.3,,0,0.04,\n")
    with pytest.raises(RecordingError, match=r"line 4, column 'x': the cell is empty"):
        read_table(file, TableFormat(("t", "x", "y", "z", "-")))
    with pytest.raises(RecordingError, match="line 3: 5 values where --columns has 4: give a name or - for each"):
        read_table(file, TXYZ)
    file.write_bytes(file.read_bytes().replace(b",,", b",0,"))
    assert read_table(file, TableFormat(("t", "x", "y", "z", "-"))).position[:, 2].tolist() == [0.01, 0.02, 0.03, 0.04]


@pytest.mark.parametrize(
    ("text", "columns"),
    [
        ("foo\t0\t0\t0\t0.01\n\t0.1\t0\t0\t0.01\n", "-,t,x,y,z"),
        ("0\t0\t0\t0.01\tfoo\n0.1\t0\t0\t0.01\t\n", "t,x,y,z,-"),
        ('"a;b, c";0;0;0;0,01\n;0,1;0;0;0,01\n', "-,t,x,y,z"),
        ("0;0;0;0,01\n0,1;0;0;0,01\n;;;\n", "t,x,y,z"),
        ("0,0,0,.01\n0.1,0,0,1E-2\n,,,\n", "t,x,y,z"),
        ("0,0,0,1e-2\n0.1,\N{MINUS SIGN}0,0,0.01\n", "t,x,y,z"),
    ],
)
def test_dialects_of_spreadsheets(text: str, columns: str, tmp_path: Path) -> None:
    file, out = tmp_path / "theirs.csv", tmp_path / "poses.csv"
    file.write_text(text, "utf-8")
    read_stdout("import", str(file), "--columns", columns, "--out", str(out))
    poses = load_poses(out)
    assert poses.t.tolist() == [0.0, 0.1] and poses.position.tolist() == [[0.0, 0.0, 0.01]] * 2


def test_the_verb_writes_poses_for_a_replay(tmp_path: Path) -> None:
    file = write_table(tmp_path / "theirs.txt", np.column_stack((PLACE, TURN)), before="Haptic Table 1.0\n7 columns\n")
    out = tmp_path / "poses.csv"
    words = ["--columns", "x,y,z,qw,qx,qy,qz", "--rate", "1000", "--skip", "2", "--out", str(out)]
    output = read_stdout("import", str(file), *words)
    assert "200 poses over 0.199 s; x 0 to 5.931, y 19.61 to 20, z 10 to 38.43 mm" in output
    poses = load_poses(out)
    np.testing.assert_array_equal(poses.t, np.arange(COUNT) / 1000.0)
    np.testing.assert_array_equal(poses.position, PLACE)
    np.testing.assert_allclose(poses.orientation, TURN, rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("parts", "fault"),
    [
        (("t,x,y", 1.0, 1.0, None, 0), "needs x, y and z"),
        (("t,x,y,z,qw", 1.0, 1.0, None, 0), "all or none"),
        (("t,x,y,z,x", 1.0, 1.0, None, 0), "'x' is not one of"),
        (("t,x,y,z,force", 1.0, 1.0, None, 0), "'force' is not one of"),
        (("x,y,z", 1.0, 1.0, None, 0), "either a column t or --rate"),
        (("t,x,y,z", 0.0, 1.0, None, 0), "--unit-s 0: must be above 0"),
        (("t,x,y,z", 1.0, float("nan"), None, 0), "--unit-m nan: must be above 0"),
        (("x,y,z", 1.0, 1.0, -1.0, 0), "--rate -1: must be above 0"),
        (("t,x,y,z", 1.0, 1.0, None, -1), "--skip -1"),
    ],
)
def test_an_impossible_layout_is_refused(parts: tuple, fault: str) -> None:
    with pytest.raises(ConfigError, match=fault):
        make_layout(*parts)


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (b"0 0 0 0\n1 0 0\n", "line 2: 3 values where --columns has 4"),
        (b"0 0 0 0\n1 0 0 up\n", r"line 2, column 'z': 'up' is not a number"),
        (b"0 0 0 0\n0 0 0 0\n", r"line 2, column 't': 0 s does not follow 0 s"),
        (b"0 0 0 0\n1 0 0 nan\n", "line 2, column 'z': nan is not a finite number"),
        (b"0 0 0 0\n", "1 pose"),
        (b"", "0 pose"),
        (b"0 0 0 0\n\xff 0 0 0\n", "line 2: not a text file"),
        ("0;0;0;0,01\n".encode("utf-16"), "is text in UTF-16: save it as UTF-8"),
        ("0;0;0;0,01\n".encode("utf-32"), "is text in UTF-32: save it as UTF-8"),
        ("0;0;0;0,01\n".encode("utf-16-le"), "is not text in UTF-8: save it as CSV in UTF-8"),
        (b"0 0 0 0\r1 0 0 0\r", "line 1: has carriage returns: save it with line feeds"),
        (b"0,0,0,0\n1,,0,0\n", "line 2, column 'x': the cell is empty: fill it, or delete the line$"),
        (b"0 0 0 0\n1 0 0 1e9\n", "outside"),
        # The first row sets the separator: splitting a decimal comma does not complete a row that lacks a value.
        (b"0,004 0,1 0,2 0,3\n0,005 0,1 0,2 0,3\n0,006 0 0", "line 3: 3 values where --columns has 4"),
        (b"0;0;0;0\n1,0,0,0", "line 2: 1 value where --columns has 4"),
        (b"0 0 0 0\n1 0_2 0 0", "column 'x': '0_2' is not a number; write a number such as"),
        (b"0|0|0|0", "1 value where --columns has 4: separate them by commas, semicolons, tabs or blanks"),
        (b"0,0,0,1,0,0,0,2", "8 values .*; decimal commas need semicolons, tabs or blanks"),
        (b"0;.;0;0", r"'\.' is not a number"),
        # A line that starts with ; is a comment unless it has a cell for each column.
        (b"\xef\xbb\xbf# made by hand\n; and here\n0;0;0;0,01\n;0;0;0,02\n", "line 4, column 't': the cell is empty"),
    ],
)
def test_a_file_that_is_no_such_table_is_refused_where_it_is_wrong(text: bytes, fault: str, tmp_path: Path) -> None:
    file = tmp_path / "theirs.txt"
    file.write_bytes(text)
    with pytest.raises(RecordingError, match=fault):
        read_table(file, TXYZ)


def test_a_refused_table_writes_no_file(tmp_path: Path) -> None:
    write_table(tmp_path / "theirs.txt", np.zeros((3, 4)))
    for file, out in (("theirs.txt", "poses.csv"), ("theirs.txt", "poses.npz"), ("none", "poses.csv")):
        words = ["import", str(tmp_path / file), "--columns", "t,x,y,z", "--out", str(tmp_path / out)]
        assert called(*words).returncode != 0
    assert [path.name for path in tmp_path.iterdir()] == ["theirs.txt"]
