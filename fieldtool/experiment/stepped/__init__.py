"""The classic plan: its design, its tones and its run."""
