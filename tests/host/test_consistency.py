"""What holds for all commands alike: options, wrong usage, nearest names, outputs, and text on any terminal."""

from __future__ import annotations

import io
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import click
import pytest
from rich.table import Table

from linkpose.cli import group
from linkpose.cli.rendering import show_table
from linkpose.device import ports
from linkpose.device.ports import PortInfo
from linkpose.plotting.canvas import FORMATS
from linkpose.presentation import counted

HOST = Path(__file__).parents[2] / "host"


def commands(of: click.Group = group, prefix: str = "") -> Iterator[tuple[str, click.Command]]:
    context = click.Context(of)
    for name in of.list_commands(context):
        command = of.get_command(context, name)
        assert command is not None
        if isinstance(command, click.Group):
            yield from commands(command, f"{prefix}{name} ")
        else:
            yield prefix + name, command


ALL = dict(commands())


def having(option: str) -> set[str]:
    return {name for name, command in ALL.items() if any(option in each.opts for each in command.params)}


# Each command and which of these options it has: -q wherever there is more than the result, -v where there are details,
# --json where the result has figures, --force where a file is written, --view where there is something that moves.
FLAGS = "-q -v --json --force --view --plot"
TABLE = """
    ports                       --json
    flash                -q -v
    info                 -q -v  --json
    record               -q -v  --json  --force  --view
    estimate             -q -v  --json  --force  --view
    calibrate imu        -q     --json
    calibrate joint      -q     --json
    calibrate chain      -q     --json
    calibrate mag        -q     --json  --force
    calibrate noise      -q     --json  --force
    calibrate mice       -q     --json
    convert              -q             --force
    evaluate             -q     --json  --force          --plot
    simulate link        -q             --force
    simulate chain       -q             --force
    simulate mice        -q             --force
    simulate indoor      -q             --force
    simulate underwater  -q     --json  --force
    reproduce link       -q     --json  --force          --plot
    reproduce mice       -q     --json  --force          --plot
    reproduce indoor     -q     --json  --force          --plot
    reproduce underwater -q     --json  --force          --plot
    plot                 -q             --force  --view
    localize             -q     --json  --force  --view  --plot
"""


def test_options_exist_wherever_they_make_sense() -> None:
    expected = {}
    for line in TABLE.strip().splitlines():
        words = line.split()
        expected[" ".join(word for word in words if word[0] != "-")] = {word for word in words if word[0] == "-"}
    assert {name: {flag for flag in FLAGS.split() if name in having(flag)} for name in ALL} == expected


@pytest.mark.parametrize("name", ALL)
def test_help_is_imperative_and_complete(name: str) -> None:
    command = ALL[name]
    for option in command.params:
        if isinstance(option, click.Option) and option.name != "help":
            assert option.help and not re.match("[a-z]", option.help) and option.help.endswith((".", "]")), option.opts
    assert (command.help or "").strip().endswith(".")


def test_filters_and_ports_are_completed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ports, "find_ports", lambda: [PortInfo("/dev/ttyACM0", "", 1, 1, "", True, False)])
    for option, typed, expected in (
        ("--filter", "joint", ["joint-inertial", "joint"]),
        ("--filter", "joint_", ["joint-inertial"]),
        ("--port", "/dev/ttyA", ["/dev/ttyACM0"]),
        ("--port", "sim", ["sim://link", "sim://chain", "sim://mice"]),
    ):
        for name in having(option) - {"localize"}:
            command = ALL[name]
            parameter = next(each for each in command.params if option in each.opts)
            found = [item.value for item in parameter.shell_complete(click.Context(command), typed)]
            assert found == expected, (name, option)


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
def test_bash_completes_an_address_with_a_colon(tmp_path: Path) -> None:
    """Bash breaks words at colons: sim://ch completed to nothing."""
    program = tmp_path / "linkpose"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m linkpose "$@"\n')
    program.chmod(0o755)
    script = (
        'eval "$(_LINKPOSE_COMPLETE=bash_source linkpose)"; COMP_LINE="linkpose record --port sim://ch x"; '
        'COMP_POINT=$((${#COMP_LINE} - 2)); _linkpose_completion linkpose; echo "${COMPREPLY[@]}"'
    )
    environment = os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}", "PYTHONPATH": str(HOST)}
    found = subprocess.run(["bash", "-c", script], env=environment, capture_output=True, text=True, check=True)
    assert found.stdout == "//chain\n", found.stderr


@pytest.mark.parametrize(
    ("typed", "sentence"),
    [
        ("estimat", "Did you mean estimate?"),
        ("calibrate jont", "Did you mean joint?"),
        ("simulate lnk", "Did you mean link?"),
        ("reproduce indor", "Did you mean indoor?"),
        ("estimate r.csv --live", "leave out r.csv, or leave out --live"),
        ("estimate", "name a RECORDING, or add --live"),
        ("estimate --live --port sim://link?speed=0 --filter joint-inertal", "did you mean joint-inertial?"),
        ("estimate --live --port sim://link?speed=0 --filter JOINT", "did you mean joint?"),
        ("info --port sim://lnk", "did you mean sim://link?"),
        ("record --port sim://link --rate 333", "choose from 50, 64, 80, 100, 125, 128, 160, 200, 250"),
        ("record --port sim://link --duration 0", "not a number of seconds above 0"),
        ("record --view-port 9000", "go with --view"),
        ("plot e.csv -o e.bmp", "its name must end in .png"),
        ("reproduce link --plot e.bmp", "its name must end in .png"),
        ("reproduce link --plot e.html", "`linkpose plot ESTIMATE.csv -o FILE.html` plays an estimate"),
        ("evaluate e.csv t.csv --plot -", "name a file for the picture"),
        ("localize l.csv --beacons b.csv --plot -", "name a file for the picture"),
        ("reproduce indoor --plot -", "name a file for the picture"),
        ("simulate link -o r --truth r", "r is named for two outputs"),
        ("estimate r.csv -o r.csv", "r.csv is the recording that is read"),
        ("convert e.csv -o e.bmp", "none of the endings"),
        ("estimate r.csv -o - --json", "leave out one of them"),
        ("record - --json", "leave out one of them"),
    ],
)
def test_wrong_usage_has_status_2_and_one_sentence(linkpose, typed: str, sentence: str) -> None:
    done = linkpose(*typed.split())
    assert done.status == 2, done
    assert sentence in done.err and "Traceback" not in done.err and done.out == ""


def test_a_mistyped_port_is_answered_with_the_nearest(
    monkeypatch: pytest.MonkeyPatch, refused: Callable[..., str]
) -> None:
    monkeypatch.setattr(ports, "find_ports", lambda: [PortInfo("/dev/ttyACM0", "", 1, 1, "", True, False)])
    assert "did you mean /dev/ttyACM0?" in refused("info", "--port", "/dev/ttyACN0")
    assert "did you mean sim://link?" in refused("info", "--port", "sim:/link")
    near = refused("info", "--port", "sim://lnk")
    assert near.count("sim://lnk") == 1 and near.endswith("did you mean sim://link?")
    assert refused("info", "--port", "sim://rat").endswith("type sim://link, sim://chain, sim://mice")


@pytest.mark.parametrize(
    ("command", "outputs"),
    [
        ("simulate link", ("-o", "--truth")),
        ("simulate mice", ("-o", "--truth")),
        ("simulate chain", ("-o", "--truth", "--rig")),
        ("simulate indoor", ("-o", "--truth", "--map")),
        ("simulate underwater", ("-o", "--truth", "--beacons")),
    ],
)
def test_all_outputs_are_checked_before_one_is_written(
    refused: Callable[..., str], tmp_path: Path, command: str, outputs: tuple[str, ...]
) -> None:
    last = tmp_path / "2.csv"
    last.write_text("kept")
    typed = [word for at, option in enumerate(outputs) for word in (option, tmp_path / f"{at + 3 - len(outputs)}.csv")]
    assert "2.csv exists already" in refused(*command.split(), *typed)
    assert list(tmp_path.iterdir()) == [last] and last.read_text() == "kept"


@pytest.mark.parametrize(
    "command",
    [
        "estimate {recording} -o {output}",
        "estimate --live --port sim://link -o {output}",
        "estimate --live --port sim://link --record {output}",
        "localize {recording} --beacons {recording} -o {output}",
    ],
)
@pytest.mark.parametrize(("output", "why"), [("kept.csv", "exists already"), ("none/e.csv", "there is no folder")])
def test_an_output_is_checked_before_the_work(
    refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, command: str, output: str, why: str
) -> None:
    """Filters were compiled, and a log was localized, before the sentence came."""

    def work(*_: object, **__: object) -> None:
        raise AssertionError("the work began")

    for name in ("linkpose.recording.reader.RecordingFile", "linkpose.localization.paths.prepare"):
        monkeypatch.setattr(name, work)
    monkeypatch.setattr("linkpose.board.open_session", work)
    (tmp_path / "kept.csv").write_text("kept")
    named = {"recording": tmp_path / "r.csv", "output": tmp_path / output}
    assert why in refused(*(word.format(**named) for word in command.split()))
    assert (tmp_path / "kept.csv").read_text() == "kept"


def test_a_table_is_not_cut_where_it_is_piped(capsys: pytest.CaptureFixture[str]) -> None:
    table = Table("filter", *(f"error {at}" for at in range(9)))
    table.add_row("planar-ekf", *["-0.000275"] * 9)
    show_table(table)
    assert capsys.readouterr().out.count("-0.000275") == 9


def test_numbers_and_nouns_agree() -> None:
    assert [counted(number, "gap") for number in (0, 1, 2)] == ["0 gaps", "1 gap", "2 gaps"]


def run(*command: object, **environment: str) -> subprocess.CompletedProcess[bytes]:
    everything = {**os.environ, "PYTHONPATH": str(HOST), **environment}
    return subprocess.run([sys.executable, "-m", "linkpose", *map(str, command)], capture_output=True, env=everything)


def test_a_dash_is_the_standard_output(tmp_path: Path) -> None:
    """The bytes are those of the file of the same command, and no file named - appears."""
    recording, estimate = tmp_path / "r.csv", tmp_path / "e.csv"
    link = ["simulate", "link", "--duration", 1]
    assert run(*link, "-o", recording, "--truth", tmp_path / "t.csv").returncode == 0
    piped = run(*link, "-o", "-", "--truth", tmp_path / "t2.csv")
    rows = [line for line in recording.read_bytes().splitlines() if not line.startswith(b"#")]
    assert [line for line in piped.stdout.splitlines() if not line.startswith(b"#")] == rows
    assert piped.stderr == b""  # there is nothing to type next
    typed = ["estimate", recording, "--filter", "baro", "-q", "-o"]
    assert run(*typed, estimate).returncode == 0
    assert run(*typed, "-").stdout == estimate.read_bytes()
    live = run("record", "-", "--port", "sim://link?speed=0", "--duration", 0.2, "--plain")
    assert len(live.stdout.splitlines()) == 21 and live.stdout.startswith(b"time_s,")
    picture = run("plot", recording, "-o", "-")
    assert picture.stdout.startswith(b"\x89PNG") and picture.stderr == b""
    assert not Path("-").exists() and {path.name for path in tmp_path.iterdir()} == {
        "r.csv", "t.csv", "t2.csv", "e.csv",
    }  # fmt: skip


@pytest.mark.parametrize("encoding", ["cp1252", "cp437", "cp949", "ascii"])
def test_a_terminal_without_greek_letters_gets_a_replacement(encoding: str) -> None:
    done = run("evaluate", "--help", PYTHONIOENCODING=encoding)
    assert done.returncode == 0 and b"Traceback" not in done.stderr
    assert b"has a standard deviation sd," in b" ".join(done.stdout.split()) or "σ".encode(encoding, "replace") != b"?"
    assert b"?" not in done.stdout and done.stdout.decode(encoding)
    refused = run("estimate", "σ.csv", "--j2s", "σ", PYTHONIOENCODING=encoding)
    assert refused.returncode == 2 and b"Traceback" not in refused.stderr and refused.stderr.decode(encoding)


def test_a_table_keeps_its_columns_on_any_code_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """σ became "s", which reads as seconds, and longer replacements shifted the cells beside them."""
    shown = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", shown)
    table = Table("error of", "in ±2σ", "worst")
    table.add_row("roll (°)", "96 %", "0.1")
    show_table(table)
    shown.flush()
    head, row = (line for line in shown.buffer.getvalue().decode().splitlines() if line.count("|") == 4)
    assert "in +/-2sd" in head and "roll (deg)" in row
    assert [at for at, char in enumerate(head) if char == "|"] == [at for at, char in enumerate(row) if char == "|"]


def test_every_picture_format_is_in_the_help(linkpose) -> None:
    for name in ("plot", "evaluate", "reproduce link"):
        text = linkpose(*name.split(), "--help").out.lower()
        assert all(ending.removeprefix(".") in text for ending in FORMATS), name


@pytest.mark.parametrize(("command", "option"), [("estimate", "--j2s"), ("localize", "--start")])
def test_a_vector_typed_as_several_words_is_proposed_as_one(command: str, option: str, refused) -> None:
    """click reads a negative number as an option: "No such option '-0'"."""
    sentence = refused(command, "a.csv", option, "-0.09", "-0.04,", "1.65")
    assert sentence.endswith(f"{option} takes its three numbers without spaces: type {option}=-0.09,-0.04,1.65")
