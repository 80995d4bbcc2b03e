"""What was found, in sentences for people: the headline facts, what each kind of leak means, and how its line was set."""

from __future__ import annotations

from collections.abc import Sequence

from palpate.core import SampleRef, Score, columns
from palpate.core.score import BETTER
from palpate.report.results import Audit, Results, Signal
from palpate.report.sides import sides
from palpate.report.text import (
    count,
    decimals,
    defined,
    interval_text,
    number,
    percent,
    plural,
    score_text,
    setting_of,
)

#: Beginning of a kind of leak -> what it means ({thing} is the rest of the name, {there} the other part), and how a share of the test
#: samples is told. The first match wins.
KINDS: tuple[tuple[str, str, str], ...] = (
    (
        "identical sample",
        "The very same sample, by its id or by its video and frame, is in {there}.",
        "are samples of {there} themselves",
    ),
    (
        "identical bytes",
        "A picture file of the sample is, byte for byte, a picture file of {there}.",
        "have a picture that {there} holds byte for byte",
    ),
    (
        "shared ",
        "Its {thing} is also in {there}: what is learned of that {thing} helps on the sample.",
        "share {a} {thing} with {there}",
    ),
    (
        "time gap",
        "A frame of the same video, a moment before or after, is in {there}.",
        "lie a moment from a frame of {there}",
    ),
    (
        "near-duplicate vision",
        "Its photo can hardly be told from a photo of {there}.",
        "have a near-duplicate photo in {there}",
    ),
    (
        "near-duplicate t",  # tactile; format 1 called it touch
        "Its touch, without the sensor's own look, can hardly be told from one of {there}.",
        "have a near-duplicate touch in {there}",
    ),
)
#: Causes of pictures that look alike without being a leak, and what to make of them.
HARMLESS = {
    "nothing touched": "the gel was untouched in both, and untouched gel looks alike everywhere",
    "sensor drift": "the gel's slow change over time makes both alike, not what was touched",
}


def where(sample: SampleRef) -> str:
    """``"video, frame 12"``, or the id where the sample has no video."""
    if sample.video is None:
        return sample.id
    return sample.video if sample.frame is None else f"{sample.video}, frame {sample.frame}"


def there(audit: Audit) -> str:
    """What the test part was compared with, as it stands in a sentence."""
    return "train" if audit.against == "train" else f"the {audit.against} data"


def _kind(kind: str) -> tuple[str, str, str]:
    """Meaning and share of a kind of leak, and the thing that is shared, if any."""
    for start, meaning, said in KINDS:
        if kind.startswith(start):
            return meaning, said, kind.removeprefix("shared ")
    return "", f"are flagged by {kind}", ""


def meaning_of(signal: Signal, audit: Audit) -> str:
    """What a kind of leak means, in one sentence; '' for a kind without one."""
    meaning, _, thing = _kind(signal.kind)
    return meaning.format(thing=thing, there=there(audit))


def threshold_text(signal: Signal) -> str:
    """The score from which samples are flagged; ``exact`` where nothing but a score of 1 is."""
    return (
        "exact"
        if signal.threshold >= 1 and signal.false_positives is None
        else f"score {score_text(signal.threshold)}"
    )


def cause_texts(signal: Signal) -> list[str]:
    """How many test samples look alike for which cause, and which causes are no leak."""
    return [
        f"{cause} {count(n)}{' (no leak)' if cause in HARMLESS else ''}"
        for cause, n in signal.causes.items()
    ]


def cause_notes(signal: Signal) -> list[str]:
    """A sentence for each cause that is no leak."""
    return [
        f"{plural(signal.causes[cause], 'test sample')} at or beyond the line "
        f"{'looks' if signal.causes[cause] == 1 else 'look'} alike for another reason ({cause}): {why}. Not counted as leaking."
        for cause, why in HARMLESS.items()
        if signal.causes.get(cause)
    ]


def line_text(signal: Signal) -> str:
    """How the line between unrelated and alike was set, and what lies at or beyond it."""
    line = f"The line stands at a score of {score_text(signal.threshold)}"
    if signal.false_positives is not None:
        line += f", where {percent(signal.false_positives)} of the samples known to be unrelated find a match as good by chance"
    beyond = max(sum(signal.causes.values()), signal.flagged)
    share = beyond / signal.checked if signal.checked else 0.0
    return f"{line}. {count(beyond)} of {plural(signal.checked, 'test sample')} ({percent(share)}) {'lies' if beyond == 1 else 'lie'} at or beyond it."


def leak_line(audit: Audit) -> str:
    """How many test samples any signal flags."""
    n, total = audit.leaking_samples, audit.test_samples
    if not n:
        looked = "the signal" if len(audit.signals) == 1 else f"the {len(audit.signals)} signals"
        return f"None of {plural(total, 'test sample')} leaks by {looked} that {'was' if len(audit.signals) == 1 else 'were'} looked for."
    return f"{count(n)} of {plural(total, 'test sample')} {'leaks' if n == 1 else 'leak'} ({percent(n / total if total else 0.0)})."


def purpose(results: Results) -> str:
    """One sentence that says what the page is."""
    parts: list[str] = []
    if results.gallery or results.scores:
        parts.append("how close touch generated from photos comes to real touch")
    if results.audits:
        parts.append("whether the split behind the numbers leaks from train into test")
    return (
        f"What this page shows: {', and '.join(parts)}."
        if parts
        else "Results of palpate; nothing has been measured yet."
    )


def _said(signal: Signal, audit: Audit, first: bool) -> str:
    """``"95.0 % share a video with train"``; the first of several says of whom."""
    of = " of the test samples" if first else ""
    if signal.checked < audit.test_samples:
        of = f" of the {count(signal.checked)} looked at"
    _, said, thing = _kind(signal.kind)
    return f"{percent(signal.fraction)}{of} {said.format(thing=thing, there=there(audit), a='an' if thing[:1] in 'aeiou' else 'a')}"


def audit_line(audit: Audit) -> str:
    """The finding of one audit in one sentence."""
    name = audit.name if audit.against == "train" else f"{audit.name} against {there(audit)}"
    if not audit.test_samples:
        return f"{name}: the test part is empty, so nothing can leak."
    if audit.signals:
        found = sorted(
            (s for s in audit.signals if s.flagged and s.counts), key=lambda s: -s.fraction
        )[:3]
        if not found:
            line = leak_line(audit)
            return f"{name}: {line[0].lower()}{line[1:]}"
        told = "; ".join(_said(s, audit, k == 0) for k, s in enumerate(found))
        return f"{name}: {told}. {leak_line(audit)}"
    if not audit.test_samples_in_shared_groups:
        return f"{name}: no {audit.group} is shared; none of the {plural(audit.test_samples, 'test sample')} leaks."
    one = audit.test_samples_in_shared_groups == 1
    return (
        f"{name}: {percent(audit.leaked_fraction)} of the test samples leak; {count(audit.test_samples_in_shared_groups)} of "
        f"{count(audit.test_samples)} {'comes' if one else 'come'} from a {audit.group} that {there(audit)} holds as well."
    )


def score_line(scores: Sequence[Score]) -> str:
    """The first column with a value, in one sentence; '' if there is none."""
    places = [(*setting_of(s), side) for s, side in zip(scores, sides(scores).of, strict=True)]
    first = next((place for s, place in zip(scores, places, strict=True) if defined(s)), None)
    for metric, column in columns(
        s for s, place in zip(scores, places, strict=True) if place == first
    ).items():
        shown = [s for s in column if defined(s)]
        if shown:
            digits = decimals([s.value for s in shown if s.value is not None])
            said = ", ".join(
                f"{s.subject} {number(s.value, digits)}{interval_text(s, digits, before=' ')}"
                for s in shown[:3]
            )
            floors = [s.floor for s in shown if s.floor is not None]
            floor = f"; floor {number(floors[0], digits)}" if floors else ""
            return f"{metric} ({BETTER[shown[0].higher_is_better]}): {said}{floor}."
    return ""


def summary_lines(results: Results) -> list[str]:
    """At most three headline facts for the terminal and the head of the page.

    The facts of the results come first; where there are fewer than three, the first and the last audit, what the first
    measured leak costs, and the first metric fill up.

    Raises:
        PalpateError: if the scores may not stand in one table.
    """
    lines = list(results.facts[:3])
    ends = (
        [results.audits[0], results.audits[-1]] if len(results.audits) > 1 else list(results.audits)
    )
    cost = next((a.impact.headline for a in results.audits if a.impact), "")
    candidates = [*(audit_line(a) for a in ends), cost, score_line(results.scores)]
    if len(results.gallery):
        candidates.append(
            f"{plural(len(results.gallery), 'generated touch', 'generated touches')} in the gallery."
        )
    return (
        (lines + [c for c in candidates if c and c not in lines])[:3] if len(lines) < 3 else lines
    )
