"""Apparent motion that a movement of the sample as a whole explains: the gauge of a scan."""
