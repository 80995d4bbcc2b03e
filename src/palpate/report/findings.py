"""Findings in sentences: what each kind of leak means, and the headline facts of a page."""

from __future__ import annotations

from collections.abc import Sequence

from palpate.core import Note, Score
from palpate.core.score import BETTER
from palpate.report.labels import count, number, percent, plural, score_text, with_interval
from palpate.report.note_texts import question
from palpate.report.records import CANNOT_TELL, LEAKS, NO_LEAK, Signal
from palpate.report.results import Audit, Results
from palpate.report.tables import defined, families, family_of

#: Beginning of a kind of leak -> what it means ({thing} is the rest of the name, {data} what test
#: is compared with), and the sentence about a share of the test samples. The first match wins.
KINDS: tuple[tuple[str, str, str], ...] = (
    (
        "identical sample",
        "The very same sample, by its id or by its video and frame, is in {data}.",
        "are samples of {data} themselves",
    ),
    (
        "identical bytes",
        "An image file of the sample is, byte for byte, an image file of {data}.",
        "have an image that {data} has byte for byte",
    ),
    (
        "shared ",
        "Its {thing} is also in {data}: what is learned of that {thing} helps on the sample.",
        "share {a} {thing} with {data}",
    ),
    (
        "time gap",
        "A frame of the same video, a moment before or after, is in {data}.",
        "lie a moment from a frame of {data}",
    ),
    (
        "near-duplicate vision",
        "Its photo can hardly be distinguished from a photo of {data}.",
        "have a near-duplicate photo in {data}",
    ),
    (
        "near-duplicate tactile",
        "Its tactile image, without the sensor's background, can hardly be distinguished from one "
        "of {data}.",
        "have a near-duplicate tactile image in {data}",
    ),
)


def data_of(audit: Audit) -> str:
    """Return what the test part was compared with, as it reads in a sentence."""
    return "train" if audit.against == "train" else f"the {audit.against} data"


def _kind(kind: str, audit: Audit) -> tuple[str, str]:
    """Return the meaning of a kind of leak, and the sentence about a share of the test samples."""
    thing = kind.removeprefix("shared ")
    words = {"thing": thing, "data": data_of(audit), "a": "an" if thing[:1] in "aeiou" else "a"}
    for start, meaning, share in KINDS:
        if kind.startswith(start):
            return meaning.format_map(words), share.format_map(words)
    return "", f"are flagged by {kind}"


def meaning_of(signal: Signal, audit: Audit) -> str:
    """Return what a kind of leak means, in one sentence; '' for an unknown kind."""
    return _kind(signal.kind, audit)[0]


def threshold_text(signal: Signal) -> str:
    """Return the score from which samples are flagged; ``exact`` where only a score of 1 is."""
    exact = signal.threshold >= 1 and signal.false_positives is None
    return "exact" if exact else f"score {score_text(signal.threshold)}"


def cause_texts(signal: Signal) -> list[str]:
    """Return how many test samples are similar for which cause."""
    return [
        f"{cause} {count(n)}" + " (no leak)" * (cause != "content")
        for cause, n in signal.causes.items()
    ]


def signal_notes(audit: Audit) -> list[tuple[str, Note]]:
    """Return the notes of signals, each once, with the kinds that have it."""
    notes = [note for signal in audit.signals for note in signal.notes]
    return [
        (", ".join(signal.kind for signal in audit.signals if note in signal.notes), note)
        for k, note in enumerate(notes)
        if note not in notes[:k]
    ]


def chance_text(signal: Signal) -> str:
    """Return a verdict on near-duplicates, with what chance explains; '' for exact signals."""
    if not signal.verdict:
        return ""
    chance = signal.verdict == NO_LEAK and signal.flagged
    words = "no more than chance explains" if chance else signal.verdict
    facts = [] if signal.expected is None else [f"{number(signal.expected)} expected by chance"]
    if signal.false_positives is not None and signal.expected is not None:
        rates = f"promised rate {percent(signal.false_positives)}"
        tested = signal.measured is not None
        facts.append(rates + (f", measured {percent(signal.measured or 0.0)}" if tested else ""))
    return words + (f" ({'; '.join(facts)})" if facts else "")


#: Why a question was not asked, or cannot be told for too many samples.
UNKNOWN = {
    "no-images": "train and test have no images of one kind in common",
    "images-off": "images were left out",
    "no-frames": "no frame numbers of one video are known in both",
    "untouched": "too many images show no contact, so they cannot show what is new",
    "similar": "images of different videos are all similar, so they cannot show what is new",
    "chance": "too few images are known to be unrelated to show what similarity is chance",
    "unreadable": "too many images are missing or cannot be read",
    "ids": "nothing says which samples are one recording",
    "names": "equal names of different roots mean nothing, and no images decide",
    "nulls": "too many samples lack the group",
    "skipped": "too many rows were skipped",
    "frames": "too many samples lack a frame number",
}


def question_lines(audit: Audit) -> list[str]:
    """Return the answer to each question, asked or not."""
    lines: list[str] = []
    for q in audit.questions:
        counts = f" ({count(q.leaking)} of {count(q.of)})" * bool(q.leaking)
        why = f": {UNKNOWN[q.reason]}" if q.reason else ""
        lines.append(f"{q.name}: {q.verdict or 'not asked'}{counts}{why}")
    return lines


def leak_line(audit: Audit) -> str:
    """Return how many test samples any signal flags, and what they ask for."""
    n, total = audit.leaking_samples, plural(audit.test_samples, "test sample")
    why = next((q.reason for q in audit.questions if q.verdict and q.reason), "")
    if n:
        leak = "leaks" if n == 1 else "leak"
        if audit.at_least and n < audit.test_samples:
            return f"At least {count(n)} of {total} {leak}; there may be more: {UNKNOWN[why]}."
        return f"{count(n)} of {total} {leak} ({percent(audit.leaked_fraction)})."
    checked = sum(bool(signal.checked) for signal in audit.signals)
    signals = "the one signal" if checked == 1 else f"any of the {checked} signals"
    line = f"None of {total} leaks by {signals} checked."
    if audit.verdict == CANNOT_TELL:
        reasons = (UNKNOWN[q.reason] for q in audit.questions if q.verdict == CANNOT_TELL)
        why = "; ".join(dict.fromkeys(reasons))
        return f"{why[:1].upper()}{why[1:]}. {line}"
    return " ".join(filter(None, [line, question_line(audit)]))


def share_of(audit: Audit) -> str:
    """Return the verdict, with the leaking share of the test samples where it is known."""
    if audit.verdict != LEAKS or (audit.at_least and audit.leaked_fraction < 1):
        return audit.verdict
    return f"{LEAKS}, {percent(audit.leaked_fraction)}"


def question_line(audit: Audit) -> str:
    """Return what train and test share, and what the test part asks for; '' if nothing is known."""
    purpose = question(audit.shared)
    if not purpose or audit.against != "train":
        return ""
    things: list[str] = []
    for column, (n, total) in audit.shared.items():
        some = "no" if not n else "every" if n == total else "some"
        things.append(f"{some} {column} shared" + (f" ({count(n)} of {count(total)})" if n else ""))
    shared = next((c for c in ("object", "session") if audit.shared.get(c, (0, 0))[0]), "")
    other = f", not for new {shared}s" if shared else ""
    things[0] = things[0].capitalize()
    return f"{', '.join(things)}: the split is for {purpose}{other}."


def audit_line(audit: Audit) -> str:
    """Return the finding of one audit in one sentence."""
    name = audit.name if audit.against == "train" else f"{audit.name} against {data_of(audit)}"
    if not audit.test_samples:
        return f"{name}: the test part is empty, so nothing can leak."
    flagged = [s for s in audit.signals if s.flagged and s.counts and not audit.at_least]
    strongest = sorted(flagged, key=lambda s: -s.fraction)[:3]
    shares: list[str] = []
    for k, signal in enumerate(strongest):
        whose = "" if k else " of the test samples"
        if signal.checked < audit.test_samples:
            whose = f" of the {count(signal.checked)} checked"
        shares.append(f"{percent(signal.fraction)}{whose} {_kind(signal.kind, audit)[1]}")
    facts = [f"{audit.verdict}.", *(["; ".join(shares) + "."] if shares else [])]
    return f"{name}: {' '.join([*facts, leak_line(audit)])}"


def purpose(results: Results) -> str:
    """Return the question that the page answers."""
    parts: list[str] = []
    asked = {family_of(score)[1] for score in results.scores}
    probed = asked and not results.gallery and asked <= {"Power", "Recognition", "Retrieval"}
    if "Captions" in asked:
        parts.append("what do captions give away about their labels, and can they be used")
    elif results.strips or probed:
        parts.append(
            "what do an encoder's embeddings know of a sample: its class, its text, its image"
        )
    elif results.scores or any(item.generated for item in results.gallery):
        parts.append("how close do generated tactile images come to real ones")
    elif results.gallery:
        parts.append("which recordings should a person look at")
    if results.audits:
        parts.append("does the split leak")
    if results.claims:
        paper = any(claim.source.startswith("paper") for claim in results.claims)
        parts.append(f"which claims{' of Gungor et al. (ICCV 2025)' * paper} hold")
    if not parts and results.tables:
        parts.append("what did a study measure")
    if not parts:
        return "Results of palpate; nothing has been measured yet."
    *first, last = parts
    question = f"{', '.join(first)}{', and ' * bool(first)}{last}?"
    return question[:1].upper() + question[1:]


def score_line(scores: Sequence[Score]) -> str:
    """Return the first column with a value, in one sentence; '' if there is none."""
    for column in (column for family in families(scores) for column in family.columns):
        scored = [score for score in column.scores if defined(score)]
        if not scored:
            continue
        values = [f"{score.a} {with_interval(score, column.digits)}" for score in scored[:3]]
        floors = [score.floor for score in scored if score.floor is not None]
        floor = f"; floor {column.text(floors[0])}" if floors else ""
        better = BETTER[scored[0].higher_is_better]
        return f"{column.name} ({better}): {', '.join(values)}{floor}."
    return ""


def summary_lines(results: Results) -> list[str]:
    """Return at most three headline facts.

    The facts of the results come first, then the first and the last audit, what the first measured
    leak costs, the first metric and the size of the gallery.

    Raises:
        PalpateError: if scores of different settings would share a column.
    """
    audits = [*results.audits[:1], *results.audits[1:][-1:]]
    cost = next((a.impact.headline for a in results.audits if a.impact), "")
    images = plural(len(results.gallery), "generated image") if results.gallery else ""
    lines = [
        *results.facts,
        *map(audit_line, audits),
        cost,
        score_line(results.scores),
        f"{images} in the gallery." if images else "",
    ]
    return list(dict.fromkeys(filter(None, lines)))[:3]
