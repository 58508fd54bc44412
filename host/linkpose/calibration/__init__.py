"""Calibration from recordings: each module estimates its part of a rig file."""
