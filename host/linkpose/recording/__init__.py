"""Recordings on disk: CSV that any tool reads, raw captures, and the way back to measurements."""
