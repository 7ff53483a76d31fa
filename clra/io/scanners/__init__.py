"""Scans as scanners write them: one module a vendor, with its sources and signs."""
