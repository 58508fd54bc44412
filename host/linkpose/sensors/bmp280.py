"""BMP280: compensation of the uncompensated readings with the sensor's own calibration words."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, TypeVar

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Number = TypeVar("Number", float, NDArray[np.float64])


class Bmp280Calibration(NamedTuple):
    """The twelve words of the BMP280's memory, dig_T1 to dig_P9."""

    t1: int
    t2: int
    t3: int
    p1: int
    p2: int
    p3: int
    p4: int
    p5: int
    p6: int
    p7: int
    p8: int
    p9: int

    @staticmethod
    def of(words: tuple[int, ...]) -> Bmp280Calibration:
        """From HELLO's `baro_words`: unsigned, in the order of the memory. dig_T1 and dig_P1 are unsigned."""
        return Bmp280Calibration(*(w - 0x10000 if w & 0x8000 and at not in (0, 3) else w for at, w in enumerate(words)))


def compensate(ut: Number, up: Number, words: Bmp280Calibration) -> tuple[Number, Number]:
    """Temperature (degC) and pressure (Pa) from adc_T / 16 and adc_P; numbers, or float64 arrays of one shape.

    Source: BST-BMP280-DS001, appendix 8.1, "Compensation formula in double precision floating point"; the data sheet's
    example (3.12), adc_T = 519888 and adc_P = 415148, gives 25.08 degC and 100653.27 Pa.
    """
    v = 16 * ut / 131072 - words.t1 / 8192
    fine = (16 * ut / 16384 - words.t1 / 1024) * words.t2 + v * v * words.t3
    v1 = fine / 2 - 64000
    v2 = v1 * v1 * words.p6 / 32768 + v1 * words.p5 * 2
    v2 = v2 / 4 + words.p4 * 65536
    v1 = (words.p3 * v1 * v1 / 524288 + words.p2 * v1) / 524288
    v1 = (1 + v1 / 32768) * words.p1
    pressure = (1048576 - up - v2 / 4096) * 6250 / v1
    v1 = words.p9 * pressure * pressure / 2147483648
    v2 = pressure * words.p8 / 32768
    return fine / 5120, pressure + (v1 + v2 + words.p7) / 16
