"""Raw frames and counts."""
