"""The summary of a recording, as `linkpose info FILE` shows it."""

from __future__ import annotations

from typing import Any

from linkpose.recording.reader import RecordingFile

# Taken from the metadata and the closing line as they are.
_FROM_METADATA = ("software", "start_utc", "device", "firmware", "settings", "barometer")
_FROM_CLOSING = ("ended", "drift_ppm", "corrupt", "board", "marks")


def summarise(file: RecordingFile) -> dict[str, Any]:
    """Facts by name; the last part of each name is the unit. What the file does not contain is left out."""
    survey, metadata, closing = file.survey, file.metadata, file.closing or {}
    rig = file.rig
    joint = rig.joint.known_j2s_m if rig is not None else None
    found: dict[str, Any] = {"file": str(file.path)}
    found |= {name: metadata[name] for name in _FROM_METADATA if name in metadata}
    found |= {
        "duration_s": round(survey.duration_s, 6),
        "samples": survey.rows,
        "sample_rate_hz": round(file.sample_rate_hz, 3),
        "measured_rate_hz": round(survey.measured_rate_hz, 3),
        "samples_lost": survey.lost,
        "gap_count": survey.gap_count,
        "gaps": [
            {"time_s": round(gap.time_s, 6), "duration_s": round(gap.duration_s, 6), "lost": gap.lost}
            for gap in survey.gaps
        ],
        "closed": file.closing is not None,
    }
    found |= {name: closing[name] for name in _FROM_CLOSING if closing.get(name) is not None}
    found |= {"j2s_m": None if joint is None else list(joint), "health": file.health}
    noise = survey.noise_at_rest()
    return found | {"noise_at_rest": noise, "usable": not file.unusable, "remarks": file.remarks}
