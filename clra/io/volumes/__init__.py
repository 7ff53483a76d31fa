"""Volume files: HDF5 and TIFF."""
