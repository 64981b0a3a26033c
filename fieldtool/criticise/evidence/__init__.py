"""What is compared: which rows, in which band, how wrong, and how much of that is noise."""
