"""Which effects explain what the model does not: tried, fitted, tested on unseen data."""
