"""Leakage: does a split leak, where, and a split that does not (``palpate.leakage.splits``, which brings a solver and is imported by itself)."""

from palpate.leakage.audit import audit_lists, audit_parts, audit_split

__all__ = ["audit_lists", "audit_parts", "audit_split"]
