"""What of the rays a scan measures: angles, field of view, and rays that are measured twice."""
