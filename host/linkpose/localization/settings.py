"""Settings of a localization: how good the sensors are, and how the filter treats them."""

from __future__ import annotations

from dataclasses import dataclass, field

from linkpose.localization.noise import RangeNoise
from linkpose.localization.ukf import Transform

Pose = tuple[float, float, float]
# What can be estimated beside the pose -> unit in the state's name, and its standard deviation at the start. Radio
# ranges are long by some centimetres to decimetres (antenna delay), and by some percent (clock, propagation): Plaza
# 6.6 %. Doubling either widens the first seconds only.
CONSTANTS = {"scale": ("range_scale_error", "", 0.1), "bias": ("range_bias", "_m", 0.3)}
# How long the error of a range, or of a range with bearing, persists (s): a camera repeats its error of a landmark,
# with a lag-one correlation of 0.5 to 0.95 in the public log MRCLAM 7; radio ranges of Plaza 1 are independent.
ERROR_TIME_S = {"range": 0.0, "bearing_range": 0.5}
# Growth of a beam's deviation with its range (m/m) where the user states none: data sheets have 0.002 (Hokuyo UTM-30LX)
# to 0.01 (RPLIDAR A1). Four times it costs 3 to 5 mm in two public buildings, and 0 as much in simulated corridors
# whose beams have 0.02.
BEAM_GROWTH = 0.005
DRIFT = "range_drift"  # begins the name of a state with the drifting error of one beacon's ranges, or of all


@dataclass(frozen=True, slots=True)
class Settings:
    """Standard deviations of the sensors, and what the filter does with them.

    `speed_std_m_s` and `turn_std_rad_s` are the errors of one odometry sample, `velocity_std_m_s` those of one velocity
    sample on each axis; each holds until the next sample. `acceleration_std_m_s2` drives the constant-velocity model of
    a log without odometry, on each axis; its velocity returns to 0 with the time constant `velocity_time_s`, that of a
    walk among places in a room. `start` is the pose at the log's start, with `start_std` (m, rad); without it
    the filter searches for the pose. `estimate` names constants of the range sensor, for all beacons together or, with
    `:each`, for each beacon. `error_time_s` is how long the error of a sighting persists; None: as ERROR_TIME_S.

    `beam_growth` is how the standard deviation of a laser's beam grows with its range (m/m), for fits of whole scans.

    With `drift_std_m` above 0, the ranges of each beacon have an error of this standard deviation that persists for
    `drift_time_s` (a first-order Gauss-Markov process). It is estimated beside the pose. With `drift_is_shared`, the
    ranges of all beacons have one such error in common.

    With `current_std_m_s` above 0, the velocities of an underwater vehicle are relative to the water, whose constant
    velocity is estimated, with this standard deviation on each axis at the start.
    """

    ranges: RangeNoise = field(default_factory=RangeNoise)
    bearing_std_rad: float = 0.05
    depth_std_m: float = 0.05
    attitude_std_rad: float = 0.01
    speed_std_m_s: float = 0.1
    turn_std_rad_s: float = 0.1
    motion_correlation: float = 0.0
    velocity_std_m_s: float = 0.1
    acceleration_std_m_s2: float = 1.0
    velocity_time_s: float = 10.0
    yaw_acceleration_std_rad_s2: float = 0.1
    gate: float | None = 0.997
    transform: Transform = field(default_factory=Transform)
    estimate: tuple[str, ...] = ()
    start: Pose | None = None
    start_std: tuple[float, float] = (0.5, 0.1)
    smooth: bool = False
    beam_growth: float = BEAM_GROWTH
    particles: int = 2000
    seed: int = 0
    error_time_s: float | None = None
    drift_std_m: float = 0.0
    drift_time_s: float = 10.0
    drift_is_shared: bool = False
    current_std_m_s: float = 0.0
