"""Who executes: one device, or several."""
