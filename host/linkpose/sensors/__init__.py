"""From raw counts to SI units: the sensors, the rig that holds them, and the measurements that the filters read."""
