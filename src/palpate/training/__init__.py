"""Training: one engine for every model."""
