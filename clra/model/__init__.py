"""Immutable values in millimetres and pixels: geometry, motion, grid, scan, phantom; numpy only."""
