"""Leakage: the audit against a double loop and the published facts."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate.core import PalpateError, Split
from palpate.data.manifest import Manifest
from palpate.leakage import audit_lists, audit_parts, audit_split


def manifest_of(rows, tmp="."):
    return Manifest.from_rows(
        [
            {"id": f"{v}/{f}", "video": v, "frame": f, "material": m, "contact": f"{v}#{f // 10}"}
            for v, f, m in rows
        ],
        tmp,
    )


frames = st.lists(
    st.tuples(st.sampled_from("abcd"), st.integers(0, 40), st.sampled_from(["Wood", "Grass"])),
    min_size=1,
    max_size=25,
)


@settings(max_examples=200, deadline=None)
@given(frames, frames)
def test_audit_equals_a_double_loop(train_rows, test_rows):
    audit = audit_parts(manifest_of(train_rows), manifest_of(test_rows))
    videos = {v for v, _, _ in train_rows}
    gaps = [
        min(abs(f - g) for v, g, _ in train_rows if v == u) for u, f, _ in test_rows if u in videos
    ]
    assert audit.test_samples_in_shared_groups == len(gaps)
    assert audit.groups_shared == len(videos & {v for v, _, _ in test_rows})
    assert audit.leaked_fraction == round(len(gaps) / len(test_rows), 5)
    assert audit.identical_samples == sum(
        (u, f) in {(v, g) for v, g, _ in train_rows} for u, f, _ in test_rows
    )
    if gaps:
        assert (audit.gap_min, audit.gap_median, audit.gap_max) == (
            min(gaps),
            np.median(gaps),
            max(gaps),
        )
        assert sum(audit.gap_counts) == len(gaps)
        assert audit.worst[0].gap == min(gaps)
        for pair in audit.worst:
            assert pair.test.video == pair.train.video
            assert abs(pair.test.frame - pair.train.frame) == pair.gap
    else:
        assert (audit.gap_min, audit.gap_counts, audit.worst) == (None, [], [])


def test_the_published_lists_leak_as_measured(real_data):
    lists = real_data / "touch_and_go" / "lists"
    audit, _ = audit_lists(lists / "train.txt", lists / "test.txt")
    facts = (
        audit.test_samples,
        audit.groups_train,
        audit.groups_test,
        audit.groups_shared,
        audit.test_samples_in_shared_groups,
    )
    assert facts == (29879, 120, 106, 100, 29597)
    assert (
        audit.leaked_fraction,
        audit.gap_min,
        audit.gap_median,
        audit.gap_max,
        audit.identical_samples,
    ) == (0.99056, 31, 304, 2485, 0)
    clean, _ = audit_lists(lists / "train_rough.txt", lists / "test_rough.txt")
    assert (clean.groups_shared, clean.leaked_fraction, clean.gap_min) == (0, 0.0, None)


def test_rows_without_a_group_are_told_and_unknown_groups_refused():
    a = Manifest.from_rows([{"id": "1", "video": "v", "frame": 0}, {"id": "2"}], ".")
    audit = audit_parts(
        a, Manifest.from_rows([{"id": "3", "video": "v", "frame": 4}, {"id": "4"}], ".")
    )
    assert (audit.leaked_fraction, audit.gap_min) == (0.5, 4)
    assert len(audit.notes) == 2
    with pytest.raises(PalpateError, match="column of nulls"):
        audit_parts(a, a, group="object")
    with pytest.raises(PalpateError, match="one of video"):
        audit_parts(a, a, group="color")
    with pytest.raises(PalpateError, match="test part"):
        audit_split(a, Split.from_ids(train=["1"]))


def test_validation_that_leaks_is_told():
    m = manifest_of([("a", 1, "Wood"), ("a", 9, "Wood"), ("b", 1, "Wood")])
    audit = audit_split(m, Split.from_ids(train=["a/1"], val=["a/9"], test=["b/1"]))
    assert audit.leaked_fraction == 0
    assert "validation" in audit.notes[0]


def test_a_split_of_another_or_larger_manifest_is_told():
    m = manifest_of([("a", 1, "Wood"), ("b", 1, "Wood"), ("c", 1, "Wood")])
    audit = audit_split(m, Split.from_ids(train=["a/1"], test=["b/1"], manifest="0" * 64))
    assert any("another manifest" in note for note in audit.notes)
    assert any("1 of 3 samples" in note for note in audit.notes)
