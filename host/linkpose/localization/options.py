"""What a user may choose about a localization. This module is cheap to import: the command line's help reads it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Literal, get_args

from linkpose.errors import InvalidValue

if TYPE_CHECKING:
    from linkpose.localization.settings import Pose, Settings

NoiseModel = Literal["fixed", "adaptive", "affine"]
TransformName = Literal["unscented", "scaled"]
CONSTANTS_TO_ESTIMATE = ("scale", "bias", "scale:each", "bias:each")

# The noises that are estimated from the log where the user does not state them: option -> its name in `tuning`, and the
# value for streams, for laser scans, and for logs with few measurements (None: `settings.ERROR_TIME_S`).
ESTIMATED_NOISES: dict[str, tuple[str, float | None]] = {
    "range_std_m": ("range", 0.1), "range_growth": ("growth", 0.02), "bearing_std_rad": ("bearing", 0.05),
    "speed_std_m_s": ("speed", 0.1), "turn_std_rad_s": ("turn", 0.1), "velocity_std_m_s": ("velocity", 0.1),
    "acceleration_std_m_s2": ("acceleration", 1.0), "error_time_s": ("error_time", None), "drift_std_m": ("drift", 0.0),
}  # fmt: skip
MAY_BE_ZERO = (
    "range_growth", "error_time_s", "drift_std_m", "correlation", "motion_correlation", "kappa", "beta", "seed",
)  # fmt: skip
MAY_BE_NEGATIVE = ("correlation", "motion_correlation")
_LARGEST = 1e9  # of a noise or a time: squares of much larger ones leave the range of numbers in a filter
_SMALLEST_STD = 1e-9  # m, rad: the start's variance remains above the rounding of a covariance's entries


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalizationOptions:
    """Options of `localize`. The defaults suit the ordinary case.

    A noise that is None is estimated from the log, or has the value of ESTIMATED_NOISES where the log does not
    determine it. Raises InvalidValue for a value that is out of its range.

    Attributes:
        range_std_m: σ of a range (m).
        range_growth: growth k of σ with the range (m/m), of the noise model "affine" and of the beams of "scan-match".
        bearing_std_rad: σ of a bearing (rad).
        speed_std_m_s, turn_std_rad_s: σ of one odometry sample (m/s, rad/s).
        velocity_std_m_s: σ of one velocity sample on each axis (m/s).
        acceleration_std_m_s2: σ of the acceleration on each axis of a log without odometry (m/s²).
        error_time_s: how long the error of a sighting of one beacon persists (s).
        drift_std_m: σ of the part of a range's error that drifts, for each beacon by itself (m); 0: none does.
        drift_time_s: time constant of that part (s); estimated with `drift_std_m`.
        depth_std_m: σ of a depth (m).
        attitude_std_rad: σ of a yaw reading (rad).
        noise: how the variance of a range follows from the range: "fixed" σ², "adaptive" η (r/r̄) σ², or "affine"
            σ² + (k r)².
        eta: η of "adaptive".
        correlation: between the errors of ranges of one instant.
        motion_correlation: between the errors of speed and turn rate.
        gate: probability that a sound measurement passes the χ² test of its innovation; None: no test.
        estimate: constants of the ranges to estimate beside the pose: "scale" and "bias" of all beacons, or
            "scale:each" and "bias:each" of each. None: those that the ranges determine. (): none.
        start: x (m), y (m), heading (rad) at the log's start; "auto": search the whole map. None: the log's own pose,
            else "auto".
        start_std: σ of the start's place (m) and heading (rad).
        transform: sigma points of the ukf at √(n + κ) σ ("unscented", as in the thesis) or at α times that ("scaled").
        alpha, beta, kappa: parameters of the transform.
        smooth: smooth the path afterwards with all measurements.
        particles, seed: of the filter "mcl".
    """

    range_std_m: float | None = None
    range_growth: float | None = None
    bearing_std_rad: float | None = None
    speed_std_m_s: float | None = None
    turn_std_rad_s: float | None = None
    velocity_std_m_s: float | None = None
    acceleration_std_m_s2: float | None = None
    error_time_s: float | None = None
    drift_std_m: float | None = None
    drift_time_s: float = 10.0
    depth_std_m: float = 0.05
    attitude_std_rad: float = 0.01
    noise: NoiseModel = "affine"
    eta: float = 1.0
    correlation: float = 0.0
    motion_correlation: float = 0.0
    gate: float | None = 0.997
    estimate: tuple[str, ...] | None = None
    start: Pose | Literal["auto"] | None = None
    start_std: tuple[float, float] = (0.5, 0.1)
    transform: TransformName = "unscented"
    alpha: float = 0.1
    beta: float = 2.0
    kappa: float = 0.0
    smooth: bool = False
    particles: int = 2000
    seed: int = 0

    def __post_init__(self) -> None:
        for field in fields(self):
            _check_number(field.name, getattr(self, field.name))
        if self.gate is not None and self.gate >= 1.0:
            raise InvalidValue("gate", f"is {self.gate}; it must be a probability between 0 and 1, or None")
        for name, names in (("noise", get_args(NoiseModel)), ("transform", get_args(TransformName))):
            if getattr(self, name) not in names:
                raise InvalidValue(name, f"is {getattr(self, name)!r}; it must be one of {', '.join(names)}")
        check_start_std(self.start_std)
        if isinstance(self.start, str):
            if self.start != "auto":
                raise InvalidValue("start", f'is {self.start!r}; it must be x, y, heading (m, m, rad) or "auto"')
        elif self.start is not None and not (len(self.start) == 3 and all(map(math.isfinite, self.start))):
            raise InvalidValue("start", f"is {self.start}; it must be x, y, heading (m, m, rad)")
        if self.estimate is not None:
            check_constants(self.estimate)

    @property
    def free(self) -> tuple[str, ...]:
        """The names in `tuning` of the noises and constants that are estimated from the log."""
        free = [noise for option, (noise, _) in ESTIMATED_NOISES.items() if getattr(self, option) is None]
        if self.noise != "affine" and "growth" in free:
            free.remove("growth")
        return (*free, "yaw", "current", *(("sound",) if self.estimate is None else ()))

    def settings(self, constants: tuple[str, ...] = (), start: Pose | None = None) -> Settings:
        """The settings of a filter that estimates these constants of the ranges, from this start where none is given.

        With the start "auto", the settings have none.
        """
        from linkpose.localization.noise import RangeNoise
        from linkpose.localization.settings import BEAM_GROWTH, Settings
        from linkpose.localization.ukf import Transform

        def noise(option: str) -> Any:
            given = getattr(self, option)
            return ESTIMATED_NOISES[option][1] if given is None else given

        same = {field.name for field in fields(Settings)} & {field.name for field in fields(self)}
        values = {name: noise(name) if name in ESTIMATED_NOISES else getattr(self, name) for name in same}
        values |= {
            "ranges": RangeNoise(self.noise, noise("range_std_m"), self.eta, noise("range_growth"), self.correlation),
            "transform": Transform(self.alpha, self.beta, self.kappa)
            if self.transform == "scaled"
            else Transform(kappa=self.kappa),
            "beam_growth": BEAM_GROWTH if self.range_growth is None else self.range_growth,
            "estimate": constants,
            "start": None if self.start == "auto" else self.start or start,
        }
        return Settings(**values)


def check_constants(words: Sequence[str]) -> None:
    """Raises InvalidValue for a constant that cannot be estimated, or that is named twice."""
    for word in words:
        if word not in CONSTANTS_TO_ESTIMATE:
            raise InvalidValue("estimate", f"has {word!r}, which is none of {', '.join(CONSTANTS_TO_ESTIMATE)}")
        if f"{word}:each" in words:
            raise InvalidValue("estimate", f"has {word} and {word}:each, which exclude each other; name one")


def check_start_std(std: Sequence[float]) -> None:
    """Raises InvalidValue unless it is a standard deviation of the place (m) and one of the heading (rad)."""
    if len(std) != 2 or not all(_SMALLEST_STD < value < math.inf for value in std):
        raise InvalidValue(
            "start_std", f"is {std}; both must be above 0, as a start without uncertainty could not be corrected"
        )


def _check_number(name: str, value: object) -> None:
    """Raises InvalidValue for a number that is not finite, or below what the option takes."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        return
    if not math.isfinite(value):
        raise InvalidValue(name, f"is {value}; it must be finite")
    if name != "seed" and abs(value) > _LARGEST:
        raise InvalidValue(name, f"is {value}; it must not be beyond {_LARGEST:g}")
    if name not in MAY_BE_NEGATIVE and (value < 0.0 or (value == 0.0 and name not in MAY_BE_ZERO)):
        raise InvalidValue(name, f"is {value}; it must {'not be below' if name in MAY_BE_ZERO else 'be above'} 0")
