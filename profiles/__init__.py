"""What fieldtool knows of drives and machines: data files only."""
