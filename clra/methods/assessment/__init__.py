"""Evidence for and against an alignment: held-out views, half scans, sharpness, radiographs."""
