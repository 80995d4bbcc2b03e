"""Picture paths in results: every one of them changed in the same way, wherever it stands."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from palpate.core import SampleRef
from palpate.report.results import Audit, LeakPair, Results


def with_paths(results: Results, change: Callable[[str], str]) -> Results:
    """The results with ``change`` applied to the path of every picture; where there is no picture there stays none."""

    def maybe(name: str | None) -> str | None:
        return None if name is None else change(name)

    def sample(ref: SampleRef) -> SampleRef:
        return replace(ref, vision=maybe(ref.vision), tactile=maybe(ref.tactile))

    def pair(p: LeakPair) -> LeakPair:
        return replace(p, test=sample(p.test), train=sample(p.train))

    def audit(a: Audit) -> Audit:
        signals = [replace(s, worst=[pair(p) for p in s.worst]) for s in a.signals]
        return replace(a, worst=[pair(p) for p in a.worst], signals=signals)

    gallery = [
        replace(
            g,
            sample=sample(g.sample),
            generated=change(g.generated),
            background=maybe(g.background),
        )
        for g in results.gallery
    ]
    return replace(results, audits=[audit(a) for a in results.audits], gallery=gallery)
