"""How far estimates are from a reference."""
