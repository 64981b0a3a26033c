"""The fast plan: its design, what is sent, its forecast and its run."""
