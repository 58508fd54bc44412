"""Messages of localization, motion capture, flashing and simulation in the documentation, and what produces each."""

# ruff: noqa: E501  (a message stands in one line)
from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image
from test_localization_scans import elsewhere, flat_with_rooms, localize_in, of_half_the_size, scans_in

import linkpose as lp
from linkpose import estimate
from linkpose.calibration.chain import calibrate_chain
from linkpose.calibration.imu import calibrate_imu
from linkpose.calibration.joint import calibrate_joint
from linkpose.calibration.mag import calibrate_mag
from linkpose.calibration.mice import calibrate_mice
from linkpose.calibration.noise import calibrate_noise
from linkpose.cli import calibrate_mag as mag_command
from linkpose.evaluation.references import read_any
from linkpose.flashing.image import MARK, read_image
from linkpose.localization.events import Log
from linkpose.localization.localizer import Settings, check
from linkpose.localization.logs import read_log
from linkpose.localization.map_check import check_map
from linkpose.localization.maps import load_map
from linkpose.localization.noise import check_correlation
from linkpose.localization.options import LocalizationOptions
from linkpose.localization.plausibility import check_units
from linkpose.localization.stream import Stream
from linkpose.localization.tables import Truth, read_beacons, read_truth, score
from linkpose.localization.ukf import Transform
from linkpose.recording.reader import Recording, load_recording
from linkpose.sensors.measurements import Floats
from linkpose.sensors.rig import Rig
from linkpose.simulation.link import LinkRun
from linkpose.simulation.mice import Fault, MiceRun

Producer = Callable[[Path], object]


def reading(read: Callable[[Path], object], text: str | bytes, name: str = "a.csv") -> Producer:
    """What `read` makes of a file with this text."""

    def run(folder: Path) -> object:
        (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())
        return read(folder / name)

    return run


def carmen(text: str) -> Producer:
    return reading(read_log, text, "a.log")


EVENTS = "time_s,kind,a,b,c\n"


def events(rows: str) -> Producer:
    return reading(read_log, EVENTS + rows)


def log_of(rows: str, then: Callable[[Log], object]) -> Producer:
    return reading(lambda path: then(read_log(path).events), EVENTS + rows)


BEACONS = {"1": (0.0, 0.0, 0.0), "2": (5.0, 0.0, 0.0)}


TWICE = "0,pose,0,0,0\n" + "".join(f"{i % 15},range,1,5,\n" for i in range(30))  # the clock is set back once


def units(rows: str) -> Producer:
    return log_of(rows, lambda log: check_units(log, BEACONS, "a.csv"))


def checked(rows: str) -> Producer:
    return log_of(rows, lambda log: check(log, "ekf", Settings(), None, BEACONS, "a.csv"))


def map_file(text: str, pixels: np.ndarray | bytes | None = None) -> Producer:
    """A map of 4 x 4 cells, a wall around free space unless other pixels are given."""
    wall = np.array([[0, 0, 0, 0], [0, 254, 254, 0], [0, 254, 254, 0], [0, 0, 0, 0]], np.uint8)

    def run(folder: Path) -> object:
        if isinstance(pixels, bytes):
            (folder / "m.png").write_bytes(pixels)
        else:
            Image.fromarray(wall if pixels is None else pixels).save(folder / "m.png")
        return reading(load_map, text, "m.yaml")(folder)

    return run


MAP = "image: m.png\nresolution: 0.1\norigin: [0, 0, 0]\n"


def path_of(*times: float) -> Truth:
    return Truth(np.array(times), np.zeros((len(times), 2)), None)


def scored(times: list[float], truth: Truth) -> Producer:
    return lambda folder: score(np.array(times), np.zeros((len(times), 2)), None, truth)


def trc(text: str) -> Producer:
    return reading(read_any, text, "a.trc")


def trc_take(names: str = "a\t\t\tb\t\t\tc\t\t", units: str = "mm", row: str = "1\t0\t" + "1\t" * 9) -> str:
    facts = f"DataRate\tUnits\n100\t{units}\n"
    return f"PathFileType\t4\ta.trc\n{facts}Frame#\tTime\t{names}\n\t\tX1\n" + (row and row + "\n")


def motive(*rows: str) -> Producer:
    return reading(read_any, "\n".join(rows) + "\n")


MOTIVE = "Format Version,1.23,Length Units,Meters"


def hex_line(address: int, payload: bytes, kind: int = 0) -> str:
    body = bytes([len(payload), address >> 8, address & 255, kind]) + payload
    return ":" + (body + bytes([-sum(body) & 255])).hex().upper() + "\n"


def firmware(text: str) -> Producer:
    return reading(read_image, text, "f.hex")


END = hex_line(0, b"", 1)


def raises(function: Callable[[], object]) -> Producer:
    return lambda folder: function()


IMU = "time_s,accel_x_m_s2,accel_y_m_s2,accel_z_m_s2,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s\n"


def imu(motion: float, then: Callable[[list[Recording]], object], seconds: float = 6.0) -> Producer:
    """What a calibration makes of a sensor that swings with this amplitude (rad/s and m/s²) at 100 Hz."""
    rng, t = np.random.default_rng(1), np.arange(0, seconds, 0.01)
    rows = np.column_stack([t, *(rng.normal(0, 0.003, (6, len(t))) + motion * np.sin(9 * t + np.arange(6)[:, None]))])
    rows[:, 3] += 9.81
    text = IMU + "".join(",".join(f"{value:.6f}" for value in row) + "\n" for row in rows.tolist())
    return reading(lambda path: then([load_recording(path)]), text)


def spread(count: int, height: float) -> Floats:
    """Unit vectors (count, 3), even over the part of the sphere between z = 1 and 1 − height."""
    at = np.arange(count)
    z, around = 1 - height * (at + 0.5) / count, math.pi * (1 + math.sqrt(5)) * at
    return np.column_stack([np.sqrt(1 - z**2) * np.cos(around), np.sqrt(1 - z**2) * np.sin(around), z])


def magnetometer(directions: Floats) -> Producer:
    """`calibrate mag` of readings (N, 3) in multiples of 50 µT, with noise, at 100 Hz."""

    def run(folder: Path) -> None:
        n = len(directions)
        still = np.column_stack([np.arange(n) / 100, np.zeros((n, 2)), np.full(n, 9.81), np.zeros((n, 3))])
        field = 50 * directions + np.random.default_rng(1).normal(0, 0.2, (n, 3))
        names = IMU.strip() + ",mag_x_uT,mag_y_uT,mag_z_uT,mag_fresh"
        rows = np.column_stack([still, field, np.ones(n)])
        np.savetxt(folder / "a.csv", rows, "%.6f", delimiter=",", header=names, comments="")
        mag_command.command.main([str(folder / "a.csv"), "--rig", str(folder / "rig.toml")], standalone_mode=False)

    return run


def two_sensors(step_s: float, motion: float = 1.0) -> Producer:
    """`calibrate chain` of two sensors that move without a common joint, at this share of 3 rad/s and 3 m/s²."""
    t, rng = np.arange(0, 20, step_s), np.random.default_rng(1)
    accel, gyro, gyro2 = (3 * motion * np.sin(5 * t[:, None] + rng.uniform(0, 6, 3)) for _ in range(3))
    accel[:, 2] += 9.81
    accel2 = 10 * motion * rng.standard_normal(accel.shape)
    block = lp.Measurements.from_imu(t, accel, gyro, accel2_m_s2=accel2, gyro2_rad_s=gyro2)
    return raises(lambda: calibrate_chain([Recording(Path("a.csv"), block, None, 1 / step_s, {}, [])], Rig()))


def joint(**given: object) -> Producer:
    return lambda folder: estimate(LinkRun(duration_s=1.0).measurements(), ["tilt"], **given)  # type: ignore[arg-type]


TOO_LITTLE = ", too little to calibrate the magnetometer: turn the sensor by hand through all attitudes, …"
# In the order of the page. Text -> what produces it.
MORE: dict[str, dict[str, Producer]] = {
    "Localization": {
        "… holds no ODOM, FLASER or ROBOTLASER1 lines; give a CARMEN log or a CSV log": carmen("PARAM robot 1\n"),
        "… line …: … is cut short, … of … words; complete or delete the line": carmen("FLASER 2 2.5 2.5 1\nODOM\n"),
        "… line …: … is no number of readings; correct or delete the line": carmen("FLASER 1.5 2.5\n"),
        "cannot read the log …: …": lambda folder: read_log(folder / "none.log"),
        "… holds no measurements; a log has the header … and one row a measurement": events(""),
        "… line …: the header is …; it must be …": reading(read_log, "a,b\n1,2\n"),
        "… line …: unknown kind …; known kinds are …": events("0,sonar,1,1,1\n"),
        "… line …: … needs …; complete or delete the row": events("0,odometry,1,,\n"),
        "… line …: … is not a number; correct or delete the row": events("0,odometry,fast,0,\n"),
        "… line …: the clock jumps back from … to … s; split the log at this line": events(TWICE),
        "… line …: the beams reach from … to … rad, as if in degrees; multiply start angle, field of view and step by 0.0174533 to give radians": carmen(
            "ROBOTLASER1 0 -90 180 1 80 0 0 3 1 1 1 0 0 0 0 0 0 0 0 0 0 0 0 1 a 1\n"
        ),
        "…: the ranges cannot be metres (median …); divide millimetres by 1000, or centimetres by 100": carmen(
            "FLASER 3 2500 2600 2700 0 0 0 0 0 0 1 a 1\n"
        ),
        "…: the heading of …": carmen(
            "".join(f"ODOM {math.cos(i / 9)} {math.sin(i / 9)} {-i / 9} 0 0 0 {i + 1} a 1\n" for i in range(60))
        ),
        "standard input line …: the clock jumps back from … to … s; restart the stream": raises(
            lambda: list(Stream("ekf", LocalizationOptions(), BEACONS, print).rows([EVENTS, *TWICE.splitlines(True)]))
        ),
        "… is not a CSV file: …; give a log with the header …": events("0,odometry," + "9" * 200_000),
        "… line …: … and … can be read in two ways; save the log with one decimal mark and without separators of thousands": (
            reading(read_log, "time_s;kind;a;b;c\n0;odometry;1,5;0;\n1;odometry;1.5;0;\n")
        ),
        "… holds no measurements; record some first": raises(lambda: check([], "ekf", Settings(), None, BEACONS)),
        "… mixes a robot's odometry with a vehicle's …; delete the rows of the one or of the other": checked(
            "0,odometry,1,0,\n1,depth,3,,\n"
        ),
        "… line …: … to beacon …, whose place is not known (known are …); add it to the beacon file or delete the row": (
            checked("0,pose,0,0,0\n0,odometry,1,0,\n1,range,7,3,\n")
        ),
        "…: the ranges look like … (median … among beacons … m apart); divide them by … to give metres": units(
            "".join(f"{t},range,1,3000,\n" for t in range(5))
        ),
        "…: the times look like milliseconds (… apart); divide them by 1000 to give seconds": units(
            "".join(f"{100 * t},odometry,1,0,\n" for t in range(30))
        ),
        "… line …: the … … looks like degrees; multiply angles by 0.0174533 to give radians": units("0,pose,0,0,90\n"),
        "… line …: roll and pitch look like degrees; multiply angles by 0.0174533 to give radians": units(
            "0,attitude,45,0,0\n"
        ),
        "…: the turn rates look like degrees per second (5 % are above …); multiply them by 0.0174533 to give rad/s": (
            units("".join(f"{t / 10},odometry,1,90,\n" for t in range(30)))
        ),
        "… has the header …; a beacon file has id,x_m,y_m or id,x_m,y_m,z_m": reading(read_beacons, "a,b\n1,2\n"),
        "… line …: the row has no id; complete or delete it": reading(read_beacons, "id,x_m,y_m\n,1,2\n"),
        "… line …: beacon … is listed twice; give each its own id": reading(
            read_beacons, "id,x_m,y_m\n5,0,0\n05,1,1\n"
        ),
        "…, line …: … is no finite number; complete or delete the row": reading(read_truth, "time_s,x_m,y_m\n0,,1\n"),
        "…: … found no pose that explains the scans: …": raises(lambda: localize_in(*elsewhere())),
        "… applied none of the measurements (… rejected), so there is no estimate; check the units (m, s, rad), the start, and the places of the beacons or the map": (
            log_of("0,pose,0,0,0\n1,range,1,90,\n", lambda log: lp.localize(log, beacons=BEACONS))
        ),
        "the pose was never known, so there is nothing to compare with the truth": scored([], path_of(0.0, 1.0)),
        "the true path (… to … s) has no pose at the log's times (… to … s); give the truth of this log": scored(
            [0.0, 0.5], path_of(7.0, 7.5)
        ),
        "only … of … estimates lie between true poses at most … s apart, too few for a score; give a truth with fewer "
        "gaps": scored([t / 10 for t in range(100)], path_of(*np.arange(10) / 10, 9.8, 9.9)),
        "… … makes the … x … covariance not positive definite, so it has no Cholesky factor; choose a value above … and "
        "below 1": raises(lambda: check_correlation(1.5, 3, "--correlation")),
        "κ … gives the centre point a negative weight, and P may cease to be positive definite; use 0 or more": raises(
            Transform(kappa=-1.0).check
        ),
        "α … is not within 0 to 1; try 0.1": raises(Transform(alpha=2.0).check),
        "β … is below 0; 2 is best for Gaussian errors": raises(Transform(beta=-1.0).check),
    },
    "Maps": {
        "…: … of the beams end at a wall of the map, and … if the map is …; correct the resolution in its YAML file": raises(
            lambda: check_map(list(scans_in(flat_with_rooms())[:1]), of_half_the_size(flat_with_rooms()), 0.2, "a.log")
        ),
        "cannot read the map …: …": lambda folder: load_map(folder / "none.yaml"),
        "… is not YAML; give the map's .yaml file, not its image": map_file("image: [\n"),
        "… uses YAML aliases (*name); write each value out": map_file("image: &a m.png\nresolution: *a\n"),
        "… is larger than … bytes, so it is no map file; give the map's .yaml file, not its image": map_file(
            "#" * 2_000_000
        ),
        "… names no image; a map file has image, resolution and origin": map_file("resolution: 0.1\n"),
        "…: resolution is …; give the size of a cell in metres, such as 0.05": map_file(MAP.replace("0.1", "-1")),
        "…: origin is …; it must be [x, y, yaw] of the lower left corner (m, m, rad)": map_file(
            MAP.replace("[0, 0, 0]", "[0]")
        ),
        "…: the yaw of origin is …, more than a turn in radians; if it is in degrees, write …": map_file(
            MAP.replace("[0, 0, 0]", "[0, 0, 90]")
        ),
        "…: negate is …; it must be 0 or 1": map_file(MAP + "negate: 2\n"),
        "…: mode is …; it must be trinary, scale or raw": map_file(MAP + "mode: tri\n"),
        "…: free_thresh … must be below occupied_thresh …, both within 0 to 1": map_file(MAP + "free_thresh: 0.9\n"),
        "…: … is …; it must be a number": map_file(MAP.replace("0.1", "big")),
        "…: no cell of the map is a wall; check negate and occupied_thresh": map_file(
            MAP, np.full((4, 4), 254, np.uint8)
        ),
        "…: no cell of the map is free; check negate and free_thresh": map_file(MAP, np.zeros((4, 4), np.uint8)),
        "… has … x … cells in the form …, more than … MB; cut the map to the part that is driven in, or save it with 8 bits a cell": map_file(
            MAP, b"P5 40000 40000 255\n"
        ),
        "… holds floating-point cells; save it with 8 or 16 bits a cell": map_file(MAP, b"Pf\n4 4\n-1.0\n" + bytes(64)),
        "…, named in …, is no regular file; name a PGM or PNG file": map_file(MAP.replace("m.png", ".")),
        "… is no image that can be read; … must name a PGM or PNG file": map_file(MAP.replace("m.png", "m.yaml")),
        "cannot read the map's image …, named in …: …": map_file(MAP.replace("m.png", "none.png")),
    },
    "Motion capture": {
        "… has no marker names in line 4: export the take as TRC again": trc("PathFileType\n"),
        "… has no frame: export the take with its frames": trc(trc_take(row="")),
        "…, line …: a field is not a number; export the take again": trc(trc_take(row="1\t0\tx")),
        "…: unknown unit … of length; export in m or mm": trc(trc_take(units="ells")),
        "… has … named markers; three are needed: at the sensor, along its x axis, and on the side of its y axis": trc(
            trc_take(names="a\t\t")
        ),
        "… holds positions that no camera system gives; export the take again": trc(
            trc_take(row="1\t0\t" + "1e12\t" * 9)
        ),
        "… is damaged or no C3D file: …; export the take again": reading(read_any, b"\x02\x50" + bytes(600), "a.c3d"),
        "… has no row that begins with Frame,Time (Seconds): export the take as CSV again": motive(MOTIVE, "a,b"),
        "… has a header but no frame: export the take with its frames": motive(MOTIVE, "Frame,Time (Seconds),X,Y,Z"),
        "… has … labeled markers with X, Y, Z; three are needed: …": motive(
            MOTIVE, "Frame,Time (Seconds),X,Y,Z", "0,0,1,1,1"
        ),
    },
    "Calibration": {
        "there is no rest of a second or more in …: record the sensor lying still": imu(0.0, calibrate_imu, 1.0),
        "…: the sensor is never at rest; where it is stillest, the accelerometer varies by … m/s² and the gyro by … rad/s (1σ): lay it down, away from running motors": imu(
            3.0, calibrate_imu
        ),
        "…: the longest rest lasts … s, too short: leave the sensor on each side for 3 s": imu(0.0, calibrate_imu, 1.8),
        "…: the sensor is saturated at each rest; record with a larger range": "test_calibration_link.py::test_saturated_rests_are_left_out",
        "the gyro reads … rad/s at rest, which no MPU-6050 does: does it turn steadily, or is the range set wrong?": "test_calibration_link.py::test_a_gyro_that_turns_at_rest_is_refused",
        "only … s show motion; swing the link for half a minute or more, in all directions": imu(
            0.0, lambda found: calibrate_joint(found, Rig())
        ),
        "…: there is no rest; lay the sensor on a firm table, and record it untouched": imu(3.0, calibrate_noise),
        "…: the longest rest lasts … s, and noise needs … s or more (an hour for the random walk); record the sensor lying untouched for longer": imu(
            0.0, calibrate_noise
        ),
        "…: there is no magnetometer; check its wiring, and record again": imu(
            0.0, lambda found: calibrate_mag(found, Rig())
        ),
        "…: … magnetometer readings are too few; record half a minute or more": magnetometer(np.eye(3)),
        f"the readings hardly change{TOO_LITTLE}": magnetometer(np.tile([0.0, 0.0, 1.0], (500, 1))),
        f"the attitudes of the recording do not determine the hard iron{TOO_LITTLE}": magnetometer(
            spread(500, 2.0) * [1.0, 1.0, 0.0]
        ),
        f"the recording covers … % of all attitudes{TOO_LITTLE}": magnetometer(
            np.concatenate([spread(1000, 0.1), -spread(1000, 0.1)])
        ),
        "the field of … µT is not the earth's (… to … µT): a magnet or iron is near the sensor. … is unchanged; record elsewhere, or add --force": magnetometer(
            2.0 * spread(500, 2.0)
        ),
        "…: a chain needs a second inertial sensor, and a recording has none": imu(
            0.0, lambda found: calibrate_chain(found, Rig())
        ),
        "…: nowhere is a second with … samples or more; record again": two_sensors(1.0),
        "only … s show motion; move both links for half a minute or more, in all directions that the joint allows": two_sensors(
            0.01, 0.0
        ),
        "the readings fit no joint between the two sensors (… m/s² rms are left over): fix each sensor firmly on its own link, on either side of one joint": two_sensors(
            0.01
        ),
        "the rig file lacks the positions of the mice; add one [[mouse]] table with x_m and y_m for each port": imu(
            0.0, lambda found: calibrate_mice(found, Rig(), 1.0)
        ),
    },
    "Firmware files": {
        "… is not an Intel HEX file; nothing was written": firmware("Firmware für den UNO\n"),
        "… is damaged, line …: …; nothing was written. Copy the file again": firmware(":0000\n"),
        "… is damaged: …; nothing was written. Copy the file again": firmware(
            hex_line(0, bytes(16)) + hex_line(64, bytes(16)) + END
        ),
        "… is cut off: the end record is missing; nothing was written. Copy the file again": firmware(
            hex_line(0, bytes(16))
        ),
        "…, line …: address … lies beyond the … bytes that an UNO has for a program. The file is for another board; "
        "nothing was written": firmware(hex_line(0xFFF0, bytes(16)) + END),
        "… is not linkpose's firmware; nothing was written. linkpose flash builds it": firmware(
            hex_line(0, bytes(16)) + END
        ),
        "… contains firmware …, which does not match this linkpose …; nothing was written. linkpose flash builds the "
        "matching one": firmware(hex_line(0, MARK) + hex_line(len(MARK), bytes(20)) + END),
    },
    "Simulation and values": {
        "there is no Test …: take 1, 2 or 3": raises(lambda: LinkRun(test=4)),
        "the seed is …: take a whole number from 0 up": raises(lambda: LinkRun(seed=-1)),
        "a duration of … s is too short to move the link: take 1 s or more": raises(lambda: LinkRun(duration_s=0.1)),
        "the board samples at 50 to 500 Hz, not at … Hz": raises(lambda: MiceRun(rate_hz=5.0)),
        "there are no errors called …: take …": raises(lambda: LinkRun(errors="some")),
        "a J2S of … m is no link: its length must be 0.01 to 10 m": raises(lambda: LinkRun(j2s_m=(0.0, 0.0, 0.0))),
        "there is no path called …: take …": raises(lambda: MiceRun(path="spiral")),
        "… is no fault; write KIND:MOUSE:FROM-TO in seconds, as lift:2:5-8": raises(lambda: Fault.parse("lift")),
        "… is no fault; KIND is …, and FROM is before TO": raises(lambda: Fault.parse("fly:1:1-2")),
        "cannot open …: there is no simulated board …; type …": raises(lambda: lp.open("sim://submarine")),
        "cannot open …: … has no option …; it has …": raises(lambda: lp.open("sim://link?sede=1")),
        "cannot open …: j2s must be three numbers: j2s=X,Y,Z in metres": raises(lambda: lp.open("sim://link?j2s=1,2")),
        "cannot open …: …=… is not a number": raises(lambda: lp.open("sim://link?seed=x")),
        'j2s_m is …; it must be three numbers (m) or "auto"': joint(j2s_m="long"),
        "j2s_m is …; it must be three finite numbers (m)": joint(j2s_m=(0.0, np.nan, 1.0)),
        "j2s_std_m is …; it must be above 0 (m)": joint(j2s_m=(0.0, 0.0, 1.0), j2s_std_m=0.0),
        "j2s_std_m describes a J2S that is given: give j2s_m too": joint(j2s_std_m=0.1),
        "…: … is …; it must be three numbers: [x, y, z]": raises(
            lambda: Rig.from_dict({"joint": {"j2s_m": 1}}, "rig.toml")
        ),
        "…: … is …; each axis must be above 0": raises(
            lambda: Rig.from_dict({"imu": {"accel_scale": [0, 1, 1]}}, "rig.toml")
        ),
    },
}
