"""How much the score of `tilt-inertial` on real recordings depends on each of its constants.

    python tests/bench/sensitivity.py [--data FOLDER] [--json] [--only TEXT]

Each constant is halved and doubled, one at a time. A row gives the error beside VQF's of each trial, the geometric mean
of the ratios, and their ratio to those of the constants in use. The last rows are a cross-validation: for each trial,
the row with the best mean of the other trials of its set is chosen, and the ratio is that of the trial left out.
Recordings and scores are those of real_data.py; `--only broad` takes two minutes.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from _report import print_row, recordings_parser
from real_data import SETS, Case, block_of, tilt_from, vqf_tilt

from linkpose.filters.inertial.state import SensorErrors
from linkpose.filters.joint_inertial import InertialParameters
from linkpose.filters.tilt_inertial import ERRORS, PARAMETERS, TiltInertialFilter
from linkpose.sensors.measurements import Floats
from linkpose.sensors.rig import Imu, Rig

CONSTANTS = (
    "first_speed_m_s", "least_speed_m_s", "most_speed_m_s", "swing_time_s", "speed_memory_s", "suspect", "grow_s",
    "steady_memory_s", "swing_share", "least_turn_rad_s", "least_correlation_s", "most_correlation_s", "gyro_misfit",
    "accel_misfit", "gyro_bias_walk_rad_s",
)  # fmt: skip


class Variant(NamedTuple):
    """One choice of the constants."""

    name: str
    factor: float
    parameters: InertialParameters
    errors: SensorErrors


def variants() -> Iterator[Variant]:
    """The constants in use, then each one halved and doubled."""
    yield Variant("in use", 1.0, PARAMETERS, ERRORS)
    for factor in (0.5, 2.0):
        for name in CONSTANTS:
            changed = PARAMETERS._replace(**{name: factor * getattr(PARAMETERS, name)})
            yield Variant(name, factor, changed, ERRORS)
        for name in SensorErrors._fields:
            yield Variant(name, factor, PARAMETERS, ERRORS._replace(**{name: factor * getattr(ERRORS, name)}))


def error_deg(case: Case, variant: Variant) -> float:
    """Root mean square error of the filter with these constants."""
    made = TiltInertialFilter(Rig(imu=Imu(delay_s=case.delay_s)), variant.parameters, variant.errors)
    found = dict(zip(made.columns, made.process(block_of(case)).T, strict=True))
    return case.error_deg(tilt_from(found["tilt_inertial_roll_deg"], found["tilt_inertial_pitch_deg"]))


def left_out(ratios: Floats) -> Floats:
    """Ratio (T,) of each trial under the variant that is best on the others; `ratios` is (variants, T)."""
    found = []
    for trial in range(ratios.shape[1]):
        others = np.delete(np.log(ratios), trial, axis=1).mean(axis=1)
        found.append(ratios[int(np.argmin(others)), trial])
    return np.array(found)


def main() -> None:
    options = recordings_parser(__doc__).parse_args()
    for name, read in SETS.items():
        cases = [case for case in read(options.data / name) if options.only in case.name]
        if not cases:
            continue
        peer = np.array([case.error_deg(vqf_tilt(case, offline=False)) for case in cases])
        table: list[Floats] = []
        for variant in variants():
            ratios = np.array([error_deg(case, variant) for case in cases]) / peer
            table.append(ratios)
            about = {"set": name, "constant": variant.name, "factor": variant.factor}
            scores = {case.name: float(ratio) for case, ratio in zip(cases, ratios, strict=True)}
            mean, first = (float(np.exp(np.log(r).mean())) for r in (ratios, table[0]))
            print_row({**about, **scores, "ratio": mean, "change": mean / first}, options.json)
        if len(cases) > 1:
            held_out = left_out(np.array(table))
            scores = {case.name: float(ratio) for case, ratio in zip(cases, held_out, strict=True)}
            mean = float(np.exp(np.log(held_out).mean()))
            print_row({"set": name, "constant": "left out", **scores, "ratio": mean}, options.json)


if __name__ == "__main__":
    main()
