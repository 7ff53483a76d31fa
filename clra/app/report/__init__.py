"""The report of an alignment, one HTML page."""
