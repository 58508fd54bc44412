"""What a rig file says of the sensors, worked out from recordings made for it."""
