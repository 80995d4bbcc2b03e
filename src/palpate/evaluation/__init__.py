"""Evaluation: what is measured on what."""
