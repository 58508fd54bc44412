"""BMP180: compensation of the uncompensated readings with the sensor's own calibration words.

The integer steps of the data sheet (section 3.5), to the last unit: what they give for its example, 15.0 degC and
69964 Pa, is what every other driver of this sensor gives. Their truncations make a step of up to 2.3 Pa, 19 cm of
height, where the pressure crosses a multiple of 256 Pa: less than the noise of a reading.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple, TypeVar

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Integers = TypeVar("Integers", int, NDArray[np.int64])

PRESSURE_DECIMALS = 2  # Pa
TEMPERATURE_DECIMALS = 3


class Calibration(NamedTuple):
    """The eleven words of the BMP180's EEPROM."""

    ac1: int
    ac2: int
    ac3: int
    ac4: int
    ac5: int
    ac6: int
    b1: int
    b2: int
    mb: int
    mc: int
    md: int

    @staticmethod
    @lru_cache(maxsize=4)  # a live stream has the same words at each reading
    def of(words: tuple[int, ...]) -> Calibration:
        """From HELLO's `baro_words`: unsigned, in the order of the EEPROM."""
        signed = [word - 0x10000 if word & 0x8000 and at not in (3, 4, 5) else word for at, word in enumerate(words)]
        return Calibration(*signed[:11])

    def words(self) -> tuple[int, ...]:
        """HELLO's `baro_words`."""
        return (*(word & 0xFFFF for word in self), 0)


def compensate(ut: Integers, up: Integers, words: Calibration, oversampling: int) -> tuple[Integers, Integers]:
    """Temperature (0.1 degC) and pressure (Pa) from UT and UP; integers, or int64 arrays of one shape.

    Source: BMP180 data sheet, section 3.5, "Calculating pressure and temperature".
    Raises ZeroDivisionError for a single reading that no BMP180 gives; arrays then hold meaningless numbers.
    """
    x1 = (ut - words.ac6) * words.ac5 >> 15
    b5 = x1 + _quotient(words.mc << 11, x1 + words.md)
    temperature = (b5 + 8) >> 4
    b6 = b5 - 4000
    square = b6 * b6 >> 12
    x3 = (words.b2 * square >> 11) + (words.ac2 * b6 >> 11)
    b3 = ((words.ac1 * 4 + x3 << oversampling) + 2) >> 2
    x3 = ((words.ac3 * b6 >> 13) + (words.b1 * square >> 16) + 2) >> 2
    b4 = words.ac4 * (x3 + 32768) >> 15
    b7 = (up - b3) * (50000 >> oversampling)
    fits = b7 < 0x80000000  # doubled first for the sake of the last bit, unless that would overflow 32 bits
    p = b7 * (1 + fits) // b4 * (2 - fits)
    x1 = (p >> 8) * (p >> 8) * 3038 >> 16
    return temperature, p + ((x1 + (-7357 * p >> 16) + 3791) >> 4)


def is_impossible(ut: NDArray[np.int64], words: Calibration) -> NDArray[np.bool_]:
    """Where (N,) a temperature reading makes a divisor of `compensate` zero: no BMP180 gives it."""
    import numpy as np

    x1 = (ut - words.ac6) * words.ac5 >> 15
    zero = x1 + words.md == 0
    b6 = x1 + _quotient(words.mc << 11, np.where(zero, 1, x1 + words.md)) - 4000
    x3 = ((words.ac3 * b6 >> 13) + (words.b1 * (b6 * b6 >> 12) >> 16) + 2) >> 2
    return np.asarray(zero | (words.ac4 * (x3 + 32768) >> 15 == 0))


def _quotient(numerator: int, denominator: Integers) -> Integers:
    """Division that rounds towards zero, as C's does (Python's and NumPy's round down)."""
    sign = (1 - 2 * (denominator < 0)) * (-1 if numerator < 0 else 1)
    return sign * (abs(numerator) // abs(denominator))


def is_sound(words: Calibration) -> bool:
    """No word is 0 or 0xFFFF (data sheet, 3.4): the EEPROM was really read."""
    return all(word not in (0, -1, 0xFFFF) for word in words)
