"""Each remark with a result in the documentation is produced or asserted by a test, and each of the sources is there."""

# ruff: noqa: E501  (a remark stands in one line)
from __future__ import annotations

import ast
import functools
import importlib
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from message_producers import trc_take
from scipy.spatial.transform import Rotation
from test_calibrate_mag import save, tumbled
from test_calibration_chain import one_link_in_motion
from test_calibration_link import SIX_SIDES, saved, turned_over
from test_messages import PACKAGE, PAGE, check_asserted, name_of, pattern, text_of
from test_nonsense import NAMES, put, remarks

import linkpose as lp
from linkpose.cli.findings import report_findings
from linkpose.cli.localize import _sentence as localize_sentence
from linkpose.cli.page import PageOptions
from linkpose.cli.sink import Sink
from linkpose.evaluation.references import read_any
from linkpose.evaluation.scores import evaluate
from linkpose.localization.consistency import Consistency, Verdict
from linkpose.localization.logs import read_log
from linkpose.recording.reader import RecordingFile, load_recording
from linkpose.recording.table import read_table
from linkpose.sensors.devices import describe
from linkpose.sensors.rig import Rig
from linkpose.simulation import board
from linkpose.simulation.chain import ChainRun
from linkpose.simulation.link import LinkRun
from linkpose.wire.frames import encode
from linkpose.wire.messages import DeviceFamily, DeviceKind, DeviceState, HelloDevice

Run = Callable[..., Any]  # `linkpose ARGUMENTS...`, as the fixture gives it
Producer = Callable[[Path, Run], str]
PLAIN = "time_s,accel_x_m_s2,accel_y_m_s2,accel_z_m_s2,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s\n"
T = np.arange(400) / 20
ROWS = "".join(f"{k / 100},0,{k % 2},9.8,0,{k % 3},0\n" for k in range(60))


def loaded(text: str | bytes, name: str = "r.csv") -> Producer:
    """The remarks on a recording with this content."""

    def run(folder: Path, _: Run) -> str:
        (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())
        return "\n".join(load_recording(folder / name).remarks)

    return run


def changed(*changes: Callable[[dict[str, np.ndarray]], object]) -> Producer:
    """The remarks on a swinging link's recording whose columns are changed."""

    def run(folder: Path, _: Run) -> str:
        return remarks(folder, lambda table: [change(table) for change in changes])

    return run


def flickering(table: dict[str, np.ndarray]) -> None:
    """A loose contact: 0.3 s with, 0.3 s without readings."""
    for start in range(0, 600, 60):
        table["accel_x_m_s2"][start : start + 30] = np.nan


def capture(spoil: Callable[[list[bytes]], object], jump_us: int = 0) -> bytes:
    samples = list(LinkRun(duration_s=2.0).samples())
    frames = [encode(s._replace(t_us=(s.t_us + jump_us * (k > 100)) % 2**32)) for k, s in enumerate(samples)]
    spoil(frames)
    return encode(board.hello(board.DEFAULTS)) + b"".join(frames)


def damage(frames: list[bytes]) -> None:
    frames[50] = frames[50][:-3] + b"\1\1\0"


def leave_out(frames: list[bytes]) -> None:
    del frames[50:60]


def negated(folder: Path, linkpose: Run) -> str:
    """A link with a known J2S whose accelerometer has the other sign."""
    linkpose("simulate", "link", "-o", folder / "r.csv", "--truth", folder / "t.csv", "--test", 3, "--duration", 10)
    lines = (folder / "r.csv").read_text().splitlines()
    for at, line in enumerate(lines):
        if line[0].isdigit():
            cells = line.split(",")
            lines[at] = ",".join([*cells[:2], *(str(-float(cell)) for cell in cells[2:5]), *cells[5:]])
    (folder / "r.csv").write_text("\n".join(lines) + "\n")
    file = RecordingFile(folder / "r.csv")
    return "\n".join(file.contradictions(file.rig))


def device(state: DeviceState, family: DeviceFamily = DeviceFamily.MPU6050) -> Producer:
    found = HelloDevice(kind=DeviceKind.IMU, address=0x68, id=0x72, family=family, state=state)
    return lambda *_: describe(found).remark


def reported(**facts: Any) -> Producer:
    """What `estimate` reports of these facts; the tests of the filters check how they are found."""
    excluded = SimpleNamespace(total_s={}, first_s={}, now=set())
    none = {"found_j2s": None, "excluded": excluded, "mouse_causes": {}, "gyro_jumps": None, "moved_mice": (),
            "mice_remarks": [], "mice_scale": None, "rig": SimpleNamespace(mouse=()), "magnetic_field": None, "remarks": []}  # fmt: skip

    def run(*_: object) -> str:
        lines: list[str] = []
        report_findings(SimpleNamespace(**none | facts), SimpleNamespace(report=lines.append))  # type: ignore[arg-type]
        return "\n".join(lines)

    return run


def away(*mice: int) -> dict[str, Any]:
    """Facts on two mice of which these were left out for 9 s."""
    names = [f"mouse{mouse}" for mouse in mice]
    excluded = SimpleNamespace(total_s=dict.fromkeys(names, 9.0), first_s=dict.fromkeys(names, 1.0), now=set(names))
    return {"excluded": excluded, "rig": SimpleNamespace(mouse=(1, 2))}


def imu_calibration(saturated: bool) -> Producer:
    """`calibrate imu` from one side, or from six of which one is beyond the sensor's range."""

    def run(folder: Path, linkpose: Run) -> str:
        block = turned_over(SIX_SIDES if saturated else SIX_SIDES[:1]).measurements
        if saturated:
            block.flags[: len(block) // 6] |= 2
        text = Path(saved(folder / "r.csv", block)).read_text().splitlines()
        text[2] += ",flags"
        flags = iter(block.flags)
        text[3:-1] = [f"{line},{next(flags)}" for line in text[3:-1]]
        (folder / "r.csv").write_text("\n".join(text) + "\n")
        return linkpose("calibrate", "imu", folder / "r.csv", "--rig", folder / "rig.toml").err

    return run


def calibrated(command: str, **changes: Any) -> Producer:
    """A calibration with such a result; the tests of the calibrations check how it is found."""

    def run(folder: Path, linkpose: Run) -> str:
        block = tumbled(40.0)
        save(block, folder / "r.csv")
        if command != "mag":
            kind = "chain" if command == "chain" else "link"
            linkpose("simulate", kind, "-o", folder / "r.csv", "--truth", folder / "t.csv", "--duration", 20, "--force")
        module = importlib.import_module(f"linkpose.calibration.{command}")
        with pytest.MonkeyPatch.context() as patch:
            find = getattr(module, f"calibrate_{command}")
            patch.setattr(module, f"calibrate_{command}", lambda *given: replace(find(*given), **changes))
            done = linkpose("calibrate", command, folder / "r.csv", "--rig", folder / "rig.toml")
        assert done.status == 0
        return str(done.err)

    return run


def one_link(folder: Path, linkpose: Run) -> str:
    """`calibrate chain` where link 1 rests."""
    block = one_link_in_motion()
    names = [f"{sensor}{kind}" for sensor in ("", "imu2_") for kind in ("accel_{}_m_s2", "gyro_{}_rad_s")]
    head = ["time_s", *(name.format(axis) for name in names for axis in "xyz")]
    values = [block.time_s, block.accel_m_s2, block.gyro_rad_s, block.accel2_m_s2, block.gyro2_rad_s]
    np.savetxt(folder / "r.csv", np.column_stack(values), "%.7f", delimiter=",", header=",".join(head), comments="")
    return str(linkpose("calibrate", "chain", folder / "r.csv", "--rig", folder / "rig.toml").err)


def compared(ours: str, theirs: str) -> Producer:
    """The remarks of an evaluation of these rows."""

    def run(folder: Path, _: Run) -> str:
        (folder / "e.csv").write_text(ours)
        (folder / "t.csv").write_text(theirs)
        return "\n".join(evaluate(*(read_table(folder / name) for name in ("e.csv", "t.csv"))).remarks)

    return run


def moving(names: str, factor: float = 1.0, off: float = 0.0) -> str:
    rows = [f"{t:.2f}" + f",{off + factor * np.sin(3 * t) * np.cos(0.7 * t):.5f}" * names.count(",") for t in T]
    return names + "\n" + "\n".join(rows) + "\n"


def drawn(folder: Path, linkpose: Run) -> str:
    """`plot` of an estimate and of a truth of another time."""
    (folder / "e.csv").write_text(moving("time_s,tilt_roll_deg,tilt_pitch_deg"))
    (folder / "t.csv").write_text("time_s,roll_deg,pitch_deg\n900,0,1\n901,2,3\n902,5,3\n")
    return str(linkpose("plot", folder / "e.csv", folder / "t.csv", "-o", folder / "a.svg").err)


def localized(rows: str, *options: str, beacons: str = "1,0,0\n2,9,0\n3,0,9\n") -> Producer:
    """`localize` over these measurements."""

    def run(folder: Path, linkpose: Run) -> str:
        (folder / "log.csv").write_text("time_s,kind,a,b,c\n" + rows)
        (folder / "b.csv").write_text("id,x_m,y_m\n" + beacons)
        done = linkpose("localize", folder / "log.csv", "--beacons", folder / "b.csv", *options)
        return str(done.err + done.out)

    return run


def ranges(count: int, off_m: float = 0.0, at_once: int = 1) -> str:
    """A tag that rests at (3, 4) m among three beacons; from the middle on, the ranges are too long by `off_m`."""
    rng, places = np.random.default_rng(2), [(0, 0), (9, 0), (0, 9)]
    rows = []
    for k in range(count):
        far = float(np.hypot(3 - places[k % 3][0], 4 - places[k % 3][1])) + off_m * (k > count / 2)
        rows.append(f"{(k // at_once) / 10},range,{k % 3 + 1},{far + rng.normal(0, 0.05):.3f},\n")
    return "".join(rows)


def negative_ranges(folder: Path, _: Run) -> str:
    (folder / "log.csv").write_text("time_s,kind,a,b,c\n0,range,1,5,\n1,range,1,-1,\n")
    return "\n".join(read_log(folder / "log.csv").remarks)


def verdict(count: int, factor: float) -> Producer:
    return lambda *_: Verdict("range", count, 1, factor**2, factor).sentence()


def warned_of_network(folder: Path, _: Run) -> str:
    """The warning of a page that others can reach."""
    said: list[str] = []
    options = PageOptions(True, "0.0.0.0", None)
    with options.open(["time_s"], Rig(), "", said.append):
        pass
    return "\n".join(said)


def driven(count: int) -> str:
    """A robot that drives along x at 1 m/s, with ranges to three beacons."""
    rng, places = np.random.default_rng(4), [(0, 0), (9, 0), (0, 9)]
    rows = []
    for k in range(count):
        x, (at_x, at_y) = k / 10, places[k % 3]
        rows.append(f"{k / 10},odometry,1,0,")
        rows.append(f"{k / 10},range,{k % 3 + 1},{np.hypot(x - at_x, 0.0 - at_y) + rng.normal(0, 0.05):.3f},")
    return "\n".join(rows) + "\n"


def counted_track(**facts: Any) -> Producer:
    """What `localize` says of a path with such counts; the tests of the filters check how they arise."""
    known = facts.get("known", np.ones(4, bool))
    of_path = {"applied": 9, "rejected": 2, "widened": 0, "relocated": 0, "known": known, "time_s": np.arange(4.0),
               "names": ("x_m",), "state": np.zeros((4, 1)), "std": np.ones((4, 1)), "consistency": Consistency()}  # fmt: skip
    return lambda *_: localize_sentence("ekf", SimpleNamespace(**of_path | facts), None)  # type: ignore[arg-type]


def unsent(folder: Path, _: Run) -> str:
    sink = Sink.__new__(Sink)  # without its files
    sink._outputs = [SimpleNamespace(name="udp://a:1", dropped=3)]  # type: ignore[list-item]
    return "\n".join(sink.dropped)


def chain_after_gaps(*_: object) -> str:
    """Every tenth second alone was recorded."""
    run = ChainRun("hinge", 0, 60.0)
    block = run.measurements()
    block = block[np.flatnonzero(np.round(block.time_s * 100) % 200 < 20)]
    with pytest.warns(UserWarning, match="attitudes started again"):
        return "\n".join(lp.estimate(block, filters=["chain"], joint="hinge").remarks)


def take(text: str, name: str) -> Producer:
    """The remarks on a motion-capture file."""

    def run(folder: Path, _: Run) -> str:
        (folder / name).write_text(text)
        return "\n".join(read_any(folder / name, "z").remarks)

    return run


def swung() -> Rotation:
    """A link that swings to all sides."""
    return Rotation.from_euler("xy", np.column_stack([0.5 * np.sin(2 * T), 0.5 * np.cos(1.3 * T)]))


def four_markers() -> str:
    """A TRC file of a plate with three markers, and one more."""
    places = [(0, 0, 1.65), (0.1, 0, 1.65), (0, 0.1, 1.65), (0.3, 0.3, 0)]
    marks = np.column_stack([1000 * swung().apply(place) for place in places])
    rows = "".join(f"{k}\t{t:.2f}\t" + "\t".join(f"{v:.3f}" for v in marks[k]) + "\n" for k, t in enumerate(T))
    return trc_take("a_O\t\t\ta_X\t\t\ta_Y\t\t\tb\t\t", row=rows.rstrip("\n"))


def two_bodies() -> str:
    """A Motive export with two rigid bodies."""
    head = "Format Version,1.24,Rotation Type,Quaternion,Length Units,Meters\n\n"
    names = ",Type" + ",Rigid Body" * 14 + "\n,Name" + ",plate" * 7 + ",other" * 7 + "\n"
    titles = "," + (",Rotation" * 4 + ",Position" * 3) * 2
    values = np.column_stack([swung().as_quat(), swung().apply((0, 0, 1.65))])
    rows = "".join(f"{k},{t:.2f}" + ("," + ",".join(f"{v:.6f}" for v in values[k])) * 2 + "\n" for k, t in enumerate(T))
    return head + names + titles + "\nFrame,Time (Seconds)" + ",X,Y,Z,W,X,Y,Z" * 2 + "\n" + rows


# The remarks of the page in its order, each with what produces it or the test that asserts it.
REMARKS: dict[str, str | Producer] = {
    "… has no metadata: another program has written or saved it; its rate is taken from time_s, and it contains no rig": loaded(
        PLAIN + ROWS
    ),
    "… has no closing line: it was cut; its … whole rows are used": loaded(
        f"# linkpose recording 1\n# {{}}\n{PLAIN}{ROWS}"
    ),
    "…, line …: a spreadsheet damaged the metadata; the settings and the rig in it are not used": loaded(
        f"# linkpose recording 1\n# {{,,,,,,\n{PLAIN}{ROWS}"
    ),
    "…: sample_rate_hz in the metadata is …, which no sampling rate is; the rate is taken from time_s": loaded(
        f'# linkpose recording 1\n# {{"settings": {{"sample_rate_hz": 0}}}}\n{PLAIN}{ROWS}'
    ),
    "…: times are the board's own, because a raw capture holds no other clock": loaded(capture(str), "r.bin"),
    "…: … corrupt frames left out": loaded(capture(damage), "r.bin"),
    "…: … samples lost in … gaps": loaded(capture(leave_out), "r.bin"),
    "…: the board's clock jumped … times; its count of ticks gives the times there": loaded(
        capture(str, 5_000_000), "r.bin"
    ),
    "…: … s: … was found": "test_health.py::test_a_mouse_that_appears_at_a_port_with_columns_is_found_and_counted",
    "…: … s: … is back after … s": changed(put("accel_x_m_s2", slice(200, 300), np.nan)),
    "…: … s: … gives no valid reading. Check its wiring and its supply": changed(
        put("accel_x_m_s2", slice(200, 300), np.nan)
    ),
    "…: … s: … reads all zeros. Check its wiring and its supply": changed(
        *(put(name, slice(200, 300), 0.0) for name in NAMES[1:7])
    ),
    "…: … s: … repeats the same reading. Unplug the board and plug it in again; if it happens again, check the wiring or replace the sensor": changed(
        *(put(name, slice(200, 400), 1.0) for name in NAMES[1:7])
    ),
    "…: … s: … repeats one axis while the others change. Unplug the board and plug it in again; if it happens again, check the wiring or replace the sensor": changed(
        put("accel_y_m_s2", slice(200, 400), 0.25)
    ),
    "…: … s: … gives impossible readings. Unplug the board and plug it in again; if it happens again, check the wiring or replace the sensor": changed(
        put("pressure_Pa", slice(200, 400), 500.0)
    ),
    "…: … more such changes": changed(flickering),
    "…: … has no valid reading in … of … rows. Check its wiring and its supply; if another program put sensors of different rates into one table, delete the rows without a reading": changed(
        put("gyro_y_rad_s", slice(None, None, 2), np.nan)
    ),
    "…: accel_* fits the motion about the joint only with its sign reversed: specific force is +9.81 m/s² along the upward axis at rest; multiply accel_* by -1, or correct J2S": negated,
    "It stopped answering or its readings are invalid: check its wiring and supply.": device(DeviceState.FAILED),
    "Its id … is unknown. It accepted the settings and runs with the MPU-6050's scales, which are assumed; its temperature is not used. Check gravity at rest (9.8 m/s²) before you trust it.": device(
        DeviceState.UNVERIFIED
    ),
    "Its id … is unknown or its settings could not be read back, so it is not used.": device(DeviceState.UNSUPPORTED),
    "Not an MPU-6050, but a compatible successor; it is used with its own filter setting and formulas.": device(
        DeviceState.OK, DeviceFamily.MPU6500
    ),
    "The mouse at port … refuses remote mode: it is read in stream mode, and its movement is up to 5 ms late": "test_board_reports.py::test_what_a_mouse_refused_is_reported",
    "The mouse at port … does not confirm ENABLE: its sensor may stay dark. Move it and check that it counts": "test_board_reports.py::test_what_a_mouse_refused_is_reported",
    "The mouse at port … does not take 200 reports/s: its counts may beat with the sample rate": "test_board_reports.py::test_what_a_mouse_refused_is_reported",
    "The mouse at port … does not take the requested resolution: it runs at … counts/mm": "test_board_reports.py::test_what_a_mouse_refused_is_reported",
    "The mouse at port … does not report its settings: its resolution is assumed": "test_board_reports.py::test_what_a_mouse_refused_is_reported",
    "Mouse … counts … per metre: above … m/s its counts overflow and movement is lost. Drive slower, or use a mouse with fewer counts per metre": "test_board_reports.py::test_a_mouse_that_overflows_early_is_reported_from_its_calibration",
    "The motion does not determine J2S along the sensor's … axis (1σ is … m), so the heights are rough. Swing the link longer, in all directions.": "test_cli.py::test_a_motion_that_does_not_tell_j2s_is_said",
    "mouse … was left out for … s, first at … s…: …. Check that it is on the floor, and its place and angle in the rig file": "test_planar_faults.py::test_estimate_reports_the_gyro_s_jump_and_the_mouse_that_is_left_out",
    "all mice were left out for long: together they contradict the gyro…. If they were on the floor, their counts_per_m or angle_deg in the rig file are wrong: type linkpose calibrate mice": reported(
        **away(1, 2)
    ),
    "the gyro's bias has jumped… by … °/s, found at … s: the mice contradicted the gyro, and the heading was corrected by the mice. Check the mounting and the supply of the sensor": "test_planar_faults.py::test_estimate_reports_the_gyro_s_jump_and_the_mouse_that_is_left_out",
    "mouse … is … mm from its place in the rig file: the turns show it at x_m = …, y_m = …": reported(
        moved_mice=[SimpleNamespace(mouse=2, off_m=0.03, x_m=0.1, y_m=0.0)]
    ),
    "over all turns, gyro and mice differ by … %: the gyro's scale is off (its data sheet allows 3 %), the mice slip in turns, or the floor is another one. Turns do not show which, and σ includes each of them": "test_planar_faults.py::test_a_gyro_whose_scale_is_off_is_named_and_in_sigma",
    "in turns, gyro and mice differ by … ± … %: the gyro's scale is off (its data sheet allows 3 %), the mice slip in turns, or the floor is another one. Turns do not show which, and σ includes each of them; for another floor, type linkpose calibrate mice": reported(
        mice_scale=(1.03, 0.001)
    ),
    "in turns, the mice count … ± … % … per metre than the rig file states, compared with the gyro: either they slip in turns, or the floor is another one; for that one, type linkpose calibrate mice": reported(
        mice_scale=(1.05, 0.001)
    ),
    "mice … and … are exchanged: in turns, each moves as at the place of another. Exchange their cables, or their [[mouse]] tables in the rig file": "test_planar_faults.py::test_mice_that_are_exchanged_are_named",
    "the gyro states the reverse of the turns that the mice show: its z axis must point up": "test_planar_faults.py::test_a_gyro_that_is_upside_down_is_named",
    "the mice show no speed above … m/s, where gyro or accelerometer show more: this is the limit of their sensors. Where the robot was faster, the path is too short, and the σ of the position includes it. Drive slower, or use mice for higher speeds": "test_planar_faults.py::test_a_speed_limit_of_all_mice_shows_in_bends_and_widens_the_position",
    "in two turns in a row, all mice count … times as much as before, found at … s by the gyro: their resolution was switched, or they slip in turns": "test_planar_faults.py::test_another_resolution_of_all_mice_is_found_in_two_turns",
    "from turn to turn, the mice show … % more or less than the gyro: they slip, the floor changes, or the gyro's scale is off. The σ of the position includes this share of the way": "test_planar_faults.py::test_slips_in_some_turns_widen_the_position",
    "…: readings without counts during motion; the report rate is lower than the sample rate. The motion between two reports is interpolated": "test_planar_faults.py::test_mice_that_report_at_40_hz_are_used",
    "…: single counts while the robot rests. They are not taken for motion. Check the surface": "test_planar_faults.py::test_one_count_in_a_second_does_not_end_a_rest",
    "…: no counts across an axis while the motion is almost along the other one (angle snapping). In bends, the position is less accurate. Use mice without this function": "test_planar_faults.py::test_mice_that_snap_to_their_axes_do_not_spoil_the_path",
    "The magnetometer did not hold the heading: the field is not as strong as at its calibration. Move away from iron, or calibrate it here: linkpose calibrate mag RECORDING --rig rig.toml": "test_magnetic_heading.py::test_an_uncalibrated_magnetometer_gets_one_sentence_with_its_cure",
    "The magnetometer held the heading for … s. For … s the field was disturbed, by … µT at most.": "test_magnetic_heading.py::test_the_command",
    "chain: the mean acceleration of sensor … is … m/s², and gravity alone is 9.81 m/s². Check that the sensor works and that its unit is m/s².": "test_filter_chain.py::test_readings_that_no_joint_gives_are_reported_and_have_no_estimate",
    "chain: the mean rate of sensor … is … rad/s, more than a joint turns. Check that its unit is rad/s, not °/s.": "test_filter_chain.py::test_readings_that_no_joint_gives_are_reported_and_have_no_estimate",
    "chain: … of … samples could not be used. A sensor was absent, repeated one reading, or was saturated. Check its wiring and its range.": "test_filter_chain.py::test_a_sensor_that_is_often_absent_is_not_taken_for_one_in_another_unit",
    "chain: the attitudes started again … times after gaps of more than … s. Check that the times are in seconds.": chain_after_gaps,
    "chain: for … % of the samples the readings do not fit two links with one joint, so their estimates are blank. Check that the units are m/s² and rad/s, that both sensors are firm on links that share a joint, and that neither sensor has failed.": "test_filter_chain.py::test_readings_that_no_joint_gives_are_reported_and_have_no_estimate",
    "…: … estimates were not sent": unsent,
    "warning: everybody who reaches this address over the network can see the page and press stop": warned_of_network,
    "… with saturated readings left out; record them with a larger range.": imu_calibration(saturated=True),
    "Offset and scale of the accelerometer are unchanged: … recorded, … that determine all axes needed.…": imu_calibration(
        saturated=False
    ),
    "J2S is not observable along the sensor's … axis (direction …, …, …): σ … m. Rotate the link about its … axes too, and faster; on a hinge with a horizontal axis this direction does not enter the height.": "test_calibration_link.py::test_a_hinge_is_named_with_its_cure",
    "The residual is large. Check that the joint is fixed and the sensor firm on the link.": calibrated(
        "joint", residual_m_s2=2.0
    ),
    "The sensor errors found (…) are not saved. Add --imu to save them.": "test_calibration_link.py::test_a_sensor_that_is_not_calibrated_is_said_and_calibrated_on_request",
    "The rig file does not calibrate the sensor: add --imu, or type linkpose calibrate imu.": "test_calibration_link.py::test_a_sensor_that_is_not_calibrated_is_said_and_calibrated_on_request",
    "The motion is that of …, not of …: the links turn by …° rms about the best axis and by …° about others. Leave out --joint, or move only the joint between the two sensors.": "test_calibration_chain.py::test_a_wrong_kind_a_still_sensor_and_swapped_sensors_are_named",
    "Sensor … does not turn, so r… is not observable: move both links.": "test_calibration_chain.py::test_a_wrong_kind_a_still_sensor_and_swapped_sensors_are_named",
    "The sensors look swapped: r1 found here is r2 of the rig file, and r2 is r1. Sensor 1 (0x68) belongs on link 1.": "test_calibration_chain.py::test_a_wrong_kind_a_still_sensor_and_swapped_sensors_are_named",
    "Not observable: …. Rotate that sensor's link about its other axes, faster, while the joint between the links moves to and fro.": one_link,
    "The axis is not observable. Move both links, in more than one direction.": one_link,
    "The residual is large. Check that each sensor is firm on its own link.": calibrated("chain", residual_m_s2=2.0),
    "… left out: the magnitude is far from the median of all readings.": "test_calibrate_mag.py::test_spikes_are_left_out_with_their_count",
    "The residual is large: iron or a current was near the sensor in a part of the recording. Record again, away from both.": calibrated(
        "mag", residual_uT=9.0
    ),
    "The rotation into the inertial sensor's axes is not determined, and the axes are assumed to agree: turn the sensor faster, about all axes.": calibrated(
        "mag", rotation=None, dip_deg=None
    ),
    "… have their tilts …° apart (median, the nearest filter's): are they of the same run, and of the same axes?": compared(
        moving("time_s,tilt_roll_deg,tilt_pitch_deg", 9.0), moving("time_s,roll_deg,pitch_deg", 9.0, off=60.0)
    ),
    "… have their tilts …° apart (median, the nearest filter's): try the other axis with --up y or z, and check the order of the markers": "test_evaluation.py::test_motive_exports_in_another_frame_are_doubted",
    "… count the joint angle in opposite senses: the sense of an axis that a filter finds is arbitrary; negate axis1 and axis2 in the rig file and estimate again": "test_evaluation_sigma.py::test_an_angle_of_the_opposite_sense_is_named",
    "… have hardly any motion in common, whatever the offset: are they of the same run?": "test_evaluation.py::test_files_of_different_runs_are_scored_and_doubted",
    "… have hardly any motion in common: are they of the same run, and their times in seconds?": "test_evaluation_sigma.py::test_odometry_and_a_truth_with_other_times_are_named",
    "…: … moves like the estimate of … in …, times …: check its unit and its sign in both files": "test_evaluation_sigma.py::test_a_heading_in_degrees_is_named",
    "…: … is the same wherever the estimates move: check the column and the times": compared(
        moving("time_s,tilt_height_m"), moving("time_s,height_m", 0.0)
    ),
    "…: time_s spans … s, and in … … s: is it in …? divide it by …": "test_evaluation_sigma.py::test_times_in_another_unit_are_named",
    "…: the path is the mirror image of that of …: were x_m and y_m exchanged, or is the sign of one of them wrong?": "test_evaluation_sigma.py::test_a_mirrored_path_is_named",
    "…: … is not compared: state it in …, in a column …": "test_evaluation_sigma.py::test_a_column_with_the_name_of_another_unit_is_named",
    "…: … are no rotation, whose length is 1: check these columns": "test_evaluation_sigma.py::test_a_quaternion_that_is_no_rotation_is_named",
    "…: markers left out as unlabeled: …": "test_evaluation.py::test_an_unlabeled_marker_is_left_out_and_said",
    "…: markers left out: …": take(four_markers(), "a.trc"),
    "…: the markers are …": take(four_markers(), "a.trc"),
    "…: rigid bodies left out: …": take(two_bodies(), "a.csv"),
    "…: the rigid body … is the reference: its pivot must be at the sensor, and its axes were the room's when the sensor's x axis pointed along X and its z axis up": "test_evaluation.py::test_a_rigid_body_alone_is_a_reference",
    "…: the markers' widest angle is at marker … (…°) rather than marker 1 (…°), which must be at the sensor: order them in Motive, if it is not": "test_evaluation.py::test_motive_exports_in_another_frame_are_doubted",
    "…: the motion is the one of the filter …": "test_convert.py::test_a_filter_without_poses_is_passed_over",
    "… does not estimate …": "test_convert.py::test_the_command_keeps_an_existing_file",
    "…: … rows without an estimate left out": "test_convert.py::test_opensim_reads_the_orientations",
    "no errors are drawn: …": drawn,
    "… has … rows: the picture shows the extremes of each part, and figures beside lines are of the rows shown": "test_long_recordings.py::test_a_picture_of_a_long_table_keeps_spikes_and_gaps",
    "no errors are drawn of files of this length: type linkpose evaluate …": "test_long_recordings.py::test_a_picture_of_a_long_table_keeps_spikes_and_gaps",
    "…: the last line is cut short and left out": "test_localization_logs.py::test_disorder_and_lines_without_a_time",
    "the last row is cut short and left out": "test_localization_cli.py::test_a_stream_without_a_final_line_end",
    "…: … without a time left out": "test_localization_logs.py::test_disorder_and_lines_without_a_time",
    "…: … left out": negative_ranges,
    "… moved into the order of time": "test_localization_logs.py::test_rows_are_sorted_and_negative_ranges_left_out",
    "… older than the one before left out": "test_localization_cli.py::test_rows_from_standard_input_become_poses_at_once",
    "noises estimated from the log: …": "test_localization_beacons.py::test_the_command_reports_the_noises_it_found_and_draws_the_path",
    "the … of the odometry is … …/s (rms) and errs by … … in a second: the measurements contradict it. Check its unit, its sign, its column and its times, unless the robot was carried": "test_localization_beacons.py::test_noises_and_constants_that_no_sensor_has_are_doubted",
    "the ranges come out … times too long: check their unit, the unit of the beacons' places and that of the odometry": "test_localization_beacons.py::test_noises_and_constants_that_no_sensor_has_are_doubted",
    "the ranges have errors of … m that persist, where the median range is … m: check the ids and the places of the beacons, and the units": "test_localization_beacons.py::test_noises_and_constants_that_no_sensor_has_are_doubted",
    "scale error and bias of the ranges are estimated, too": localized("0,pose,0,0,0\n" + driven(40)),
    "the odometry of the log is always at rest: the motion is taken from the scans; give --start": "test_localization_scans.py::test_scans_without_odometry_are_followed_from_a_given_start",
    "no two ranges of this log are of one instant, so their correlation changes nothing": localized(
        ranges(90), "--correlation", "0.3"
    ),
    "the log has no odometry: a constant-velocity model is used, at the mean height of the beacons": localized(
        ranges(90)
    ),
    "the beacons are near one line: the start (…, …) m fits the log better than its mirror image (…, …) m; give --start if this is the wrong side": "test_localization_beacons.py::test_a_tag_beside_anchors_near_one_line_is_not_mirrored_in_silence",
    "only … of the beams end at a wall of the map, and … at the pose that fits best; check whether the map is of this place": "test_localization_scans.py::test_a_map_of_another_place_and_an_odometry_that_contradicts_the_scans_are_named",
    "single scans fit the map (… of the beams), but only … along the path; check the odometry, and the laser's place and direction on the robot": "test_localization_scans.py::test_a_map_of_another_place_and_an_odometry_that_contradicts_the_scans_are_named",
    "the laser's ranges are … … than the distances in the map and were corrected by as much: check the scanner, and the resolution in the map's YAML file": "test_localization_scans.py::test_ranges_that_are_too_long_are_corrected_and_named",
    "the laser points … degrees farther to the … than the log states, and was corrected by as much: wheels do not drive sideways. Check the laser's direction on the robot, and the beams' start angle": "test_localization_calibration.py::test_a_laser_that_was_put_on_askew_is_corrected_and_named",
    "the laser is … m farther … on the robot than the log states, and was corrected by as much: the robot turns about another point. Check the laser's place": "test_localization_calibration.py::test_the_place_of_a_laser_is_corrected_where_the_log_states_one_and_else_named_and_in_the_deviations",
    "the laser is … than the point that the robot turns about, and the log states no place for it: the path is that of the laser, and σ includes the distance. If the path of the robot is meant, state the laser's place in the log": "test_localization_calibration.py::test_the_place_of_a_laser_is_corrected_where_the_log_states_one_and_else_named_and_in_the_deviations",
    "the odometry … … times as far as the scans, and was corrected by as much: check the diameter of the wheels and the distance between them": "test_localization_calibration.py::test_an_odometry_that_is_a_third_too_long_is_corrected_and_named",
    "the … stamped about … s later than …: correct those that are wrong (with wrong times of the scans, the path is off by as much as the robot moves in that time)": "test_localization_scans.py::test_a_clock_a_sign_and_a_unit_of_the_odometry_that_the_scans_contradict_are_named",
    "the odometry … the other way than the scans: check the sign of that column, and the direction of the laser and the order of its beams": "test_localization_scans.py::test_a_clock_a_sign_and_a_unit_of_the_odometry_that_the_scans_contradict_are_named",
    "the robot moves … degrees to the … of its heading: the beams' start angle, or the laser's direction on the robot, is wrong by as much": "test_localization_scans.py::test_a_laser_whose_direction_is_not_the_stated_one_is_named",
    "the odometry … … times as far as the scans: check the unit of that column": "test_localization_scans.py::test_a_clock_a_sign_and_a_unit_of_the_odometry_that_the_scans_contradict_are_named",
    "… noise: only …, no verdict": verdict(1, 1.0),
    "… noise: the measurements equal their predictions, no verdict": verdict(100, 0.001),
    "… noise is set … times too small": verdict(100, 2.0),
    "… noise is set … times too large": verdict(100, 0.5),
    "… most measurements were rejected, so the pose was made uncertain again": counted_track(widened=2),
    "… the pose was lost and found again": counted_track(relocated=1),
    "the pose is known in … % of the rows…": counted_track(known=np.arange(4) > 1),
    "…; uploading the prebuilt firmware instead (--prebuilt does so at once)": "test_flash.py::test_without_the_toolchain_the_prebuilt_image_is_uploaded",
}


def shown() -> list[str]:
    text = PAGE.read_text(encoding="utf-8").split("\n## Remarks with a result")[1].split("\n## ")[0]
    return re.findall(r"^\| `([^`]+)` \|", text, re.MULTILINE)


def test_the_table_of_the_page_and_this_one_have_the_same_remarks() -> None:
    assert shown() == list(REMARKS)


@pytest.mark.parametrize(("remark", "produce"), REMARKS.items(), ids=[str(k) for k in range(len(REMARKS))])
def test_each_remark_of_the_page_is_produced(
    tmp_path: Path, linkpose: Run, remark: str, produce: str | Producer
) -> None:
    if isinstance(produce, str):
        check_asserted(remark, produce)
        return
    found = " ".join(produce(tmp_path, linkpose).replace("`", "").split())
    assert re.search(pattern(remark), found), f"{found!r} has no {remark!r}"


# Texts for which there is nothing to mend: what a command does or has found, and parts of sentences.
WITHOUT_ROW = (
    "building the firmware with PlatformIO", "uploading …", "the upload is verified", "Compiling filters", "mark at",
    "observing the sensors", "The estimates of filters that are still being compiled", "… s, …, … Hz, … lost",
    ", … corrupt", ", … invalid", ", … dropped by the board", "…: … applied, … rejected", "position error",
    "; heading … rad", "; … % of the errors", "at the end …", "(first at … s)", "median NIS", "; outliers raise",
    "Magnetic north is at", "it contradicted the other sensors", "Add a rest with", "Add rests in", "a ball joint",
    "unknown inertial sensor", "the second IMU", "…_qw to …_qz", "x and y: they are 0", "the height: it is 0", "yaw: it is 0", "a constant current",
    "the speed of sound", "drift … m", "errors persist for", "a value too long to quote", "A sign test needs",
    "… times, last", "; it is still left out",
)  # fmt: skip


def test_each_remark_of_the_program_is_on_the_page() -> None:
    """What the commands report, and the sentences of the library from which remarks come."""
    page = PAGE.read_text(encoding="utf-8").replace("`", "")
    rows = [row.strip("| ").split(" | ")[0] for row in page.splitlines() if row.startswith("| ")]
    found = sources()
    assert len(found) > 90
    missing = {
        of: where
        for of, where in found.items()
        if not of.startswith(WITHOUT_ROW) and not any(has_all_parts(row, of) for row in rows)
    }
    assert not missing, f"host/docs/messages.md has no row for {missing}"


def has_all_parts(row: str, of: str) -> bool:
    return all(part.strip(" :;,.") in row for part in of.split("…"))


TEXTS = (
    "str",
    "str | None",
    "list[str]",
    "Iterator[str]",
    "tuple[str, ...]",
    "list[Suspicion]",
    "Iterator[_Explanation]",
)
FEWEST_WORDS = 3


class Functions:
    """The functions of the program by name, and those of a remark's text that were not visited yet."""

    def __init__(self) -> None:
        self.trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in sorted(PACKAGE.rglob("*.py"))}
        self.by_name: dict[str, list[tuple[Path, ast.FunctionDef]]] = {}
        for path, tree in self.trees.items():
            for node in ast.walk(tree):
                if isinstance(node, ast.FunctionDef):
                    self.by_name.setdefault(node.name, []).append((path, node))
        self._seen: set[tuple[Path, int]] = set()
        self.left: list[tuple[Path, ast.FunctionDef]] = []

    def follow(self, path: Path, node: ast.AST) -> None:
        """Notes the functions that `node` calls and that return text: those of the same file, or imported."""
        for call in (each for each in ast.walk(node) if isinstance(each, ast.Call)):
            is_own = isinstance(call.func, ast.Name) or name_of(getattr(call.func, "value", call.func)) == "self"
            for where, function in self.by_name.get(name_of(call.func), []):
                imported = where == path or (isinstance(call.func, ast.Name) and function.col_offset == 0)
                if (is_own and imported) and function.returns and ast.unparse(function.returns) in TEXTS:
                    self.add(where, function)

    def add(self, path: Path, function: ast.FunctionDef) -> None:
        if (path, function.lineno) not in self._seen:
            self._seen.add((path, function.lineno))
            self.left.append((path, function))


@functools.cache
def sources() -> dict[str, str]:
    """Text and place of each remark; reading the whole program takes seconds."""
    return dict(found_sources())


def found_sources() -> Iterator[tuple[str, str]]:
    """The texts of remarks, `…` for what is put in, and where they are."""
    functions = Functions()
    for path, tree in functions.trees.items():
        for function in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)):
            if "remark" in function.name:
                functions.add(path, function)
            for node in ast.walk(function):
                for value in given_as_remark(node):
                    yield from texts(path, value)
                    functions.follow(path, value)
                    if not (isinstance(node, ast.Call) and name_of(node.func) == "report"):
                        functions.follow(path, function)  # the value may come from a variable
    while functions.left:
        path, function = functions.left.pop()
        body = function.body[1:] if ast.get_docstring(function) else function.body
        for statement in body:
            yield from texts(path, statement)
            functions.follow(path, statement)


def given_as_remark(node: ast.AST) -> list[ast.expr]:
    """The values that `node` reports, assigns to a name with "remark" in it, or adds to one."""
    if isinstance(node, ast.Call):
        of = name_of(getattr(node.func, "value", node.func))
        if name_of(node.func) == "report" and ("console" in of or of == "report"):
            return node.args[:1]
        if name_of(node.func) in ("append", "extend") and "remark" in of:
            return node.args
        return [keyword.value for keyword in node.keywords if keyword.arg and "remark" in keyword.arg]
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
    names = [each for target in targets if target is not None for each in ast.walk(target)]
    value = getattr(node, "value", None)
    if isinstance(node, ast.Assign | ast.AugAssign | ast.AnnAssign) and value is not None:
        return [value] if any("remark" in name_of(each) for each in names if isinstance(each, ast.expr)) else []
    return []


def texts(path: Path, node: ast.AST) -> Iterator[tuple[str, str]]:
    """The sentences within a node, but those of errors."""
    if isinstance(node, ast.Raise):
        return
    if isinstance(node, ast.Constant | ast.JoinedStr):
        text = text_of(node)
        if len(text.split()) >= FEWEST_WORDS:
            yield text.replace("`", "").strip(), f"{path.relative_to(PACKAGE)}:{node.lineno}"
    for child in ast.iter_child_nodes(node):
        if not (isinstance(node, ast.JoinedStr) and isinstance(child, ast.Constant)):  # a part of its text
            yield from texts(path, child)


def test_the_sources_are_found() -> None:
    """Reported at once, through a function, added to a list, and yielded."""
    for sentence in (
        "The residual is large. Check that each sensor is firm on its own link.",
        "Offset and scale of the accelerometer are unchanged: … recorded, … that determine all axes needed.…",
        "…: … without a time left out",
        "…: single counts while the robot rests. They are not taken for motion. Check the surface",
        "gyro_* states the reverse of the rotation of gravity: its sign is wrong",
    ):
        assert sentence in sources(), sentence
