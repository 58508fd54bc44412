"""Flashing the board: firmware images, the build with PlatformIO, and the upload through the bootloader."""
