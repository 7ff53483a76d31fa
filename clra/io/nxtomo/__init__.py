"""NXtomo files, read and written."""
