"""The board's barometer, whichever is fitted: uncompensated readings to temperature and pressure."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from linkpose.sensors import bmp180, bmp280
from linkpose.wire.messages import DeviceFamily, Hello

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_BARO = 2  # index in HELLO's devices


class Barometer(NamedTuple):
    """A barometer with the calibration words that it reported."""

    family: int  # wire.messages.DeviceFamily
    words: tuple[int, ...]  # (12,) HELLO's baro_words
    oversampling: int

    @staticmethod
    def of(hello: Hello) -> Barometer:
        """The barometer that a HELLO announces."""
        return Barometer(hello.devices[_BARO].family, hello.baro_words, hello.baro_oversampling)

    @property
    def is_sound(self) -> bool:
        """Whether a supported barometer is fitted and its calibration was read."""
        if self.family == DeviceFamily.BMP280:
            return self.words[0] not in (0, 0xFFFF) and self.words[3] not in (0, 0xFFFF)
        return self.family == DeviceFamily.BMP180 and bmp180.is_sound(bmp180.Bmp180Calibration.of(self.words))

    def compensate(
        self, ut: NDArray[np.int64], up: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Temperature (N,) in degC and pressure (N,) in Pa from raw readings (N,); NaN where it is impossible."""
        import numpy as np

        if self.family == DeviceFamily.BMP280:
            with np.errstate(all="ignore"):
                temperature, pressure = bmp280.compensate(
                    ut.astype(np.float64), up.astype(np.float64), bmp280.Bmp280Calibration.of(self.words)
                )
            wrong = ~np.isfinite(pressure)
            return np.where(wrong, np.nan, temperature), np.where(wrong, np.nan, pressure)
        words = bmp180.Bmp180Calibration.of(self.words)
        wrong = bmp180.is_impossible(ut, words)
        tenths, pascals = bmp180.compensate(np.where(wrong, words.ac6, ut), up, words, self.oversampling)
        return np.where(wrong, np.nan, tenths / 10), np.where(wrong, np.nan, pascals.astype(np.float64))

    def compensate_one(self, ut: int, up: int) -> tuple[float, float]:
        """As `compensate`, for one reading, as a live stream has it.

        Python's integers take a tenth of the time that NumPy needs for arrays of length 1. Below 2³¹ Pa no intermediate
        result exceeds 64 bits, so that arrays give the same numbers.
        """
        if self.family == DeviceFamily.BMP180:
            try:
                words = bmp180.Bmp180Calibration.of(self.words)
                tenths, pascals = bmp180.compensate(ut, up, words, self.oversampling)
            except ZeroDivisionError:
                return math.nan, math.nan
            if abs(pascals) < 1 << 31:
                return tenths / 10, float(pascals)
        import numpy as np

        temperature, pressure = self.compensate(np.array([ut]), np.array([up]))
        return float(temperature[0]), float(pressure[0])
