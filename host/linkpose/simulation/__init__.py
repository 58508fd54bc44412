"""Simulated rigs: exact truth, and the raw counts that the board's sensors would give of it."""
