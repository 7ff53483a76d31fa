"""Device operations, one concept a file, each paired with a kernel file of the same stem."""
