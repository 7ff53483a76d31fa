"""Who executes: one device, several of this machine, or a cluster; and what is kept on the way."""
