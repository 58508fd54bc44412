"""Magnetometers of the GY-87: raw counts to microtesla, in the chip's own axes."""

from __future__ import annotations

from linkpose.wire.messages import DeviceFamily

MAG_DECIMALS = 3  # µT: finer than the finest count

# µT per count as the firmware sets them: HMC5883L at ±1.3 G, 1090 counts/G (900405 rev E, table 9); QMC5883L at ±8 G,
# 3000 counts/G (13-52-04, table 2); QMC5883P at ±8 G, 3750 counts/G (13-52-19, table 2). 1 G = 100 µT.
SCALES_UT = {
    DeviceFamily.HMC5883L: 100 / 1090,
    DeviceFamily.QMC5883L: 100 / 3000,
    DeviceFamily.QMC5883P: 100 / 3750,
}


def scale(family: int) -> float:
    """µT per count of a family; NaN if the board has no supported magnetometer."""
    return SCALES_UT.get(DeviceFamily(family), float("nan"))
