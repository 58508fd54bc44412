"""Mice that snap to their axes: where a motion is almost along one axis, they give no counts on the other.

Mice straighten lines for drawing ("angle snapping"). In a bend, each mouse then loses the motion across its axis; all
lose it together. The filter expects this motion from its velocity and the gyro: readings in which a mouse moves almost
along an axis, should have counted across it, and has not, are snapped.

From then on, a snapped reading is a weak measurement across the axis: the motion was within a few degrees of the axis.
For the comparisons between mice, the expected motion within these degrees stands in, and nothing is calibrated.
"""

from __future__ import annotations

from linkpose.compiling import inner
from linkpose.filters.mice.plane import scaled, square, turned
from linkpose.filters.mice.state import Record, Records
from linkpose.filters.planar.gyro import is_turning

# Directions within this tangent of an axis may be snapped (drivers snap within 3 to 8°), with this σ as a share of the
# motion along it. Doubled: a snapping mouse is found later, as fewer of its readings without counts are snapped.
_TANGENT, _STD = 0.15, 0.08
# Readings for which so many counts across the axis are expected; this many readings, of which this share has none, show
# snapping. Doubled: a bend goes by in which the mice contradict the gyro.
_EXPECTED_COUNTS, _READINGS, _WITHOUT = 1.5, 8.0, 0.8
_SHOWN_SHARE = 0.3  # of the gyro's turn that snapping mice show by their motion along the axis. Doubled: none is found
_LEAST_COUNTS = 4.0  # along the axis: with fewer, directions are not resolved. Doubled: slow motion is not repaired
# After so many readings of one mouse, all mice are taken for snapping ones: a robot has mice of one kind, and those
# that lose least would be found last. Doubled: a bend goes by.
_CERTAIN = 20.0


@inner
def watch_snapping(state: Record, m: Record, mice: Records, sample: Record) -> None:
    """Find mice that snap, and replace what they lost in this step by the motion that is expected."""
    state.snapped = 0
    if not (m.step > 0.0 and is_turning(state, m)) or state.at_rest:
        return
    velocity, turn_rate = complex(state.at.vx, state.at.vy), m.mean_rate - state.at.bias
    if m.turn_rate * turn_rate < _SHOWN_SHARE * turn_rate * turn_rate:  # the gyro's turn may be a jump of its bias
        return
    for i in range(m.count):
        if m.sound >> i & 1:
            mouse = mice[i]
            expected = scaled(m.step, velocity + scaled(turn_rate, mouse.arm))
            back = complex(mouse.axis.real, -mouse.axis.imag)
            own = scaled(1.0 / square(mouse.axis), turned(expected, back))  # the counts that are expected
            if _is_snapped(state, mouse, own, sample.counts[i]):
                state.snapped |= 1 << i


@inner
def _is_snapped(state: Record, mouse: Record, own: complex, counts: complex) -> bool:
    """Add a reading to a mouse's sums; where it is snapped, add the lost motion. `own` are the expected counts."""
    is_along_x = abs(own.real) > abs(own.imag)
    along, across = (own.real, own.imag) if is_along_x else (own.imag, own.real)
    shown, lost = (counts.real, counts.imag) if is_along_x else (counts.imag, counts.real)
    if abs(shown) < _LEAST_COUNTS:
        return False
    if abs(across) > _EXPECTED_COUNTS and abs(across) < _TANGENT * abs(along):
        mouse.snap_readings += 1.0
        mouse.snap_empty += lost == 0.0
        mouse.snaps = mouse.snap_readings > _READINGS and mouse.snap_empty > _WITHOUT * mouse.snap_readings
        state.has_snapping = state.has_snapping or (mouse.snaps and mouse.snap_readings > _CERTAIN)
    if lost != 0.0 or not (mouse.snaps or state.has_snapping):
        return False
    most = _TANGENT * abs(along)
    across = min(max(across, -most), most)
    mouse.moved += turned(mouse.axis, complex(0.0, across) if is_along_x else complex(across, 0.0))
    return True


@inner
def snapped_std(place: Record, counts: complex) -> complex:
    """σ of a snapped reading across its axis, as a vector in b (m)."""
    size = _STD * max(abs(counts.real), abs(counts.imag))
    return turned(place.axis, complex(0.0, size) if counts.imag == 0.0 else complex(size, 0.0))
