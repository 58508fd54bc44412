"""linkpose: motion measurement with an Arduino UNO, a GY-87 board and PS/2 optical mice."""

from linkpose.wire.messages import VERSION as __version__

__all__ = ["__version__"]
