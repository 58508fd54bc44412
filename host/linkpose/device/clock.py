"""The board's clock, fitted to the host's.

The UNO runs on a ceramic resonator, which may deviate by 0.5 %, and its clock restarts at zero after every reset. PING
and PONG sample both clocks almost simultaneously, and the round-trip time bounds the error. A Kalman filter over
(offset, drift) weights each reading by its round-trip time and rejects readings that a busy host delayed.
"""

from __future__ import annotations

WRAP_US = 1 << 32  # the board's clock wraps after 71.6 minutes

DRIFT_PRIOR = 2.5e-3  # standard deviation: a ceramic resonator holds half a per cent
DRIFT_WALK = 1e-7  # per square root of a second: it warms up
DRIFT_LIMIT = 0.01  # no UNO is as far off; a simulated board that runs faster than time is
ROUND_TRIP_FLOOR_S = 2e-4  # standard deviation of the middle of even the shortest round trip,
UNEVEN = 0.1  # and as a share of it: the way there and the way back differ
GATE = 4.0  # standard deviations
SLEW_TIME_S = 5.0  # time constant of the output towards the fit; doubled, a correction takes twice as long
SLEW_LIMIT = 1e-3
PATIENCE = 5  # consecutive rejected readings after which the fit is reopened


class DeviceClock:
    """Maps the board's microseconds to seconds of the host's clock (time.perf_counter), continuous and increasing."""

    def __init__(self) -> None:
        self._epoch_us = 0  # the last reading, unwrapped
        self._host_s = 0.0  # the host's time of `_epoch_us`, as given out
        self._fit_us: int | None = None  # where the fit stands, unwrapped
        self._offset_s = 0.0  # the fit: host = device + offset there
        self._rate = 0.0  # host seconds per device second, less one
        self._var = [0.0, 0.0, DRIFT_PRIOR**2]  # of offset, offset-rate, rate
        self._shortest_s = float("inf")
        self._refused = 0

    @property
    def ready(self) -> bool:
        """True once a PONG has tied the two clocks together."""
        return self._fit_us is not None

    @property
    def drift_ppm(self) -> float:
        """How much faster the board's clock runs than the host's, in parts per million."""
        return 1e6 * (1 / (1 + self._rate) - 1)

    @property
    def drift_std_ppm(self) -> float:
        """Standard deviation of `drift_ppm`."""
        return float(1e6 * self._var[2] ** 0.5)

    def unwrap(self, t_us: int, host_s: float) -> int:
        """The unwrapped board time (µs) that is closest to the prediction from the host's clock."""
        likely = self._epoch_us + (host_s - self._host_s) * 1e6 if self.ready else t_us
        return t_us + round((likely - t_us) / WRAP_US) * WRAP_US

    def pong(self, t_us: int, sent_s: float, received_s: float) -> None:
        """Updates the fit with a PING sent and its PONG received at these host times (s)."""
        round_trip = received_s - sent_s
        self._shortest_s = min(self._shortest_s, round_trip)
        noise = (ROUND_TRIP_FLOOR_S + UNEVEN * round_trip + (round_trip - self._shortest_s) / 2) ** 2
        middle = (sent_s + received_s) / 2
        if self._fit_us is None:
            self._fit_us = self._epoch_us = t_us
            self._host_s, self._offset_s = middle, middle - t_us * 1e-6
            self._var[0] = noise
            return
        device = self.unwrap(t_us, middle)
        elapsed = (device - self._fit_us) * 1e-6
        self._propagate(elapsed)
        self._fit_us = device
        self._correct(middle - device * 1e-6 - self._offset_s, noise)

    def _propagate(self, elapsed: float) -> None:
        offset, cross, rate = self._var
        self._offset_s += self._rate * elapsed
        self._var[0] = offset + 2 * elapsed * cross + elapsed * elapsed * rate
        self._var[1] = cross + elapsed * rate
        self._var[2] = rate + DRIFT_WALK**2 * abs(elapsed)

    def _correct(self, innovation: float, noise: float) -> None:
        offset, cross, rate = self._var
        total = offset + noise
        if innovation * innovation > GATE * GATE * total:
            self._refused += 1
            if self._refused >= PATIENCE:  # the fit is wrong, not the readings
                self._var = [offset + innovation * innovation, cross, max(rate, DRIFT_PRIOR**2)]
                self._refused = 0
            return
        self._refused = 0
        if abs(self._rate + cross / total * innovation) > DRIFT_LIMIT:
            return  # implausible for a resonator: keep the board's own seconds
        self._offset_s += offset / total * innovation
        self._rate += cross / total * innovation
        self._var = [offset * noise / total, cross * noise / total, rate - cross * cross / total]

    def host_time(self, t_us: int) -> float:
        """The host's time (s, time.perf_counter) of an unwrapped board time, never before one returned earlier.

        Goes from the last time given out at the fitted rate, and slews towards the fit, so that the interval between
        two samples is never disturbed by more than a thousandth.
        """
        if self._fit_us is None:
            raise RuntimeError("the clock has no fit before the first PONG")
        elapsed = (t_us - self._epoch_us) * 1e-6
        target = t_us * 1e-6 + self._offset_s + self._rate * (t_us - self._fit_us) * 1e-6
        expected = self._host_s + elapsed * (1 + self._rate)
        slew = min(max((target - expected) / SLEW_TIME_S, -SLEW_LIMIT), SLEW_LIMIT)
        self._host_s = expected + slew * max(elapsed, 0.0)
        self._epoch_us = t_us
        return self._host_s
