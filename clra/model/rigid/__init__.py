"""Rigid motion of the sample in each view, and its gauge."""
