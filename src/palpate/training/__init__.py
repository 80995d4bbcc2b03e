"""Training: one engine for every model (options, steps, checkpoints, averaging, log)."""
