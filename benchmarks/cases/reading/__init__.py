"""Files whose bytes, axes or calibration are easily misread, and what reading them costs."""
