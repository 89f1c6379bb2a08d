"""Finding instruments and their joints from training frames alone."""
