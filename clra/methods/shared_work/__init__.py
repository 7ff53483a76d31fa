"""What methods do, as tasks over views and slabs that several workers share."""
