"""Protocol: whole experiments as stages, each cached by the digest of what it read."""
