"""Leakage: does a split leak, where, and a split that does not."""

from palpate.leakage.audit import audit_lists, audit_parts, audit_split
from palpate.leakage.splits import SplitPlan, choose_group, describe, leak_free_folds, leak_free_split, leak_free_splits
from palpate.leakage.splits.groups import components

__all__ = [
    "SplitPlan", "audit_lists", "audit_parts", "audit_split", "choose_group", "components", "describe", "leak_free_folds", "leak_free_split", "leak_free_splits",
]  # fmt: skip
