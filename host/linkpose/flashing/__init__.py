"""Putting the firmware on the board: its image, its build with PlatformIO, and the upload through the bootloader."""
