"""Scans and volumes larger than the device: chunks of views, slabs of planes, memory budgets."""
