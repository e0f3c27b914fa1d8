"""What the tracks say, Dataset in and Dataset out: motion, jumps, precision, intensity, presence, occupancy."""
