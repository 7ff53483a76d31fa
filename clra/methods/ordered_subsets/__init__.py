"""What reconstruction by ordered subsets is made of: rays, steps and passes."""
