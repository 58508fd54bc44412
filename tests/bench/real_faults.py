"""Faults of real recordings added to public trials: which filter diverges, beside VQF on the same readings.

    python tests/bench/real_faults.py [--data FOLDER] [--json] [--only TEXT]

The trials are those of real_data.py. Each fault is one that users meet: an uncalibrated gyro, a start in motion, gaps,
lost samples, saturation, vibration. VQF takes a constant rate, so missing rows are interpolated for it, which favours
it. A row gives the root mean square and the worst tilt error after `SETTLE_S`, and within 2σ the share of the errors of
a height one metre along (1, 1, 1) / √3. `diverged` marks a filter beyond 5° rms where VQF is below 2°.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from _report import print_rows, recordings_parser
from numpy.typing import NDArray
from real_data import SETS, Case, block_of, imu_of, tilt_from, vqf_tilt

from linkpose import filters
from linkpose.sensors.measurements import Floats, Measurements
from linkpose.sensors.rig import Joint, Rig
from linkpose.wire.messages import SampleFlags

SETTLE_S = 10.0
LEVER_M = (3**-0.5, 3**-0.5, 3**-0.5)


class Faulty(NamedTuple):
    """A trial with a fault: readings of all its samples, and which of them arrived."""

    accel_m_s2: Floats
    gyro_rad_s: Floats
    flags: NDArray[np.uint32]
    arrived: NDArray[np.bool_]


def _sound(case: Case) -> Faulty:
    n = len(case.time_s)
    return Faulty(case.accel_m_s2.copy(), case.gyro_rad_s.copy(), np.ones(n, np.uint32), np.ones(n, np.bool_))


def uncalibrated_gyro(case: Case) -> Faulty:
    """10 °/s on an axis, the half of what a data sheet allows."""
    return _sound(case)._replace(gyro_rad_s=case.gyro_rad_s + np.radians([10.0, -10.0, 7.0]))


def start_in_motion(case: Case) -> Faulty:
    """Switched on after 40 % of the trial."""
    return _sound(case)._replace(arrived=np.arange(len(case.time_s)) > 0.4 * len(case.time_s))


def gaps(length_s: float) -> Callable[[Case], Faulty]:
    """Three gaps of one length."""

    def fault(case: Case) -> Faulty:
        arrived = np.ones(len(case.time_s), np.bool_)
        for share in (0.35, 0.55, 0.8):
            begin = share * case.time_s[-1]
            arrived &= ~((case.time_s >= begin) & (case.time_s < begin + length_s))
        return _sound(case)._replace(arrived=arrived)

    return fault


def lost(case: Case) -> Faulty:
    """2 % of the samples, singly."""
    return _sound(case)._replace(arrived=np.random.default_rng(1).random(len(case.time_s)) > 0.02)


def saturated_accel(case: Case) -> Faulty:
    """A range that the largest 3 % of the readings exceed, flagged."""
    limit = max(float(np.quantile(np.abs(case.accel_m_s2).max(axis=1), 0.97)), 10.5)
    clipped = (np.abs(case.accel_m_s2) > limit).any(axis=1)
    flags = np.where(clipped, np.uint32(1 | SampleFlags.ACCEL_SATURATED), np.uint32(1))
    return _sound(case)._replace(accel_m_s2=np.clip(case.accel_m_s2, -limit, limit), flags=flags)


def saturated_gyro(case: Case) -> Faulty:
    """A range that the largest 1 % of the rates exceed, flagged."""
    limit = float(np.quantile(np.abs(case.gyro_rad_s).max(axis=1), 0.99))
    clipped = (np.abs(case.gyro_rad_s) > limit).any(axis=1)
    flags = np.where(clipped, np.uint32(1 | SampleFlags.GYRO_SATURATED), np.uint32(1))
    return _sound(case)._replace(gyro_rad_s=np.clip(case.gyro_rad_s, -limit, limit), flags=flags)


def vibration(case: Case) -> Faulty:
    """A motor: 5 m/s² and 0.1 rad/s (rms of an axis) of broad-band noise, in bursts of 5 s."""
    rng, n = np.random.default_rng(2), len(case.time_s)
    on = (np.sin(np.pi * case.time_s / 5.0) > 0)[:, None]
    accel, gyro = case.accel_m_s2 + on * rng.normal(0, 5.0, (n, 3)), case.gyro_rad_s + on * rng.normal(0, 0.1, (n, 3))
    return _sound(case)._replace(accel_m_s2=accel, gyro_rad_s=gyro)


FAULTS: dict[str, Callable[[Case], Faulty]] = {
    "none": _sound,
    "uncalibrated gyro": uncalibrated_gyro,
    "start in motion": start_in_motion,
    "gaps of 1 s": gaps(1.0),
    "gaps of 1.9 s": gaps(1.9),
    "gaps of 3 s": gaps(3.0),
    "2 % lost": lost,
    "saturated accelerometer": saturated_accel,
    "saturated gyro": saturated_gyro,
    "vibration": vibration,
}


def _block(case: Case, faulty: Faulty) -> Measurements:
    whole = replace(block_of(case), flags=faulty.flags)
    whole = replace(whole, accel_m_s2=faulty.accel_m_s2, gyro_rad_s=faulty.gyro_rad_s)
    return Measurements(*(np.ascontiguousarray(getattr(whole, n)[faulty.arrived]) for n in whole.__slots__))


def ours(name: str, case: Case, faulty: Faulty) -> tuple[Floats, Floats, int]:
    """Tilts (N, 3), NaN where no sample arrived, height and its σ (N, 2) (m), and the number of restarts."""
    rig = Rig(joint=case.joint or Joint(LEVER_M, 1e-6), imu=imu_of(name, case.delay_s))
    made = filters.create(name, rig)
    found = np.full((len(case.time_s), 4), np.nan)
    found[faulty.arrived] = made.process(_block(case, faulty))[:, :4]
    return tilt_from(found[:, 2], found[:, 3]), found[:, :2], int(getattr(made, "restarts", 0))


def peer(case: Case, faulty: Faulty) -> Floats:
    """VQF's tilts (N, 3), NaN where no sample arrived."""
    first = int(np.argmax(faulty.arrived))
    at, since = case.time_s[faulty.arrived], case.time_s[first:]
    accel, gyro = (
        np.ascontiguousarray(np.column_stack([np.interp(since, at, c) for c in readings[faulty.arrived].T]))
        for readings in (faulty.accel_m_s2, faulty.gyro_rad_s)
    )
    tilt = np.full((len(case.time_s), 3), np.nan)
    tilt[first:] = vqf_tilt(case._replace(time_s=since, accel_m_s2=accel, gyro_rad_s=gyro), offline=False)
    tilt[~faulty.arrived] = np.nan
    return tilt


def _scores(case: Case, faulty: Faulty, tilt: Floats) -> tuple[float, float]:
    settled = tilt.copy()
    settled[case.time_s < case.time_s[np.argmax(faulty.arrived)] + SETTLE_S] = np.nan
    errors = case.errors_deg(settled)
    return float(np.sqrt(np.nanmean(errors**2))), float(np.nanmax(np.abs(errors)))


def rows(case: Case) -> Iterator[dict[str, object]]:
    """The scores of each fault and filter on one trial."""
    for fault, make in FAULTS.items():
        faulty = make(case)
        vqf_deg, vqf_worst_deg = _scores(case, faulty, peer(case, faulty))
        for name in ("joint-inertial", "tilt-inertial") if case.joint else ("tilt-inertial",):
            tilt, height, restarts = ours(name, case, faulty)
            deg, worst_deg = _scores(case, faulty, tilt)
            within = None
            if case.truth is not None and name == "tilt-inertial" and not case.joint:
                error = np.abs(height[:, 0] - case.truth @ LEVER_M)
                known = np.isfinite(error)
                within = float((error[known] < 2 * height[known, 1]).mean())
            yield {
                "data": case.name, "fault": fault, "filter": name, "deg": deg, "worst_deg": worst_deg,
                "vqf_deg": vqf_deg, "vqf_worst_deg": vqf_worst_deg, "within_2sigma": within, "restarts": restarts,
                "diverged": deg > 5.0 and vqf_deg < 2.0,
            }  # fmt: skip


def main() -> None:
    list(print_rows(SETS, rows, recordings_parser(__doc__).parse_args()))


if __name__ == "__main__":
    main()
