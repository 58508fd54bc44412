"""Tables that spreadsheets, pandas and R have saved read back to the same measurements."""

from __future__ import annotations

import csv
import decimal
import io
import itertools
import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from linkpose.errors import FileExists, FileFormatError
from linkpose.localization.events import beacon_name
from linkpose.localization.tables import read_beacons
from linkpose.recording import columns
from linkpose.recording.csvfile import CsvFile, head
from linkpose.recording.reader import load_recording
from linkpose.recording.table import read_table

RIG = {"joint": {"j2s_m": [-0.09, 1.0, 1.65], "j2s_std_m": 0.0001}}
METADATA = {"software": "linkpose", "device": 'sim://a?b=1&c="d"', "settings": {"sample_rate_hz": 100}, "is": True}
NAMES = columns.names(columns.ColumnLayout(1))
rows_of_recordings = st.lists(
    st.tuples(
        *[st.integers(-156_000_000, 156_000_000)] * 3,
        *[st.integers(-350_000_000, 350_000_000)] * 3,
        st.integers(30_000, 110_000) | st.none(),
        st.integers(-300, 300) | st.none(),
    ),
    min_size=1,
    max_size=6,
)


def written(rows) -> str:
    """A recording as linkpose writes it."""
    text = head("recording", METADATA | {"rig": RIG}, NAMES)
    for i, (ax, ay, az, gx, gy, gz, pressure, counts) in enumerate(rows):
        imu = [f"{value / 1e6:.6f}" for value in (ax, ay, az)] + [f"{value / 1e7:.7f}" for value in (gx, gy, gz)]
        pressure_cells = [str(pressure), "24.9", "1"] if pressure else ["", "", "0"]
        mice = ["", ""] if counts is None else [str(counts), "0"]
        text += ",".join([f"{0.01 * i:.6f}", str(i), *imu, "26.9682", *pressure_cells, *mice, "9"]) + "\n"
    return text + f"# {json.dumps({'samples': len(rows), 'lost': 0, 'gaps': []})}\n"


def number(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None


def spreadsheet(text: str, separator: str, *, comma: bool = False, end: str = "\r\n", quoting: int = 0) -> str:
    """What a spreadsheet saves after it has split the file at its commas: rows padded, numbers shortened."""
    cells = list(csv.reader(io.StringIO(text)))
    width = max(map(len, cells))
    out = io.StringIO()
    writer = csv.writer(out, delimiter=separator, lineterminator=end, quoting=csv.QUOTE_MINIMAL)
    for row in cells:
        shown = []
        for cell in row + [""] * (width - len(row)):
            value = number(cell)
            general = cell if value is None else f"{value:.10G}"
            general = {" true": "TRUE", "true": "TRUE"}.get(general, general)
            shown.append(general.replace(".", ",") if comma and value is not None else general)
        writer.writerow(shown)
    text = out.getvalue()
    if quoting:  # all texts, as LibreOffice offers
        text = text.replace(separator.join(NAMES), separator.join(f'"{name}"' for name in NAMES))
    return text


def one_cell_a_line(text: str) -> str:
    """A spreadsheet whose list separator is a semicolon keeps each line in one cell, and quotes it."""
    out = io.StringIO()
    csv.writer(out, delimiter=";", quoting=csv.QUOTE_ALL).writerows([line] for line in text.splitlines())
    return out.getvalue()


def libreoffice(text: str, separator: str) -> str:
    """LibreOffice takes a text after a comma of the metadata for a quoted cell, and drops its quotes."""
    lines = text.splitlines()
    cells, at = [""], 0
    while at < len(lines[1]):
        word = at + (lines[1][at] == " ")
        end = lines[1].find('",', word + 1) if lines[1][word] == '"' else -1
        cell = lines[1][word + 1 : end] if end >= 0 else lines[1][word:].split(",")[0]
        at = end + 2 if end >= 0 else word + len(cell) + 1
        cells.append(cell)
    out = io.StringIO()
    writer = csv.writer(out, delimiter=separator, lineterminator="\n")
    writer.writerows([[lines[0]], cells[1:], *(line.split(",") for line in lines[2:])])
    return out.getvalue()


def gnumeric(text: str, separator: str) -> str:
    """Gnumeric's ssconvert takes the separator of the metadata for that of the file: lines in one cell, and padded."""
    out = io.StringIO()
    width = text.splitlines()[1].count(":")
    writer = csv.writer(out, delimiter=separator, lineterminator="\n", quoting=csv.QUOTE_MINIMAL)
    for line in text.splitlines():
        cells = ["# ", "software", "kind"] if line.startswith("# {") else [line]
        writer.writerow(cells + [""] * (width - len(cells)))
    return out.getvalue().replace("# linkpose recording 1", '"# linkpose recording 1"')


def with_all_digits(text: str) -> str:
    """Numbers with 20 digits of their binary values, as Gnumeric writes some: 0.31492800000000000001."""
    lines = text.splitlines()
    for i, line in enumerate(lines[3:-1], 3):
        numbers = [f"{decimal.Decimal(float(cell)):.20g}" if "." in cell else cell for cell in line.split(",")]
        lines[i] = ",".join(numbers)
    return "\n".join(lines) + "\n"


def pandas(text: str, *, index: bool) -> str:
    import pandas as pd

    return str(pd.read_csv(io.StringIO(text), comment="#").to_csv(index=index))


def r_language(text: str, separator: str, *, with_corner: bool) -> str:
    """R's write.csv and write.table: row names, all texts quoted, NA; write.table leaves the corner out."""
    rows = [line.split(",") for line in text.splitlines() if not line.startswith("#")]
    lines = [separator.join(['""'] * with_corner + [f'"{name}"' for name in rows[0]])]
    for i, row in enumerate(rows[1:], 1):
        lines.append(separator.join([f'"{i}"', *(f"{float(cell):.15g}" if cell else "NA" for cell in row)]))
    return "\n".join(lines) + "\n"


def shuffled(text: str) -> str:
    lines = text.splitlines()
    rows = [line.split(",")[::-1] for line in lines[2:-1]]
    return "\n".join([*lines[:2], *map(",".join, rows), lines[-1]]) + "\n"


PROGRAMS = {
    "Excel, English": lambda text: spreadsheet(text, ",").encode(),
    "Excel, English, with a mark": lambda text: b"\xef\xbb\xbf" + spreadsheet(text, ",").encode(),
    "Excel, German": lambda text: spreadsheet(text, ";", comma=True).encode("cp1252"),
    "Excel, German, lines in one cell": lambda text: one_cell_a_line(text).encode(),
    "Excel, Unicode text": lambda text: b"\xff\xfe" + spreadsheet(text, "\t", comma=True).encode("utf-16-le"),
    "UTF-16 without a mark": lambda text: spreadsheet(text, "\t").encode("utf-16-be"),
    "Excel, Macintosh": lambda text: spreadsheet(text, ",", end="\r").encode(),
    "Excel, sep=": lambda text: b"sep=;\r\n" + spreadsheet(text, ";").encode(),
    "LibreOffice": lambda text: spreadsheet(text, ",", end="\n", quoting=1).encode(),
    "LibreOffice, texts without quotes": lambda text: libreoffice(text, ",").encode(),
    "LibreOffice, texts without quotes, semicolons": lambda text: libreoffice(text, ";").encode(),
    "LibreOffice, decimal commas between commas": lambda text: spreadsheet(text, ",", comma=True).encode(),
    "Gnumeric": lambda text: spreadsheet(text, "\t", end="\n").encode(),
    "Gnumeric, padded lines in one cell": lambda text: gnumeric(text, ",").encode(),
    "Gnumeric, padded lines in one cell, semicolons": lambda text: gnumeric(text, ";").encode(),
    "Gnumeric, all digits": lambda text: with_all_digits(text).encode(),
    "other order": lambda text: shuffled(text).encode(),
    "pandas": lambda text: pandas(text, index=False).encode(),
    "pandas with an index": lambda text: pandas(text, index=True).encode(),
    "R write.csv": lambda text: r_language(text, ",", with_corner=True).encode(),
    "R write.table": lambda text: r_language(text, " ", with_corner=False).encode(),
    "R write.table with tabs": lambda text: r_language(text, "\t", with_corner=False).encode(),
}


@pytest.mark.parametrize("program", PROGRAMS)
@settings(max_examples=15)
@given(rows=rows_of_recordings)
def test_a_saved_recording_reads_back(tmp_path_factory, program, rows):
    path = tmp_path_factory.mktemp("saved") / "run.csv"
    path.write_text(written(rows))
    own = read_table(path, "recording")
    assert own.metadata["rig"] == RIG
    path.write_bytes(PROGRAMS[program](written(rows)))
    other = read_table(path, "recording")
    assert set(other.columns) == set(own.columns)
    for name, values in own.columns.items():
        assert np.array_equal(other.columns[name], values, equal_nan=True), name
    if "padded" in program:
        assert other.kind == "recording" and "damaged the metadata" in other.remarks[0]
    elif not program.startswith(("pandas", "R ")):
        assert (other.metadata, other.closing, other.remarks) == (own.metadata, own.closing, ())


@pytest.mark.parametrize("kind", ["csv", "xlsx"])
def test_gnumeric_itself(tmp_path, kind):
    """Saved as a workbook and exported again, or exported at once."""
    path = tmp_path / "run.csv"
    assert shutil.which("ssconvert") is not None, "install the Debian package gnumeric"
    path.write_text(written([(1_234_567, -1, 9_800_000, 100, 7, 0, 100_000, 3), (1, 0, 2, 3, 4, 5, None, None)] * 9))
    own, names = read_table(path), [path, tmp_path / f"saved.{kind}", tmp_path / "again.csv"]
    for source, target in itertools.pairwise(names):
        subprocess.run(["ssconvert", source, target], check=True, capture_output=True)
    other = read_table(names[2])
    assert all(np.allclose(other.columns[n], own.columns[n], rtol=1e-15, equal_nan=True) for n in own.columns)
    assert other.kind == "recording" and "damaged the metadata" in other.remarks[0]


DATES = {"25.01.2026", "01. Mai", "1-May", "May-26", "2026-05-01", "5/1/2026", "1.5.26", "00:00:01"}


@pytest.mark.parametrize("cell", sorted(DATES))
def test_a_number_that_became_a_date_is_named(tmp_path, cell):
    """Excel in German takes 1.5 for the first of May."""
    (tmp_path / "run.csv").write_text(f"time_s;height_m\n0;1\n1;{cell}\n")
    with pytest.raises(FileFormatError, match=r"line 3: .* is a date or a time of day: .*English numbers"):
        read_table(tmp_path / "run.csv")


def test_a_recording_without_metadata_is_used_and_named(tmp_path):
    text = written([(1_000_000, 0, 9_800_000, 100, 0, 0, 100_000, 3)] * 40)
    (tmp_path / "own.csv").write_text(text)
    (tmp_path / "pandas.csv").write_text(pandas(text, index=True))
    own, other = load_recording(tmp_path / "own.csv"), load_recording(tmp_path / "pandas.csv")
    assert np.array_equal(other.measurements.accel_m_s2, own.measurements.accel_m_s2, equal_nan=True)
    assert other.rig is None and other.sample_rate_hz == pytest.approx(100.0)
    assert any("has no metadata" in remark for remark in other.remarks)


def test_metadata_that_a_spreadsheet_damaged_are_left_out_with_a_remark(tmp_path):
    saved = spreadsheet(written([(1, 2, 3, 4, 5, 6, 100_000, 1)]), ";").replace('""settings""', '""settings')
    (tmp_path / "run.csv").write_text(saved)
    table = read_table(tmp_path / "run.csv", "recording")
    assert table.metadata == {} and "damaged the metadata" in table.remarks[0]
    assert any("damaged the metadata" in remark for remark in load_recording(tmp_path / "run.csv").remarks)


REFUSED = {
    "decimal commas between commas": ("time_s,height_m\n0,00,1,50\n0,01,1,51\n", "need semicolons or tabs"),
    "both decimal marks": ("time_s;height_m\n0,00;1.5\n", "line 2: '0,00' and '1.5' can be read in two ways"),
    "separators of thousands": ('time_s,pressure_Pa\n0,"1,012,970"\n', "'1,012,970' can be read in two ways"),
    "a word": ("time_s;height_m\n0;1\n1;tall\n", "line 3: 'tall' is not a number"),
    "Python's own numbers": ("time_s;height_m\n0;1_0\n", "line 2: '1_0' is not a number"),
    "a nameless column of numbers": ("time_s,,height_m\n0,1,2\n", "line 1: expected the names of the columns"),
    "a short row": ("time_s;height_m;roll_deg\n0;1;2\n1;2\n", "line 3: 2 fields where the header has 3"),
    "an open quote": ('time_s;height_m\n0;"1\n1;2\n', "line 2: "),
    "the same name twice": ("time_s;a;a\n0;1;2\n", "column a stands twice"),
    "no names": ("0,0;1,5\n0,1;1,6\n", "expected the names of the columns"),
    "a header alone": ("time_s;height_m\n;\n", "has a header but no row"),
    "an image": ("\x89PNG\r\n\x1a\n\0\0\0\rIHDR", "bad.csv"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_read_is_named(name, tmp_path):
    text, sentence = REFUSED[name]
    path: Path = tmp_path / "bad.csv"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(FileFormatError) as raised:
        read_table(path)
    assert sentence in str(raised.value)


@settings(max_examples=150)
@given(data=st.binary(max_size=120) | st.text('time_s,;\t"#\n0123.- NA', max_size=80).map(str.encode))
def test_any_bytes_are_a_table_or_a_sentence(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "any.csv"
    path.write_bytes(data)
    try:
        table = read_table(path)
    except FileFormatError as error:
        assert str(path) in str(error)
    else:
        assert len({len(column) for column in table.columns.values()}) == 1


def test_long_names_take_time_in_proportion_to_their_length(tmp_path):
    """With patterns that go back, these names took half a minute and minutes."""
    (tmp_path / "a.csv").write_text("a" * 100_000 + "\tb\n1\t2\n")
    assert read_table(tmp_path / "a.csv").columns["b"].tolist() == [2.0]
    assert beacon_name("0" * 300_000 + "x").endswith("0x")


def test_a_plain_file_has_its_metadata_beside_it(tmp_path):
    """numpy and pandas read it without options; linkpose reads the same as from its own file."""
    import pandas as pd

    rows = {"time_s": [0.0, 0.01], "tilt_height_m": [1.5, 1.25]}
    closing = {"rows": 2}
    for name, plain in (("own.csv", False), ("plain.csv", True)):
        with CsvFile(tmp_path / name, "estimate", METADATA, list(rows), False, plain) as file:
            file.write("0.00,1.5\n0.01,1.25\n")
            file.close(closing)
    path = tmp_path / "plain.csv"
    assert path.read_text() == "time_s,tilt_height_m\n0.00,1.5\n0.01,1.25\n"
    assert pd.read_csv(path).to_dict("list") == rows
    assert np.genfromtxt(path, names=True, delimiter=",")["tilt_height_m"].tolist() == rows["tilt_height_m"]
    own, found = read_table(tmp_path / "own.csv", "estimate"), read_table(path, "estimate")
    assert (found.kind, found.metadata, found.closing) == (own.kind, own.metadata, own.closing)
    assert found.metadata == METADATA and found.closing == closing
    with pytest.raises(FileFormatError, match="is a linkpose estimate, not a recording"):
        read_table(path, "recording")
    path.unlink()
    with pytest.raises(FileExists, match=r"plain\.meta\.json exists already"):
        CsvFile(path, "estimate", METADATA, list(rows), False, True)
    assert not path.exists()
    (tmp_path / "plain.meta.json").write_text("[]")
    path.write_text("time_s,tilt_height_m\n0.00,1.5\n")
    with pytest.raises(FileFormatError, match="not a JSON object"):
        read_table(path)


def test_the_documented_calls_of_numpy_and_pandas_read_linkposes_own_files(tmp_path):
    import pandas as pd

    path = tmp_path / "run.csv"
    path.write_text(written([(1_000_000, 0, 9_800_000, 100, 0, 0, 100_000, 3)] * 3))
    own = read_table(path).columns
    frame = pd.read_csv(path, comment="#")
    assert all(np.array_equal(frame[name], own[name]) for name in own)
    found = np.genfromtxt(path, names=True, delimiter=",", skip_header=2)
    assert all(np.array_equal(found[name], own[name]) for name in own)


def test_beacons_that_spreadsheets_saved(tmp_path):
    path = tmp_path / "beacons.csv"
    expected = {"0xDD05": (-3.5, 3.0, 0.0), "5": (0.25, 3.0, 0.0)}
    for text in (
        "id,x_m,y_m\n0xDD05,-3.5,3.0\n05,0.25,3\n",
        "id;x_m;y_m;\r\n0xDD05;-3,5;3,0;\r\n5;0,25;3;\r\n",
        '"","y_m","x_m","id"\n"1",3,-3.5,"0xDD05"\n"2",3,0.25,"5"\n',
        "# the room,,\nid,x_m,y_m\n0xDD05,-3.5,3.0\n5.0,0.25,3\n,,\n",
    ):
        path.write_text(text, encoding="utf-16" if ";" in text else "utf-8")
        assert read_beacons(path) == expected


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("rig.toml", "# my rig\n[joint]\nj2s_m = [1, 2, 3]\n"),
        ("rig", "[[mouse]]\nx_m = 1\n"),
        ("m.yaml", "a: 1\nb: 2\n"),
    ],
)
def test_a_file_of_settings_is_no_table(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    with pytest.raises(FileFormatError, match="holds settings, no table"):
        read_table(tmp_path / name)


@pytest.mark.parametrize(
    ("beginning", "what"),
    [
        (b"\x89PNG\r\n\x1a\n", "a picture"),
        (b"\x02P\x13\0\x04\0\0\0\n1\n", "a C3D file, which only `evaluate` and `plot` read"),
        (b"PK\x03\x04\n", "a workbook of a spreadsheet or an archive; save its table as CSV"),
        (b'{"kind": "estimate",\n', "JSON"),
    ],
)
def test_a_file_of_another_format_is_named(tmp_path: Path, beginning: bytes, what: str) -> None:
    (tmp_path / "a.csv").write_bytes(beginning + bytes(range(256)))
    with pytest.raises(FileFormatError, match=re.escape(f"a.csv is no table but {what}")):
        read_table(tmp_path / "a.csv")
