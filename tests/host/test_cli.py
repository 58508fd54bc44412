"""The commands of daily use, as they are typed."""

from __future__ import annotations

import dataclasses
import json
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from linkpose.cli import COMMANDS
from linkpose.cli.characters import replacement
from linkpose.device import ports
from linkpose.device.ports import PortInfo
from linkpose.recording.table import read_table
from linkpose.sensors.rig import Joint, Rig
from linkpose.simulation.link import LinkRun

HOST = Path(__file__).parents[2] / "host"
SIM = "sim://link?speed=0"  # as fast as it goes


def rows(path: Path) -> list[str]:
    return [line for line in path.read_text().splitlines() if not line.startswith("#")]


def test_live_and_replay_agree_to_the_last_digit(linkpose, tmp_path):
    live, recording, replay = tmp_path / "live.csv", tmp_path / "rec.csv", tmp_path / "replay.csv"
    done = linkpose("estimate", "--live", "--port", SIM, "--duration", 20, "-o", live, "--record", recording)
    assert done.status == 0, done.err
    assert linkpose("estimate", recording, "-o", replay).status == 0
    assert len(rows(live)) == 2001
    assert rows(live) == rows(replay)
    names = read_table(live, "estimate").columns
    for name in ("joint", "tilt", "imu_baro"):
        assert {f"{name}_height_m", f"{name}_height_std_m", f"{name}_roll_deg", f"{name}_pitch_deg"} <= names.keys()
    assert "baro_height_m" in names


def test_json_estimates_have_the_csvs_keys_and_end_with_the_summary(linkpose, tmp_path):
    out = tmp_path / "live.csv"
    done = linkpose("estimate", "--live", "--port", SIM, "--duration", 1, "-o", out, "--json")
    *estimates, summary = map(json.loads, done.out.splitlines())
    assert summary["event"] == "summary"
    assert summary.keys() >= {"event", "samples", "lost", "corrupt", "gaps", "duration_s", "rate_hz", "sensors"}
    header, *lines = rows(out)
    assert [list(estimate) for estimate in estimates] == [header.split(",")] * 100
    for estimate, line in zip(estimates, lines, strict=True):
        assert list(estimate.values()) == [float(word) if word else None for word in line.split(",")]


def test_without_o_the_estimates_go_to_stdout(linkpose, tmp_path):
    recording = tmp_path / "r.csv"
    linkpose("record", recording, "--port", SIM, "--duration", 1)
    done = linkpose("estimate", recording)
    assert done.out.startswith("# linkpose estimate 1\n# {")
    assert len(done.out.splitlines()) == 104
    assert json.loads(done.out.splitlines()[-1].removeprefix("# "))["rows"] == 100
    assert linkpose("estimate", recording, "--plain").out.count("\n") == 101


def test_a_filter_that_cannot_run_is_named_with_its_reason(linkpose, refused, tmp_path):
    recording = tmp_path / "r.csv"
    linkpose("record", recording, "--port", SIM, "--duration", 1)
    lines = recording.read_text().splitlines(keepends=True)
    lines[1] = re.sub(r'"joint": \{.*?\}, ', "", lines[1])
    recording.write_text("".join(lines))
    done = linkpose("estimate", recording, "-o", tmp_path / "e.csv")
    assert done.status == 0
    assert "joint-inertial needs J2S" in done.err and "--j2s X,Y,Z" in done.err
    names = read_table(tmp_path / "e.csv", "estimate").columns
    assert "tilt_roll_deg" in names and "joint_height_m" not in names
    assert "the filter joint cannot run" in refused("estimate", recording, "--filter", "joint")
    assert linkpose("estimate", recording, "--filter", "joint", "--j2s", "0,0,1", "-q").status == 0
    assert "there is no filter 'jonit'" in refused("estimate", recording, "--filter", "jonit")


def test_the_rig_files_j2s_is_used_and_a_wrong_key_is_named(linkpose, refused, tmp_path):
    recording, rig = tmp_path / "r.csv", tmp_path / "rig.toml"
    linkpose("record", recording, "--port", SIM, "--duration", 1)
    heights = []
    for text in ("[joint]\nj2s_m = [-0.09, -0.04, 1.65]\n", "[joint]\nj2s_m = [0.0, 0.0, 0.5]\n"):
        rig.write_text(text)
        linkpose("estimate", recording, "--rig", rig, "-o", tmp_path / "e.csv", "--force")
        heights.append(read_table(tmp_path / "e.csv").columns["joint_height_m"][-1])
    assert heights[0] > 1.5 and 0.4 < heights[1] < 0.5
    for text, sentence in (
        ("[joint]\nj2s = [0, 0, 1]\n", "unknown key joint.j2s; did you mean j2s_m?"),
        ("[jonit]\n", "unknown key jonit; did you mean joint?"),
        ("[joint]\nj2s_m = [0, 0]\n", "must be three numbers"),
        ("[joint]\nj2s_m = [0, 0, nan]\n", "must be a number"),
        ("[imu]\ngyro_noise_rad_s = 0\n", "must be above 0"),
        ("[imu]\naccel_scale = [1, 1, -1]\n", "each axis must be above 0"),
        ("[[mouse]]\nx_m = 1\n", "lacks y_m"),
        ("joint = 3\n", "joint must be a table"),
        ("j2s_m = [", "is not a rig file"),
    ):
        rig.write_text(text)
        output = refused("estimate", recording, "--rig", rig)
        assert sentence in output and "rig.toml" in output


def test_estimates_do_not_replace_their_recording(linkpose, refused, tmp_path):
    recording = tmp_path / "r.csv"
    linkpose("record", recording, "--port", SIM, "--duration", 0.2)
    before = recording.read_bytes()
    output = refused("estimate", recording, "-o", recording, "--force")
    assert "is the recording that is read; name another file for the estimates" in output
    assert recording.read_bytes() == before


@pytest.mark.parametrize(
    ("j2s", "sentence"),
    [("1e9,0,0", "longer than 10 m"), ("0,900,40", "is in metres"), ("0,0,inf", "not finite"), ("1,2", "not three")],
)
def test_a_j2s_that_no_link_has_is_refused(refused, tmp_path, j2s, sentence):
    assert sentence in refused("estimate", tmp_path / "r.csv", "--j2s", j2s)


def closing_line(path: Path) -> dict:
    return json.loads(path.read_text().splitlines()[-1].removeprefix("# "))


def test_j2s_auto_is_estimated_and_told_live_and_over_the_recording(linkpose, refused, tmp_path):
    live, recording, replay = tmp_path / "live.csv", tmp_path / "rec.csv", tmp_path / "replay.csv"
    done = linkpose(
        "estimate", "--live", "--port", SIM, "--duration", 30, "--j2s", "auto", "-o", live, "--record", recording, "-v"
    )
    assert done.status == 0
    assert "not running: joint: joint needs a J2S that is known" in done.err
    found = closing_line(live)
    assert found["j2s_m"] == pytest.approx([-0.09, -0.04, 1.65], abs=0.01)
    assert all(0 < std < 0.01 for std in found["j2s_std_m"])
    x, y, z = found["j2s_m"]
    assert re.search(rf"J2S {x:.4f} ± 0\.\d{{4}}, {y:.4f} ± 0\.\d{{4}}, {z:.4f} ± 0\.\d{{4}} m\n", done.err)
    assert linkpose("estimate", recording, "-o", replay, "--j2s", "auto").status == 0
    assert rows(live) == rows(replay) and closing_line(replay)["j2s_m"] == found["j2s_m"]
    assert "joint needs a J2S that is known" in refused("estimate", recording, "--j2s", "auto", "--filter", "joint")
    assert "add --filter joint-inertial" in refused("estimate", recording, "--j2s", "auto", "--filter", "tilt")


def test_a_j2s_that_is_known_to_millimetres_is_refined(linkpose, refused, tmp_path):
    """A ruler's error of 5 mm goes into the height, unless --j2s-std allows for it."""
    recording, truth, out = tmp_path / "r.csv", tmp_path / "truth.csv", tmp_path / "e.csv"
    link = ["link", "--j2s", "0.0,-0.05,0.6", "--duration", 30]
    linkpose("simulate", *link, "-o", recording, "--truth", truth)

    def error_m(*j2s: object) -> float:
        estimate = ["estimate", recording, *j2s, "--filter", "joint-inertial", "-o", out, "--force"]
        assert linkpose(*estimate).status == 0
        difference = read_table(out).columns["joint_inertial_height_m"] - read_table(truth).columns["height_m"]
        return float(np.sqrt(np.mean(difference[1000:] ** 2)))

    measured = ["--j2s", "0.0,-0.05,0.605"]
    assert error_m(*measured) == pytest.approx(0.005, rel=0.4)
    assert error_m(*measured, "--j2s-std", 0.005) < 0.001
    assert "joint needs a J2S that is known" in refused(
        "estimate", recording, *measured, "--j2s-std", 0.2, "--filter", "joint"
    )
    for wrong in ([*measured, "--j2s-std", 0], [*measured, "--j2s-std", -0.01], [*measured, "--j2s-std", "nan"]):
        assert linkpose("estimate", recording, *wrong).status == 2
    for wrong in (["--j2s-std", 0.01], ["--j2s", "auto", "--j2s-std", 0.01]):
        assert "add --j2s X,Y,Z" in refused("estimate", recording, *wrong)


def test_a_motion_that_does_not_tell_j2s_is_said(linkpose, tmp_path):
    out = tmp_path / "rest.csv"
    done = linkpose("estimate", "--live", "--port", SIM, "--duration", 1.5, "--j2s", "auto", "-o", out)
    assert done.status == 0
    assert re.search(r"The motion does not determine J2S along the sensor's [xyz] axis \(1σ is 1.00 m\)", done.err)
    assert closing_line(out)["j2s_std_m"] == pytest.approx([1, 1, 1], abs=0.05)
    known = linkpose("estimate", "--live", "--port", SIM, "--duration", 1.5, "-o", out, "--force")
    assert "does not determine" not in known.err and "j2s_m" not in closing_line(out)


def test_smooth_is_better_than_the_filter_with_the_same_columns(linkpose, tmp_path):
    recording, truth = tmp_path / "r.csv", tmp_path / "t.csv"
    squares = np.zeros(2)
    for seed in range(3):  # one run alone can favour the filter
        simulated = ("--test", 2, "--seed", seed, "--duration", 20, "-o", recording, "--truth", truth, "--force")
        linkpose("simulate", "link", *simulated)
        height = read_table(truth).columns["height_m"]
        found = {}
        for mode in ((), ("--smooth",)):
            out = tmp_path / f"e{seed}{len(mode)}.csv"
            done = linkpose("estimate", recording, "-o", out, "--filter", "joint-inertial", "--filter", "tilt", *mode)
            assert done.status == 0, done.err
            found[mode] = read_table(out, "estimate").columns
        filtered, smoothed = found.values()
        assert list(filtered) == list(smoothed)
        assert list(filtered["tilt_roll_deg"]) == list(smoothed["tilt_roll_deg"])
        squares += [((columns["joint_inertial_height_m"] - height) ** 2).mean() for columns in (filtered, smoothed)]
    assert squares[1] < 0.6 * squares[0]


def test_smooth_without_joint_inertial_is_wrong_usage(linkpose, tmp_path):
    recording = tmp_path / "r.csv"
    linkpose("record", recording, "--port", SIM, "--duration", 1)
    done = linkpose("estimate", recording, "--smooth", "--filter", "tilt")
    assert done.status == 2 and "no filter that can be smoothed (joint-inertial, chain) runs" in done.err
    recording.write_text(re.sub(r'"joint": \{.*?\}, ', "", recording.read_text()))
    done = linkpose("estimate", recording, "--smooth", "-o", tmp_path / "e.csv")
    assert done.status == 2 and "joint-inertial needs J2S" in done.err
    assert not (tmp_path / "e.csv").exists()


@pytest.mark.parametrize(
    "arguments",
    [
        "estimate",
        "estimate --live x.csv",
        "estimate x.csv --port sim://link",
        "estimate --live --port sim://link --j2s 1,2",
        "estimate --live --port sim://link --j2s a,b,c",
        "estimate --live --port sim://link --smooth",
        "record --port sim://link --duration -1",
        "record --port sim://link --duration never",
        "record --nonsense",
        "nonsense",
    ],
)
def test_wrong_usage_has_status_2(linkpose, arguments):
    done = linkpose(*arguments.split())
    assert done.status == 2
    assert "Error: " in done.err and "Traceback" not in done.err


def test_every_command_has_help(linkpose):
    listing = linkpose("--help").out
    for name in COMMANDS:
        assert name in listing
        shown = linkpose(name, "--help").out
        assert shown.startswith(f"Usage: linkpose {name}")
        assert "?" not in replacement("".join(char for char in shown if not char.isascii()))  # on a code page
    assert linkpose("--version").out.strip().startswith("linkpose, version")


def test_nothing_heavy_is_imported_for_help_ports_info_and_record():
    code = (
        "import sys; import linkpose.cli; from linkpose.cli import COMMANDS\n"
        "import linkpose.cli.ports, linkpose.cli.info, linkpose.cli.record, linkpose.cli.live\n"
        "import linkpose.device.ports, linkpose.recording.csvfile\n"
        "print([m for m in ('numpy', 'numba', 'scipy', 'matplotlib', 'rich') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=HOST)
    assert done.stdout.strip() == "[]"


def test_the_boards_settings_are_put_in_force_and_recorded(linkpose, refused, tmp_path):
    out = tmp_path / "r.csv"
    typed = ["--rate", 200, "--accel-range", 16, "--gyro-range", 2000, "--dlpf", 2, "--baro-oversampling", 3]
    assert linkpose("record", out, "--port", SIM, "--duration", 2, *typed).status == 0
    table = read_table(out, "recording")
    assert len(table) == 400
    assert table.metadata["settings"] == {
        "sample_rate_hz": 200, "accel_range_g": 16, "gyro_range_deg_s": 2000, "dlpf": 2, "baro_oversampling": 3,
    }  # fmt: skip
    lsb = 9.80665 * 16 / 32768
    counts = table.columns["accel_z_m_s2"] / lsb
    assert abs(counts - counts.round()).max() < 1e-3
    assert table.columns["accel_z_m_s2"][0] == pytest.approx(9.8, abs=0.5)
    done = linkpose("estimate", "--live", "--port", SIM, "--duration", 1, "--rate", 50, "-o", tmp_path / "e.csv")
    assert done.status == 0 and len(read_table(tmp_path / "e.csv")) == 50
    output = refused("record", "--port", SIM, "--rate", 77)
    assert "not a rate of the board" in output and "50, 64, 80, 100, 125" in output
    assert "--live" in refused("estimate", out, "--rate", 50)


def test_how_late_the_readings_are_follows_from_the_boards_setting(linkpose, monkeypatch, tmp_path):
    """Register map, 4.3: 13.8 ms at DLPF_CFG 5, and samples 0.5 ms old in the mean. Live, over the recording and over
    the raw bytes it is the same."""
    monkeypatch.setattr(LinkRun, "rig", property(lambda run: Rig(Joint(run.j2s_m))))  # as a real board: it names none
    live, recording, raw = tmp_path / "live.csv", tmp_path / "rec.csv", tmp_path / "rec.bin"
    typed = ["--live", "--port", SIM, "--duration", 5, "--dlpf", 5, "--filter", "tilt-inertial"]
    assert linkpose("estimate", *typed, "-o", live, "--record", recording, "--raw", raw).status == 0
    assert "delay_s" not in read_table(recording, "recording").metadata["rig"]["imu"]
    rig = tmp_path / "rig.toml"
    rig.write_text("[imu]\ndelay_s = 0.002\n")
    late = {}
    for name, source in (("csv", [recording]), ("raw", [raw]), ("named", [recording, "--rig", rig])):
        out = tmp_path / f"{name}.csv"
        assert linkpose("estimate", *source, "--filter", "tilt-inertial", "-o", out).status == 0
        late[name] = read_table(out, "estimate").metadata["rig"]["imu"]["delay_s"]
    assert read_table(live, "estimate").metadata["rig"]["imu"]["delay_s"] == pytest.approx(0.0143)
    assert late == pytest.approx({"csv": 0.0143, "raw": 0.0143, "named": 0.002})
    assert rows(live) == rows(tmp_path / "csv.csv") != rows(tmp_path / "named.csv")


def test_simulated_readings_are_not_late_whatever_the_rig_file(linkpose, tmp_path):
    recording, truth, rig, out = (tmp_path / name for name in ("r.csv", "t.csv", "rig.toml", "e.csv"))
    linkpose("simulate", "link", "--duration", 5, "-o", recording, "--truth", truth)
    rig.write_text("[joint]\nj2s_m = [-0.09, -0.04, 1.65]\n")
    assert linkpose("estimate", recording, "--rig", rig, "-o", out).status == 0
    assert read_table(out, "estimate").metadata["rig"]["imu"]["delay_s"] == 0.0


def test_info_json(linkpose):
    done = linkpose("info", "--port", "sim://link?drift_ppm=0", "--json")
    info = json.loads(done.out)
    assert done.status == 0
    assert info["sensors"] == ["mpu6050", "bmp180"]
    assert info["sample_rate_hz"] == 100 and info["mice"] == []
    assert info["samples_lost"] == info["frames_corrupt"] == 0
    assert {"protocol", "firmware", "clock_drift_ppm"} <= info.keys()
    assert info["board"]["stack_free_bytes"] is info["board"]["vcc_mv"] is None, "a simulated board has no processor"


def test_info_of_a_recording_names_chips_and_units(linkpose, tmp_path):
    recording = tmp_path / "r.csv"
    linkpose("record", recording, "--port", "sim://link?speed=0", "--duration", 3, "-q")
    shown = linkpose("info", recording).out.splitlines()
    assert "barometer            BMP180" in shown
    assert "noise at rest        2.0 s" in shown and shown[shown.index("noise at rest        2.0 s") + 1].endswith(
        " m/s²"
    )


UNO = PortInfo("/dev/ttyACM0", "Arduino Uno", 0x2341, 0x0043, "55", True, False)
OTHER = PortInfo("/dev/ttyS0", "", None, None, None, False, None)


@pytest.mark.parametrize(
    ("found", "sentence"),
    [
        ([], "no serial port is connected"),
        ([OTHER], "no UNO is connected; the ports are: /dev/ttyS0"),
        ([UNO, OTHER, dataclasses.replace(UNO, port="/dev/ttyACM1")], "2 boards are connected: /dev/ttyACM0"),
        ([OTHER, UNO], "there is no port /dev/ttyACM0"),  # chosen, and then not there in this test
    ],
)
def test_the_only_uno_is_chosen_and_none_or_several_are_listed(monkeypatch, refused, found, sentence):
    monkeypatch.setattr(ports, "find_ports", lambda: found)
    assert sentence in refused("info")


def test_the_environment_may_name_the_port(monkeypatch, linkpose):
    monkeypatch.setenv("LINKPOSE_PORT", "sim://link?seed=3")
    assert json.loads(linkpose("info", "--json").out)["protocol"]


def test_ports_json(monkeypatch, linkpose):
    monkeypatch.setattr(ports, "find_ports", lambda: [UNO, OTHER])
    listed = [json.loads(line) for line in linkpose("ports", "--json").out.splitlines()]
    assert [list(port) for port in listed] == [
        ["port", "description", "vid", "pid", "serial", "is_uno", "busy", "location", "chip"]
    ] * 2
    assert listed[0]["is_uno"] and not listed[1]["is_uno"]
    assert "UNO" in linkpose("ports").out


def test_a_mistyped_name_is_answered_with_the_nearest(refused):
    assert "Did you mean estimate?" in refused("estimat")
    assert "did you mean joint-inertial?" in refused("estimate", "--live", "--port", SIM, "--filter", "joint-inertal")


def test_a_person_reads_one_device_a_line_with_units(linkpose):
    lines = linkpose("info", "--port", SIM).out.splitlines()
    assert any(line.split() == ["sample", "rate", "100", "Hz"] for line in lines)
    assert any("MPU-6050 at 0x68 (id 0x68): ok" in line for line in lines)
    assert not any("0x69" in line for line in lines)
    assert any(line.split() == ["source", "revision", "none", "(simulated", "board)"] for line in lines)


def test_a_slower_bus_is_put_in_force(linkpose, tmp_path):
    assert linkpose("record", tmp_path / "r.csv", "--port", SIM, "--duration", 0.2, "--i2c", 100).status == 0
    assert len(read_table(tmp_path / "r.csv", "recording")) == 20


def test_ctrl_c_while_modules_are_imported_ends_without_a_traceback():
    """A finder of modules sends the signal when the first one of the command line is imported."""
    code = """
import os, signal, sys
from linkpose.__main__ import main

class Presses:
    def find_spec(self, name, *_):
        if name.startswith("linkpose.cli"):
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Presses())
main()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, "", "")


def test_a_wrong_address_of_a_live_output_names_the_option(linkpose):
    done = linkpose("estimate", "--live", "--port", "sim://link", "--duration", 1, "--to", "127.0.0.1:9870")
    assert done.status == 2 and "--to is '127.0.0.1:9870'; it must be udp://HOST:PORT" in done.err
