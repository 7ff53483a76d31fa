"""Methods: each reads like its algorithm in the paper; the machinery is in :mod:`clra.ops`."""
