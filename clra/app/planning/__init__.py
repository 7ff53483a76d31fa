"""Work shared out to a cluster: the option that names one, and what it will take."""
