"""Files: scans, volumes, motions and geometries in and out."""
