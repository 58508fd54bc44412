"""`calibrate noise` beside allantools, on a public recording of a real MPU-6050 at rest.

    python tests/bench/noise.py [--data FOLDER] [--json]

FOLDER holds mpu6050_static (unmoved-with-x-pointing-forward-10min/*.mat) as its author published it. Each row compares
one axis: the Allan deviation at all averaging times (largest difference), its value at 1 s with the fitted
density, and the bias instability (least deviation / 0.664).
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import allantools
import h5py
import numpy as np
from _report import is_there, print_row, recordings_parser

from linkpose.calibration.allan import FLICKER
from linkpose.calibration.noise import calibrate_noise
from linkpose.calibration.rests import find_rests
from linkpose.recording.reader import Recording
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.mpu6050 import STANDARD_GRAVITY

FOLDER = Path("mpu6050_static") / "unmoved-with-x-pointing-forward-10min"


def load(folder: Path) -> Recording:
    """The recording; its times are arrival times, and its temperature has times of its own."""
    buffers = []
    for file, name in (("accelerometer", "accel"), ("gyroscope", "gyro"), ("temperature", "temperature")):
        with h5py.File(folder / f"mpu6050_{file}.mat") as opened:
            buffers.append(np.array(opened[f"{name}Buffer"]))
    accel, gyro, temperature = buffers
    time_s = accel[0] - accel[0, 0]
    block = Measurements.from_imu(time_s, STANDARD_GRAVITY * accel[1:].T, np.radians(gyro[1:].T))
    block.imu_temp_degC[:] = np.interp(accel[0], *temperature)
    return Recording(folder, block, None, 100.0, {}, [])


def rows(recording: Recording) -> list[dict[str, Any]]:
    found = calibrate_noise([recording])
    rest = max(find_rests(recording.measurements), key=lambda part: part.stop - part.start)
    block, result = recording.measurements[rest], []
    for sensor, axes, values in (("gyro", found.gyro, block.gyro_rad_s), ("accel", found.accel, block.accel_m_s2)):
        for axis, name, column in zip(axes, "xyz", values.T, strict=True):
            begun = time.perf_counter()
            # The peer rounds τ · rate down: a little more keeps the number of samples.
            _, peer, _, _ = allantools.oadev(column, rate=found.rate_hz, data_type="freq", taus=axis.tau_s * (1 + 1e-9))
            peer_s = time.perf_counter() - begun
            second = int(np.argmin(np.abs(axis.tau_s - 1.0)))
            result.append(
                {
                    "bench": f"noise {sensor} {name}",
                    "allan_difference": float(np.abs(axis.deviation / peer - 1).max()),
                    "density": axis.model.density,
                    "peer_at_1_s": float(peer[second]),
                    "instability": axis.model.instability,
                    "peer_instability": float(peer.min()) / FLICKER,
                    "peer": "allantools",
                    "peer_ms": 1e3 * peer_s,
                }
            )
    return result


def main() -> None:
    options = recordings_parser(__doc__).parse_args()
    for row in rows(load(options.data / FOLDER)) if is_there(options.data / FOLDER) else ():
        print_row(row, options.json)


if __name__ == "__main__":
    main()
