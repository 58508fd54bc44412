"""Messages of boards, calibrations, flashing, pictures, Python values and wrong usage, and what produces each.

A message that takes long to produce, or an emulated board, names the test that asserts it.
"""

# ruff: noqa: E501  (a message stands in one line)
from __future__ import annotations

import errno
import io
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from message_producers import raises
from scripted_board import ScriptedBoard, install
from test_calibrate_mag import recording as of_magnetometer
from test_calibrate_mag import tumbled
from test_calibrate_mice import LENGTH_M, broken, driven
from test_calibration_chain import recording
from test_calibration_link import OFFSET, SIX_SIDES
from test_flash import ScriptedPort
from test_localization_scans import along_a_symmetric_room, in_one_place, localize_in

import linkpose as lp
from linkpose import inputs
from linkpose.calibration.chain import calibrate_chain
from linkpose.calibration.imu import fit_sphere
from linkpose.calibration.mag import calibrate_mag
from linkpose.calibration.mice import calibrate_mice
from linkpose.cli import group
from linkpose.cli.streams import safe_streams
from linkpose.device import session as session_module
from linkpose.device.ports import open_port
from linkpose.device.session import Session
from linkpose.estimation import Estimator
from linkpose.evaluation.references import read_any
from linkpose.filters import create, create_smoother
from linkpose.filters.magnetic_heading import MagneticHeading
from linkpose.flashing.build import Project, build, project
from linkpose.flashing.image import PREBUILT, read_image
from linkpose.flashing.stk500 import SIGNATURE
from linkpose.flashing.upload import upload
from linkpose.localization.events import Event
from linkpose.localization.kalman import covariance_root
from linkpose.localization.logs import read_log
from linkpose.localization.maps import save_map
from linkpose.localization.odometry import with_mice_odometry
from linkpose.localization.options import LocalizationOptions
from linkpose.localization.stream import Stream
from linkpose.page.page import Page, free_port
from linkpose.plotting import plot_tables
from linkpose.recorder import Recorder
from linkpose.recording.table import read_table
from linkpose.sensors.devices import Sensors
from linkpose.sensors.mpu6050 import STANDARD_GRAVITY
from linkpose.sensors.rig import Mag, Mouse, Rig
from linkpose.simulation.chain import ChainRun
from linkpose.simulation.export import check_length
from linkpose.simulation.link import LinkRun
from linkpose.simulation.mice import Fault, MiceRun
from linkpose.simulation.motion import SixSides
from linkpose.wire.messages import Configure, GetInfo, Message, Ping

Producer = Callable[[Path], object] | str  # a str names the test that asserts the message
SIM = "sim://link?speed=0"


def written(read: Callable[[Path], object], text: str | bytes, name: str = "a.csv") -> Producer:
    """What `read` makes of a file with this text."""

    def run(folder: Path) -> object:
        (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())
        return read(folder / name)

    return run


def typed(line: str, **files: str) -> Producer:
    """A command of linkpose, with `{}` for a folder that holds these files: `a="x"` is a.csv with the text x."""

    def run(folder: Path) -> object:
        for name, text in files.items():
            (folder / f"{name}.csv").write_text(text)
        return group.main(line.replace("{}", str(folder)).split(), standalone_mode=False)

    return run


def patched(target: str, value: object, then: Callable[[Path], object]) -> Producer:
    def run(folder: Path) -> object:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(target, value)
            return then(folder)

    return run


def of_board(change: Callable[[ScriptedBoard], None], then: Callable[[Session], object]) -> Producer:
    """A session with a simulated board that does what `change` makes it do."""

    def run(folder: Path) -> object:
        with pytest.MonkeyPatch.context() as patch:
            board = install(patch)
            patch.setattr(session_module, "ANSWER_TIMEOUT_S", 0.02)
            change(board)
            with Session(SIM, lambda _: None) as session:
                return then(session)

    return run


def loses(kind: type[Message]) -> Callable[[ScriptedBoard], None]:
    """A board whose answers to commands of this kind get lost."""

    def change(board: ScriptedBoard) -> None:
        board.lost = lambda message: isinstance(message, kind)

    return change


def resets_at(kind: type[Message]) -> Callable[[ScriptedBoard], None]:
    def change(board: ScriptedBoard) -> None:
        board.resets_at = lambda message: isinstance(message, kind)

    return change


def impossible_hello(board: ScriptedBoard) -> None:
    board.hello = lambda hello: hello._replace(dlpf=7)


def configured(**settings: int) -> Callable[[Session], object]:
    return lambda session: session.configure(session.settings._replace(**settings))


def mice(case: str) -> Producer:
    """A case of test_calibrate_mice."""

    def run(folder: Path) -> object:
        recordings, rig, _ = broken()[case]
        return calibrate_mice(recordings, rig, LENGTH_M)

    return run


def mice_of(made: Callable[[], object]) -> Producer:
    return lambda folder: made()


def _many_turns() -> object:
    run, turn = driven("turn")
    block = turn.measurements
    faster = replace(turn, measurements=replace(block, gyro_rad_s=block.gyro_rad_s * 40))
    return calibrate_mice([faster], run.rig, LENGTH_M)


def _short_line() -> object:
    run = MiceRun(3, 12.0, path="line", length_m=0.01)
    line = replace(driven("line")[1], measurements=run.measurements())
    return calibrate_mice([line], run.rig, 0.01)


def _contradicting_mice() -> object:
    run, line = driven("line", errors="none")
    _, turn = driven("turn", errors="none")
    first, *others = run.mice
    return calibrate_mice([line, turn], Rig(mouse=(replace(first, x_m=first.x_m + 0.1), *others)), LENGTH_M)


def _one_mouse_without_length() -> object:
    from linkpose.simulation.mice import ring

    run, line = driven("line", mice=ring(1))
    _, turn = driven("turn", mice=ring(1))
    return calibrate_mice([turn, line], run.rig, None)


def _other_chain() -> object:
    one, other = (ChainRun("ball", seed, 15.0).measurements() for seed in (0, 1))
    return calibrate_chain(
        [
            recording(
                lp.Measurements.from_imu(
                    one.time_s, one.accel_m_s2, one.gyro_rad_s,
                    accel2_m_s2=3 * other.accel2_m_s2, gyro2_rad_s=other.gyro2_rad_s,
                )
            )
        ],
        Rig(),
    )  # fmt: skip


def flashing(*answers: bytes, size: int = 0) -> Producer:
    """An upload to a bootloader that gives these answers; `size` bytes of firmware, or the prebuilt image."""

    def run(folder: Path) -> object:
        image = read_image(PREBUILT)
        if size:
            image = replace(image, data=b"\1" * size)
        return upload(image, "/dev/ttyX", lambda _: None, lambda *_: ScriptedPort(*answers))  # type: ignore[arg-type]

    return run


IN_SYNC = b"\x14\x10"
ATMEGA328P = b"\x14" + SIGNATURE + b"\x10"


def building(then: Callable[[Project], object], script: str = "exit 1") -> Producer:
    """The firmware's project with a shell script in the place of PlatformIO."""

    def run(folder: Path) -> object:
        interpreter = folder / "python"
        interpreter.write_text(f"#!/bin/sh\n{script}\n")
        interpreter.chmod(0o755)
        with pytest.MonkeyPatch.context() as patch, project("uno") as firmware:
            patch.setattr(sys, "executable", str(interpreter) if script else str(folder / "none"))
            return then(firmware)

    return run


def entered(context: object) -> object:
    with context as entered_context:  # type: ignore[attr-defined]
        return entered_context


def to_stream(stream: object) -> Producer:
    """A result that is written to this standard output."""

    def run(folder: Path) -> object:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "stdout", stream() if callable(stream) else stream)
            with safe_streams():
                sys.stdout.write("a result\n")
                sys.stdout.flush()
        return None

    return run


class _Failing(io.StringIO):
    """A standard output that cannot be written."""

    def __init__(self, code: int) -> None:
        super().__init__()
        self._code = code

    def flush(self) -> None:
        raise OSError(self._code, "the system's reason")


MOTIVE = "Format Version,1.23,Length Units,{}\n{}Frame,Time (Seconds),{}\n"
BODY = (
    ",Type" + ",Rigid Body" * 7 + "\n,Name" + ",plate" * 7 + "\n,," + "Rotation," * 4 + "Position,Position,Position\n"
)


def markers(rows: Callable[[float], str], unit: str = "Meters", count: int = 60) -> Producer:
    """A take of three markers; `rows` gives the first one's place at an instant, and the others lie beside it."""
    body = "".join(f"{i},{i / 50:.4f},{rows(i / 50)}\n" for i in range(count))
    return written(read_any, MOTIVE.format(unit, "", ",".join(["X,Y,Z"] * 3)) + body)


def plate(x: float, y: float, z: float) -> str:
    return ",".join(f"{v:.6f}" for v in (x, y, z, x + 0.1, y, z, x, y, z + 0.1))


def body(row: str) -> Producer:
    return written(read_any, MOTIVE.format("Meters", BODY, "X,Y,Z,W,X,Y,Z") + f"0,0,{row}\n1,0.1,{row}\n")


def rig(table: str, **values: object) -> Producer:
    return raises(lambda: Rig.from_dict({table: values}, "rig.toml"))


def options(**given: object) -> Producer:
    return raises(lambda: LocalizationOptions(**given))  # type: ignore[arg-type]


def measured(time_s: object, accel: object, **more: object) -> Producer:
    return raises(lambda: lp.Measurements.from_imu(time_s, accel, np.zeros((3, 3)), **more))  # type: ignore[arg-type]


def without_end() -> LinkRun:
    return LinkRun(duration_s=None)


def _taken(host: str, port: int) -> None:
    raise OSError(errno.EADDRINUSE, "in use")


ESTIMATE = "time_s,tilt_height_m\n0,1\n1,2\n"
EVENTS = "time_s,kind,a,b,c\n0,pose,0,0,0\n0,odometry,1,0,\n1,odometry,1,0,\n"


SCANS = "FLASER 3 1 1 1 0 0 0 0 0 0 0 host 0\nODOM 0 0 0 0 0 0 1 host 1\n"
PLACED = [Event(0.0, "pose", (0.0, 0.0, 0.0)), Event(1.0, "range", (2.0,), "1")]


def small_map(folder: Path) -> Path:
    cells = np.zeros((4, 4), bool)
    cells[0] = True
    save_map(folder / "m.yaml", cells, 0.5, (-1.0, -1.0))
    return folder / "m.yaml"


def odometry_elsewhere(folder: Path) -> object:
    (folder / "log.csv").write_text(EVENTS)
    (folder / "a.csv").write_text("time_s,mice_vx_m_s,mice_vy_m_s,mice_wz_rad_s\n90,0,0,0\n91,0,0,0\n")
    return with_mice_odometry(read_log(folder / "log.csv").events, folder / "a.csv")


def with_filter(rig: Rig, sensors: Sensors, name: str = "mice", count: int = 1) -> Producer:
    return raises(lambda: create(name, rig, sensors, count))


# In the order of the page. Text -> what produces it, or the test that asserts it.
FURTHER: dict[str, dict[str, Producer]] = {
    "Inputs and outputs": {
        "cannot read …: it is a device, not a file": raises(lambda: inputs.read_bytes(Path("/dev/null"))),
        "cannot read …: it is larger than … MB, and files of its kind are not": patched(
            "linkpose.inputs.MOST_BYTES", 10, written(inputs.read_bytes, "0" * 20)
        ),
        "cannot read …: it is a pipe, and no program writes into it": "test_inputs.py::test_what_is_no_file_is_refused_in_time",
        "cannot read …: it is a pipe with more than … MB; save it to a file": "test_inputs.py::test_a_pipe_that_gives_more_than_memory_allows_is_refused",
        "cannot write …: it is a folder; name a file in a folder you may write to": typed(
            "simulate link --duration 2 --force -o {} --truth {}/t.csv"
        ),
        "cannot write …: there is no folder …; name a file in a folder you may write to": typed(
            "simulate link --duration 2 -o {}/none/a.csv --truth {}/t.csv"
        ),
        "cannot write …: it is a link of another user in a folder that everybody can write; name a file in a folder you may write to": "test_outputs.py::test_a_link_of_another_user_is_not_followed",
        "cannot write …: it is a disk; name a file in a folder you may write to": "test_outputs.py::test_a_disk_is_not_overwritten",
        "… is named for two outputs; name two files": typed("simulate link --duration 2 -o {}/a.csv --truth {}/a.csv"),
        "cannot write the standard output: …; name a file in a folder you may write to": "test_streams.py::test_a_picture_that_cannot_be_written_is_one_sentence",
        "cannot write the output: …; write it to another place": to_stream(lambda: _Failing(28)),
        "cannot write the output: stdout is closed; write it to a file or a pipe": to_stream(None),
        "the reader of the output has gone; stopped": to_stream(lambda: _Failing(32)),
        "cannot write the raw capture any more: …": "test_device.py::test_a_raw_capture_on_a_full_disk_ends_with_a_sentence",
        "… is not a name for a recording, which is a CSV file: .bin is a raw capture": raises(
            lambda: Recorder(None, Path("a.bin"), Rig())  # type: ignore[arg-type]
        ),
    },
    "Boards in use": {
        "…: another firmware answers: …; type linkpose flash to put linkpose's firmware on the board, or choose another port with --port": "test_device.py::test_what_answers_instead_of_a_board",
        "…: only noise was received, and no frame; the device uses another baud rate or is not a linkpose board: check the port; type linkpose flash to put linkpose's firmware on the board, or choose another port with --port": "test_device.py::test_what_answers_instead_of_a_board",
        "…: the board answers only in part; check the cable and try again; type linkpose flash to put linkpose's firmware on the board, or choose another port with --port": "test_device.py::test_what_answers_instead_of_a_board",
        "…: the board refuses every command, also the request for its version; its firmware is damaged; type linkpose flash to put linkpose's firmware on the board, or choose another port with --port": "test_device.py::test_what_answers_instead_of_a_board",
        "…: a frame of type … with … bytes arrived intact, which protocol … does not have; the firmware is damaged or not linkpose's; type linkpose flash to put linkpose's firmware on the board, or choose another port with --port": "test_device.py::test_what_answers_instead_of_a_board",
        "the board's firmware … and this linkpose … have different wire schemas; type linkpose flash": "test_flash_mismatch.py::test_another_schema_at_the_start",
        "this linkpose … is older than the board's firmware …, and their schemas differ; type pip install --upgrade linkpose": "test_flash_mismatch.py::test_another_schema_at_the_start",
        "the board's HELLO contains …, which is impossible; its firmware is damaged or not linkpose's: type linkpose flash": of_board(
            impossible_hello, lambda session: None
        ),
        "the board refused …: …": of_board(lambda board: None, configured(sample_rate_hz=77)),
        "the board did not answer …; unplug it, plug it in and try again": of_board(
            loses(Configure), configured(sample_rate_hz=200)
        ),
        "…: the board does not answer PING; unplug it, plug it in and try again": of_board(
            loses(Ping), lambda session: list(session.stream(0.1))
        ),
        "the board loses its settings: it is reset again and again; check its supply and its cable": of_board(
            resets_at(GetInfo), configured(sample_rate_hz=200)
        ),
        "the board is reset again and again before it streams; check its supply and its cable": "test_device.py::test_a_board_that_is_reset_again_and_again_is_named",
        "the board accepted START, but no sample arrived; check the cable, and reset the board": "test_device.py::test_a_board_that_starts_and_sends_no_sample_is_a_failure",
        "another board answers at … now; record it into a file of its own": "test_device.py::test_a_barometer_with_other_words_is_another_board",
        "another board answers at … now (a sensor has the id … instead of …); record it into a file of its own": "test_device.py::test_another_board_behind_the_same_port_ends_the_recording",
        "… is gone (…); check the cable and try again": "test_device.py::test_a_port_that_goes_during_the_handshake_is_a_sentence",
        "… is gone (…); close other programs that use it, and check the network and try again": "test_device.py::test_a_serial_server_that_serves_another_program_is_a_sentence",
        "… is not a port; name a device such as /dev/ttyACM0 or COM3, or sim://link": raises(
            lambda: open_port("nonsense://x")
        ),
        "… is no address of a serial server; type socket://HOST:PORT": raises(
            lambda: open_port("socket://localhost:99999")
        ),
        "cannot open …: speed must be 0 or more, and drift_ppm within 10000": raises(
            lambda: lp.open("sim://link?speed=-1")
        ),
        "the USB device … (…) at … has no serial port. On Ubuntu the braille program brltty takes it: type sudo apt remove brltty, unplug the board and plug it in again. Without brltty, type sudo modprobe …": "test_ports.py::test_a_board_that_brltty_took_is_named_with_its_cure",
    },
    "Readings and filters": {
        "no filter that can be smoothed (…) runs…": raises(
            lambda: Estimator(["tilt"], Rig(), Sensors.MPU6050).smooth()
        ),
        "none of the filters that run estimates a yaw since the start": raises(
            lambda: Estimator(["tilt"], Rig(mag=Mag((0.0, 0.0, 0.0))), Sensors.MPU6050 | Sensors.MAG).hold_heading()
        ),
        "… has no smoother": raises(lambda: create_smoother("tilt", Rig())),
        "… estimates no yaw that a magnetometer could hold": raises(
            lambda: MagneticHeading(create("tilt", Rig()), Mag((0.0, 0.0, 0.0)))
        ),
        "the magnetometer is not calibrated (the rig has no [mag]): the iron of the board would turn the heading by tens of degrees; record it turned through all attitudes, type linkpose calibrate mag RECORDING --rig rig.toml, and add --rig rig.toml": raises(
            lambda: MagneticHeading(create("tilt-inertial", Rig()), Mag())
        ),
        "no magnetometer gives a value: check its wiring, or leave it out": raises(
            lambda: Estimator(["tilt-inertial"], Rig(), Sensors.MPU6050).hold_heading()
        ),
        "… simulates no magnetometer; type --port 'sim://link?mag=1'": typed(
            f"estimate --live --port {SIM} --duration 0.1 --filter tilt-inertial --mag"
        ),
        "no mouse gives counts; if there is one, check its wiring": with_filter(
            Rig(mouse=(Mouse(0.1, 0.0),)), Sensors.MPU6050, count=0
        ),
        "one mouse cannot measure a turn without the MPU-6050's rate: add a second mouse": with_filter(
            Rig(mouse=(Mouse(0.1, 0.0),)), Sensors(0)
        ),
        "mice … all sit at (…, …) m, where they cannot measure a turn. Correct their x_m and y_m in the rig file.": with_filter(
            Rig(mouse=(Mouse(0.1, 0.0), Mouse(0.1, 0.0))), Sensors.MPU6050, count=2
        ),
        "--j2s auto is estimated by …, which does not run; add --filter …": typed(
            f"estimate --live --port {SIM} --duration 0.1 --j2s auto --filter tilt"
        ),
        "…: ….long_axis and ….flexion_axis are parallel": rig("chain", long_axis=[1, 0, 0], flexion_axis=[1, 0, 0]),
        "…: … is …; an axis must not be zero": rig("chain", axis1=[0, 0, 0]),
        "…: … is …; it must be four numbers: [w, x, y, z]": rig("chain", neutral=[1, 0, 0]),
        "…: … is …; a rotation must have length 1": rig("chain", neutral=[2, 0, 0, 0]),
        "…: … is …; no axis may be below 0": rig("noise", gyro_walk_rad_s_sqrts=[-1, 0, 0]),
        "…: joint.j2s_m is zero, the joint's centre; delete it if it is unknown": rig("joint", j2s_m=[0, 0, 0]),
        "…: … is …; it must be between 0 and 0.1 s": rig("imu", delay_s=0.5),
    },
    "Evaluation of long files and takes": {
        "… has more than … rows at about … s: its time_s must increase": "test_evaluation_long.py::test_a_long_reference_whose_stamps_do_not_increase_is_named",
        "… states a rate of … Hz; export the take again": "test_references.py::test_what_is_no_take_is_named",
        "… has no frame with the rigid body: reconstruct and solve it in Motive": body(",,,,,,"),
        "…: the rotation of the rigid body is no unit quaternion: export it as Quaternion": body("0,0,0,2,0,0,0"),
        "…, line 1: unknown length unit …; export in …": markers(lambda t: plate(0, 1, 0), "Ells"),
        "…, line …: … is not a number that a camera system gives": markers(lambda t: plate(0, 1e12, 0)),
        "… is damaged: …; export the take as CSV again": written(read_any, "Format Version,1.23\n" + "9" * 200_000),
        "… has no frame with all three markers: fill their gaps in Motive or your own program": markers(
            lambda t: ",,," + plate(0, 1, 0)[:-6]
        ),
        "…: … is seen in … frames only; no joint can be fitted to that": markers(lambda t: plate(t, 1, 0), count=5),
        "…: … hardly moves, so the joint cannot be located: tilt the link to all sides in the take": markers(
            lambda t: plate(0, 1, 0)
        ),
        "…: … is … cm rms off any sphere: is the joint fixed to the ground?": markers(
            lambda t: plate(*((1 + 0.06 * np.sin(31 * t)) * part for part in (np.sin(9 * t), np.cos(9 * t) * np.cos(4 * t), np.cos(9 * t) * np.sin(4 * t))))
        ),
        "…: the motion of … locates the joint's height to ±… cm only: tilt the link further; turning about the vertical does not help": markers(
            lambda t: plate(np.cos(9 * t), 1.0 + 0.0005 * np.sin(31 * t), np.sin(9 * t))
        ),
    },
    "Localization: values and streams": {
        "… holds laser scans, which need the map they were taken in; add --map MAP.yaml": written(
            lambda path: lp.localize(path, beacons={"1": (1.0, 2.0)}), SCANS, "a.log"
        ),
        "… holds ranges to beacons, whose positions must be known; add --beacons BEACONS.csv": written(
            lambda path: lp.localize(path, map=small_map(path.parent)), EVENTS + "1,range,1,1,\n"
        ),
        "the log does not state where the robot starts; add --start X,Y,HEADING (m, m, rad)": written(
            lambda path: lp.localize(path, beacons={"1": (1.0, 2.0)}),
            EVENTS.replace("0,pose,0,0,0\n", "") + "1,range,1,1,\n",
        ),
        "the beacons are near one line, and the first ranges fit a start at … m; add --start X,Y,0 with the true one, or a beacon off the line": written(
            lambda path: lp.localize(path, beacons={"1": (0.0, 0.0), "2": (4.0, 0.0), "3": (8.0, 0.0)}),
            "time_s,kind,a,b,c\n0,range,1,5,\n0,range,2,3,\n0,range,3,5,\n",
        ),
        "…: the scans fit … places of the map alike, … (m, m, rad) at … s, so the path stays unknown; add the true one as --start X,Y,HEADING, or drive to where the places differ": raises(
            lambda: localize_in(*along_a_symmetric_room())
        ),
        "…: the robot moves too little to be sure of its place: the scans fit … (m, m, rad) best at … s, so the path stays unknown; add the true one as --start X,Y,HEADING, or drive to where the places differ": raises(
            lambda: localize_in(*in_one_place())
        ),
        "… holds no ranges from which a scale or bias could be estimated; leave out --estimate": written(
            lambda path: lp.localize(path, map=small_map(path.parent), estimate=("bias",)), SCANS, "a.log"
        ),
        "… holds no laser scans, which the filter … needs; use --filter ekf": written(
            lambda path: lp.localize(path, beacons={"1": (1.0, 2.0)}, filters=["mcl"]), EVENTS + "1,range,1,1,\n"
        ),
        "the … of … is no longer positive definite; larger noises may prevent this; give larger noises (--range-std, --speed-std, --turn-std) or a larger --alpha": patched(
            "linkpose.localization.kalman.ekf_step", lambda *given: False,
            lambda folder: lp.localize(PLACED, beacons={"1": (1.0, 2.0)}, filters=["ekf"], range_std_m=0.1),
        ),
        "… is not positive definite, so it has no Cholesky factor; lower its correlations or raise its variances": raises(
            lambda: covariance_root(-np.eye(3), "R")
        ),
        "the estimate left all numbers at … s of the log; correct the odometry or velocity before it": "test_localization_cli.py::test_a_velocity_beyond_all_numbers_is_refused",
        "… has no velocity between … and … s, the log's times; record the mice and the log on one clock": odometry_elsewhere,
        "start_std is …; both must be above 0, as a start without uncertainty could not be corrected": options(
            start_std=(0.0, 1.0)
        ),
        "… is …; it must be finite": options(range_std_m=float("inf")),
        "… is …; it must not be beyond …": options(range_std_m=1e12),
        "… is …; it must be above 0": options(range_std_m=0.0),
        "gate is …; it must be a probability between 0 and 1, or None": options(gate=1.0),
        "noise is …; it must be one of …": options(noise="white"),
        "start is …; it must be x, y, heading (m, m, rad) or \"auto\"": options(start="here"),
        "start is …; it must be x, y, heading (m, m, rad)": options(start=(1.0, 2.0)),
        "estimate has …, which is none of …": options(estimate=("speed",)),
        "estimate has … and …:each, which exclude each other; name one": options(estimate=("bias", "bias:each")),
        "beacons has … coordinates for …; give x, y or x, y, z (m)": written(
            lambda path: lp.localize(path, beacons={"1": (1.0,)}), EVENTS
        ),
        "filters has …, which is none of …": written(
            lambda path: lp.localize(path, beacons={"1": (1.0, 2.0)}, filters=["kf"]), EVENTS
        ),
        "… holds no measurements; send the header time_s,kind,a,b,c and rows": raises(
            lambda: list(Stream("ekf", LocalizationOptions(), {}, print).rows([]))
        ),
        "… line …: beacon … is not in the beacon file": raises(
            lambda: list(
                Stream("ekf", LocalizationOptions(), {}, print).rows(["time_s,kind,a,b,c\n", "0,range,7,1,\n"])
            )
        ),
    },
    "Calibration: motion and mice": {
        "the rests give an offset of … m/s² and a scale of …, which no MPU-6050 has: did it move slowly, or is the range set wrong?": raises(
            lambda: fit_sphere(2 * STANDARD_GRAVITY * SIX_SIDES)
        ),
        "the rests do not fit one sphere (residual … m/s² rms): keep the sensor still at each": raises(
            lambda: fit_sphere(STANDARD_GRAVITY * np.concatenate([SIX_SIDES, 1.05 * SIX_SIDES]) + 0 * OFFSET)
        ),
        "the attitudes do not determine all axes: lay the sensor on each of its six sides, and record them": raises(
            lambda: fit_sphere(STANDARD_GRAVITY * np.repeat(SIX_SIDES[:1], 6, axis=0))
        ),
        "the motion is too slow or too short to find J2S: two of its three directions are known to … m or worse; swing the link faster and in all directions": "test_calibration_link.py::test_motion_that_is_too_slow_is_refused",
        "the readings fit no joint that stays in its place (… m/s² rms are left over): fix the joint, and the sensor firmly on the link": "test_calibration_link.py::test_a_sensor_on_no_joint_is_refused",
        "the fit needs an accelerometer with an offset of … m/s² and a scale of …, which no MPU-6050 has: is the joint fixed, the sensor firmly on the link, and the range right?": "test_calibration_link.py::test_a_sensor_that_cannot_be_is_refused",
        "…, too little to calibrate the magnetometer: turn the sensor by hand through all attitudes, each axis up, down and sideways, for a minute, away from iron": raises(
            lambda: calibrate_mag([of_magnetometer(tumbled(5.0, about=(0.0, 0.0, 0.0)))], Rig())
        ),
        "this was not a rest: …. … is unchanged; record again, or add --force to write the figures all the same": "test_calibrate_noise.py::test_what_is_no_rest_is_named_and_not_written",
        "no recording is of a straight line; drive … and add its recording": mice("no line"),
        "no recording is of a full turn; turn the robot once round and add its recording": mice("no turn"),
        "these drives do not determine the scale; measure the length of the line and give it": mice_of(
            _one_mouse_without_length
        ),
        "… has … mice, and the rig file …; connect all of them": mice("a mouse too many"),
        "…: no mouse moves in it; drive a line of known length, or a full turn": mice("no motion"),
        "… has … full turns; more than … cannot be counted with a gyro that may be … % off. Drive … turns or fewer.": mice_of(
            _many_turns
        ),
        "… turns by …°, so it is neither a straight line nor full turns; repeat the drive": mice("half a turn"),
        "…: mouse … counts only …; drive a longer line, of a metre or more": mice_of(_short_line),
        "…: mouse … is away at … s, while the robot moves; repeat the drive": mice("a mouse away"),
        "…: samples were lost before … s, and their counts with them; repeat the drive": mice("lost samples"),
        "… holds no gyro, which distinguishes lines from turns: check the MPU6050's wiring": mice("no gyro"),
        "… begins in motion; stand still for a second, then drive": mice("no rest"),
        "…: mouse … counts … while another counts …; check that it lies flat on the floor and that its plug sits, then repeat the drive": "test_calibrate_mice.py::test_what_is_missing_is_named",
        "line and turn contradict each other: by the turn, the mice count … % … per metre than by the line. Check --length and the x_m and y_m of the mice, and repeat both on a floor on which no mouse slips": "test_calibrate_mice.py::test_what_is_missing_is_named",
        "the … mice contradict one another (… standard deviations, mouse … most of all): check their x_m and y_m in the rig file, the --length of the line, and that no mouse slipped or died": mice_of(
            _contradicting_mice
        ),
    },
    "Flashing": {
        "… is not a board that can be flashed. Pass a device such as /dev/ttyACM0 or COM3": typed(
            "flash --port sim://link"
        ),
        "No UNO bootloader answers at …; nothing was written. It is another board or another port, or the board has no bootloader. See linkpose ports and pass the UNO's port with --port": flashing(),
        "The board at … is no UNO: its processor has the signature …, an ATmega328P has …. Nothing was written. Pass the UNO's port with --port": flashing(
            IN_SYNC, b"\x14\x1e\x94\x06\x10"
        ),
        "… has … bytes, and the board at … has … bytes in front of its bootloader. Nothing was written. Use a smaller firmware, or a board with Optiboot": flashing(
            IN_SYNC, ATMEGA328P, size=0x7F00
        ),
        "Verification failed: address … contains …, and … was written. The bootloader is intact but the firmware is wrong. First run linkpose flash again; if it fails again, replace the board": flashing(
            IN_SYNC, ATMEGA328P, IN_SYNC, IN_SYNC, IN_SYNC, b"\x14" + bytes(128) + b"\x10", size=128
        ),
        "… before anything was written. Check the cable and run linkpose flash again": "../virtual_uno/test_bootloader.py::test_a_cable_pulled_leaves_a_board_that_can_be_flashed",
        "… at … % of …. The bootloader is intact but the firmware is incomplete. Check the cable and run linkpose flash again": flashing(
            *[IN_SYNC, ATMEGA328P, IN_SYNC, IN_SYNC] * 2, size=128
        ),
        "The board at … reports source revision …, but … was written. Check that … is the board that was flashed": "test_flash.py::test_what_answers_after_the_upload_is_checked",
        "The firmware was written and verified, but the handshake failed: …": "test_flash.py::test_what_answers_after_the_upload_is_checked",
        "PlatformIO did not build the firmware (…). Add -v to see all of its output, or run linkpose flash --prebuilt": building(
            lambda firmware: build(firmware, print)
        ),
        "PlatformIO is not installed (pip install platformio)": patched(
            "importlib.util.find_spec", lambda name: None, lambda folder: entered(project("uno"))
        ),
        "PlatformIO cannot download its toolchain (no internet connection?)": building(
            lambda firmware: build(firmware, print), "echo 'HTTPClientError: '; exit 1"
        ),
        "the firmware's sources are missing from this installation": lambda folder: patched(
            "linkpose.flashing.build._PACKAGE", folder / "lib" / "linkpose", lambda _: entered(project("uno"))
        )(folder),  # type: ignore[operator]
        "PlatformIO does not run (…)": building(lambda firmware: build(firmware, print), ""),
        "… is damaged: addresses … to … are missing; nothing was written. Copy the file again": "test_flash.py::test_a_line_missing_from_the_firmware_is_noticed",
    },
    "Pictures and the page": {
        "no file has the filter …; there are …": written(lambda path: plot_tables([read_table(path)], ["mice"]), ESTIMATE),
        "… holds nothing to draw: it has …": written(lambda path: plot_tables([read_table(path)], []), "time_s,a\n0,1\n"),
        "… holds nothing to draw: its quantities are empty in all rows": written(
            lambda path: plot_tables([read_table(path)], []), "time_s,tilt_height_m\n0,\n1,\n"
        ),
        "ports … to … at … are taken; name another port": patched(
            "linkpose.page.page._try_to_bind", _taken, lambda folder: free_port("127.0.0.1")
        ),
        "the page cannot be served at …: …": raises(lambda: free_port("192.0.2.1")),
        "the page cannot be served at …:…: …": raises(
            lambda: Page(("time_s", "tilt_height_m"), Rig(), "", host="192.0.2.1", port=8080)
        ),
        "… holds no estimates; type: linkpose estimate … -o OUT.csv": typed("plot --view {}/a.csv", a="time_s,b\n0,1\n1,1\n"),
        "… holds a reference and no estimates; name a file of estimates as well": typed(
            "plot --view {}/a.csv", a="time_s,height_m\n0,1\n1,1\n"
        ),
    },
    "Simulation and Python values": {
        "there is no motion called …: take …": raises(lambda: LinkRun(motion="dance")),
        "there is no joint …: take …": raises(lambda: ChainRun("knee")),  # type: ignore[arg-type]
        "there is no first joint …: take …": raises(lambda: ChainRun("ball", first_joint="loose")),
        "… s at … Hz are … samples, and … is the limit: simulate at most … s, or at a lower rate": raises(
            lambda: check_length(1e6, 100.0)
        ),
        "there is no magnetic disturbance …: take …, and a magnetometer": raises(
            lambda: LinkRun(mag_disturbance="moon")
        ),
        "a run without an end has no whole truth: give it a duration": raises(lambda: without_end().truth()),
        "a run without an end has no whole recording: give it a duration": raises(lambda: without_end().measurements()),
        "the path … needs a duration": raises(lambda: MiceRun(path="line", duration_s=None)),
        "… mice cannot be: the board serves 1 to …": raises(lambda: MiceRun(mice=())),
        "a duration of … s is none for this path: take … s or more": raises(lambda: MiceRun(duration_s=0.1)),
        "a line of … m cannot be: take 0.01 to 100 m": raises(lambda: MiceRun(path="line", length_m=1e3)),
        "a mouse moves by more counts in a sample than the wire holds; lower counts_per_m": raises(
            lambda: MiceRun(path="drive", duration_s=5.0, mice=(Mouse(0.1, 0.0, counts_per_m=1e9),)).measurements()
        ),
        "there is no mouse … for a fault to befall: there are …": raises(
            lambda: MiceRun(faults=(Fault("lift", 9, 1.0, 2.0),))
        ),
        "six rests do not fit … s: simulate … s or more": raises(lambda: SixSides(3.0)),
        "accel2_m_s2 and gyro2_rad_s belong together: give both or neither": measured(
            np.arange(3), np.zeros((3, 3)), accel2_m_s2=np.zeros((3, 3))
        ),
        "time_s has the shape …; it must be (N,)": measured(np.zeros((3, 3)), np.zeros((3, 3))),
        "time_s is … at index …; times must be finite and must not decrease": measured([0, 2, 1], np.zeros((3, 3))),
        "… has the type …; it must be numbers, in seconds: (t - t[0]) / numpy.timedelta64(1, 's')": "test_api.py::test_measurements_of_ones_own_sensor_are_checked",
        "… is complex; it must be real numbers": "test_api.py::test_measurements_of_ones_own_sensor_are_checked",
        "… is no array of numbers: …": "test_api.py::test_measurements_of_ones_own_sensor_are_checked",
        "source is of the type …; it must be a path, a Recording or Measurements: Measurements.from_imu(time_s, accel_m_s2, gyro_rad_s) makes them from arrays": "test_api.py::test_wrong_arguments_of_estimate_are_named",
        "j2s_m is …, longer than … m; it must be in metres": "test_api.py::test_wrong_arguments_of_estimate_are_named",
        'j2s_m is …, the joint\'s centre; if J2S is unknown, give "auto"': "test_api.py::test_wrong_arguments_of_estimate_are_named",
        "… has the shape …; it must be (…, 3), one row per time": measured(np.arange(3), np.zeros((3, 2))),
    },
    "Wrong usage": {
        "There is no command …. Did you mean …?": typed("estimat"),
        "There is no command …. The commands are …": typed("quux"),
        "--rests lays the sensor on its sides, --still keeps it at rest: leave out one of them": typed(
            "simulate link --rests --still -o a.csv --truth t.csv"
        ),
        "choose one of --prebuilt and --hex": typed("flash --prebuilt --hex a.hex"),
        "--view-host and --view-port go with --view": typed("estimate --live --view-port 8080"),
        "… is no address alone, such as 0.0.0.0; --view-port names the port": typed("plot --view a.csv --view-host a:80"),
        "--view shows a page; leave out --output": typed("plot --view {}/a.csv -o {}/a.png"),
        "… is not …, numbers separated by commas": typed("localize a.csv --start 1"),
        "… is neither off nor a probability between 0 and 1, such as 0.997": typed("localize a.csv --gate 2"),
        "nothing to localize against; add --map MAP.yaml or --beacons BEACONS.csv": typed("localize a.csv"),
        "a stream from standard input does not use …; leave it out": typed("localize - --beacons b.csv --json"),
        "standard input takes --beacons, one --filter ekf or ukf, and no --smooth": typed(
            "localize - --beacons b.csv --smooth"
        ),
        "… is not a rate of the board; choose from …": typed("record --rate 77"),
        "name a RECORDING, or add --live to estimate from the board": typed("estimate"),
        "--live estimates from the board: leave out …, or leave out --live": typed("estimate --live a.csv"),
        "--port, --duration, --record, --raw, --to and the board's settings go with --live": typed(
            "estimate a.csv --port sim://link"
        ),
        "--smooth uses later samples: record first, then type: linkpose estimate RECORDING --smooth": typed(
            "estimate --live --smooth"
        ),
        "--view goes with --live; estimate with -o OUT.csv, then type: linkpose plot --view OUT.csv": typed(
            "estimate a.csv --view"
        ),
        "… is the recording that is read; name another file for the estimates": typed("estimate a.csv -o a.csv"),
        "--from … is not before --to …": typed("evaluate a.csv b.csv --from 2 --to 1"),
        "… has none of the endings …": typed("convert a.csv -o b.xyz"),
        "--label … must consist of letters, digits and _": typed("convert a.csv -o b.trc --label ,"),
        "… is not three numbers; type for example --j2s -0.09,-0.04,1.65 (metres)": typed("estimate a.csv --j2s 1,2"),
        "… takes its three numbers without spaces: type …=…": typed("localize a.csv --start 1 -2 0"),
        "… is longer than … m; J2S is in metres": typed("estimate a.csv --j2s 900,0,0"),
        "--j2s places the sensor in the joint's centre; if J2S is unknown, type --j2s auto": typed(
            "estimate a.csv --j2s 0,0,0"
        ),
        "… is not a number of seconds above 0": typed("record --duration -1"),
        "… is not finite": typed("estimate a.csv --j2s 0,0,inf"),
        "… is beyond …": typed("localize a.csv --range-std 1e300"),
        "… is nearer to 0 than …": typed("localize a.csv --range-std 1e-300"),
        "--j2s-std is the uncertainty of --j2s X,Y,Z: add --j2s X,Y,Z": typed("estimate a.csv --j2s-std 0.01"),
        "… is neither … nor a rig file (.toml)": typed("simulate link --errors x -o a.csv --truth t.csv"),
        "the figures go to the standard output: name a file for the picture": typed("evaluate a.csv b.csv --plot -"),
        "-o - and --json both write to the standard output: leave out one of them": typed("estimate a.csv -o - --json"),
        "--port and --self-test ask the board: leave them out, or leave out …": typed("info a.csv --self-test"),
    },
}  # fmt: skip
