"""simulate: all outputs are checked before one is written, and what does not fit is refused."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

import linkpose as lp
from linkpose.cli import options
from linkpose.sensors.rig import Chain

KINDS = {
    "link": ("--duration", 3),
    "chain": ("--duration", 3),
    "mice": ("--duration", 3),
    "indoor": ("--duration", 5),
    "underwater": ("--duration", 5),
}


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_is_written_where_one_output_exists(kind, refused, tmp_path):
    (tmp_path / "truth.csv").write_text("mine")
    sentence = refused("simulate", kind, "-o", tmp_path / "out.csv", "--truth", tmp_path / "truth.csv", *KINDS[kind])
    assert "truth.csv exists already" in sentence and "--force" in sentence
    assert [path.name for path in tmp_path.iterdir()] == ["truth.csv"]


@pytest.mark.parametrize("kind", KINDS)
def test_two_outputs_of_one_name_are_refused(kind, refused, tmp_path):
    sentence = refused("simulate", kind, "-o", tmp_path / "x.csv", "--truth", tmp_path / "x.csv", *KINDS[kind])
    assert "is named for two outputs" in sentence and not list(tmp_path.iterdir())


def test_a_folder_that_is_missing_is_named(refused, tmp_path):
    sentence = refused("simulate", "link", "-o", tmp_path / "no" / "r.csv", "--truth", tmp_path / "t.csv")
    assert "there is no folder" in sentence and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "command",
    [
        ("simulate", "link", "-o", "OUT.csv", "--truth", "t.csv"),
        ("estimate", "--live", "--port", "sim://link", "-o", "OUT.csv"),
        ("reproduce", "mice", "--seeds", 1, "--plot", "OUT.png"),
        ("plot", "r.csv", "-o", "OUT.png"),
        ("evaluate", "r.csv", "t.csv", "--plot", "OUT.png"),
    ],
    ids=lambda words: words[0],
)
def test_an_output_that_cannot_be_made_is_named_with_what_to_do(command, refused, tmp_path, monkeypatch):
    """A closed folder fails in the same way, except for the superuser."""
    monkeypatch.chdir(tmp_path)
    sentence = refused(*(str(word).replace("OUT", "x" * 300) for word in command))
    assert sentence.startswith("linkpose: cannot write xxx")
    assert sentence.endswith("File name too long; name a file in a folder you may write to")
    assert not list(tmp_path.iterdir())


def test_a_rig_file_that_cannot_be_made_is_named(linkpose, refused, tmp_path):
    recording = tmp_path / "r.csv"
    linkpose("simulate", "link", "-o", recording, "--truth", tmp_path / "t.csv", "--duration", 20)
    sentence = refused("calibrate", "joint", recording, "--rig", tmp_path / ("x" * 300))
    assert sentence.startswith("linkpose: cannot write the rig file") and "folder you may write to" in sentence


def test_a_log_on_the_standard_output_is_alone_there(linkpose, tmp_path, monkeypatch):
    """The statistics of the noise stood below its rows, and files beside it were called -.yaml and -_beacons.csv."""
    monkeypatch.chdir(tmp_path)
    done = linkpose("simulate", "underwater", "-o", "-", "--truth", "t.csv", "--duration", 5)
    assert "outlier_m" in done.err and "asked" not in done.out
    assert linkpose("simulate", "indoor", "-o", "-", "--truth", "it.csv", "--duration", 5).status == 0
    assert {path.name for path in tmp_path.iterdir()} == {"t.csv", "t_beacons.csv", "it.csv", "it.yaml", "it.pgm"}
    mixed = linkpose("simulate", "underwater", "-o", "-", "--truth", "u.csv", "--json")
    assert mixed.status == 2 and "leave out one of them" in mixed.err


def test_the_statistics_of_the_noise_stand_in_columns(linkpose, tmp_path):
    shown = linkpose("simulate", "underwater", "-o", tmp_path / "u.csv", "--truth", tmp_path / "t.csv", "--duration", 5)
    lines = shown.out.splitlines()
    assert lines[0].split() == ["check", "asked", "measured"] and len(lines) > 20
    assert {line[lines[0].index("asked") - 2 : lines[0].index("asked")] for line in lines} == {"  "}


@pytest.mark.parametrize("kind", ["link", "mice"])
def test_a_duration_that_does_not_fit_is_refused(kind, refused, tmp_path):
    sentence = refused("simulate", kind, "-o", tmp_path / "r", "--truth", tmp_path / "t", "--duration", "1e9")
    assert "10,000,000 is the limit: simulate at most 100000 s" in sentence and not list(tmp_path.iterdir())


@pytest.mark.parametrize("duration", ["0", "-3", "nan", "inf", "x"])
def test_a_duration_that_is_no_time_is_wrong_usage(duration, linkpose, tmp_path):
    done = linkpose("simulate", "link", "-o", tmp_path / "r", "--truth", tmp_path / "t", "--duration", duration)
    assert done.status == 2 and "Traceback" not in done.err


def test_what_to_type_next_is_said_unless_quiet(linkpose, tmp_path):
    typed = ("simulate", "link", "-o", tmp_path / "r.csv", "--truth", tmp_path / "t.csv", "--duration", 3)
    assert linkpose(*typed).err == f"next: linkpose estimate {tmp_path / 'r.csv'} -o estimate.csv\n"
    with_mag = linkpose(*typed, "--mag", "--force").err
    assert with_mag == f"next: linkpose estimate {tmp_path / 'r.csv'} --mag -o estimate.csv\n"
    uncalibrated = linkpose(*typed, "--mag", "--errors", "datasheet", "--force").err
    assert "--mag" not in uncalibrated  # estimate --mag would refuse it
    spaced = linkpose(*typed[:3], tmp_path / "left knee.csv", *typed[4:], "--force").err
    assert shlex.split(spaced.removeprefix("next: "))[2] == str(tmp_path / "left knee.csv")  # a shell reads one word
    assert linkpose(*typed, "--force", "-q") == (0, "", "")


def test_the_proposed_file_of_estimates_is_new(linkpose, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("estimate.csv").touch()
    Path("estimate-2.csv").touch()
    typed = ("simulate", "link", "-o", "r.csv", "--truth", "t.csv", "--duration", 3)
    assert linkpose(*typed).err == "next: linkpose estimate r.csv -o estimate-3.csv\n"


def test_a_recording_named_as_the_proposed_file_keeps_its_name(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("estimate.csv").touch()
    options.show_next(False, *options.estimate_command(Path("estimate.csv")))
    assert capsys.readouterr().err == "next: linkpose estimate estimate.csv -o estimate-2.csv\n"
    Path("estimate.png").touch()
    options.show_next(False, *options.plot_command(Path("estimate.csv")))
    assert capsys.readouterr().err == "next: linkpose plot estimate.csv -o estimate-2.png\n"


def test_the_truth_of_a_link_has_its_yaw_and_position(linkpose, tmp_path):
    linkpose("simulate", "link", "-o", tmp_path / "r.csv", "--truth", tmp_path / "t.csv", "--duration", 3, "-q")
    header = next(line for line in (tmp_path / "t.csv").read_text().splitlines() if not line.startswith("#"))
    assert header == "time_s,height_m,roll_deg,pitch_deg,x_m,y_m,yaw_deg"


def test_a_chain_has_two_sensors_its_truth_and_the_mounting_only_on_request(linkpose, tmp_path):
    names = ("-o", tmp_path / "r.csv", "--truth", tmp_path / "t.csv")
    typed = ("simulate", "chain", *names, "--duration", 3)
    assert linkpose(*typed).err == f"next: linkpose estimate {tmp_path / 'r.csv'} --filter chain -o estimate.csv\n"
    header = next(line for line in (tmp_path / "t.csv").read_text().splitlines() if not line.startswith("#"))
    assert header.endswith(",x_m,y_m,yaw_deg,qw,qx,qy,qz,angle_deg,height1_m,height2_m")
    recording = lp.load(tmp_path / "r.csv")
    assert recording.measurements.has_imu2 and recording.rig is not None
    assert (recording.rig.chain, (tmp_path / "rig.toml").exists()) == (Chain("hinge"), False)
    assert linkpose(*typed, "--joint", "ball", "--rig", tmp_path / "rig.toml", "--force", "-q") == (0, "", "")
    chain = lp.Rig.load(tmp_path / "rig.toml").chain
    assert (chain.joint, chain.axis1) == ("ball", None) and chain.r1_m and chain.r2_m
    assert "angle_deg" not in (tmp_path / "t.csv").read_text()
