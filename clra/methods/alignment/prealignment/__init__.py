"""Where an alignment starts: shifts by sums over each radiograph, without any reconstruction."""
