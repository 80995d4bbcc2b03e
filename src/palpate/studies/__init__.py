"""Studies: experiments as graphs of stages, each cached by the digest of what it read."""
