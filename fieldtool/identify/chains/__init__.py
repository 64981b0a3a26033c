"""From modes to chains of masses and springs: order reduction, and how long each chain is."""
