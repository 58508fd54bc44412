"""The board: ports, the session with its handshake, the clock, and the place of each sample in time."""
