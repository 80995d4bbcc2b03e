"""Do captions give labels away, and can they be used?

A caption should describe what is felt without naming the material: a generator or encoder trained
on names learns the label instead of the touch. Two kinds of scores say how far that holds:

* *Shares of captions*, each text of a contact counted once: those that name their label (with
  inflections and synonyms) or any material, with words for what no finger feels (``visual words``),
  with digits, refusals, empty, overlong, the commonest text, and test captions that train has word
  for word.
* *Accuracy of the material from the text alone* on new videos, by a bag of words and logistic
  regression, five folds over whole videos: as it is, and with the names of materials masked. Near 1
  with masked names, the text is a code of the label in other words.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from palpate.captions.prompts import REFUSAL
from palpate.captions.vocabulary import Vocabulary, visual_in, words_of
from palpate.core import (
    FeatureSet,
    Note,
    PalpateError,
    Progress,
    Score,
    Split,
    quiet,
    require,
    rng_for,
    track,
)
from palpate.core.messages import require_joined
from palpate.data.manifest import Manifest, read_parquet
from palpate.data.reading import load
from palpate.data.texts import TABLE, joined, read_texts
from palpate.metrics.means import mean_of
from palpate.metrics.probe import fit_probe
from palpate.report.results import Call, Results

#: A caption of more words is overlong.
MOST_WORDS = 40
#: A text that more than this share of the captions have is worth a note.
COMMON = 0.05
#: Above this accuracy without the names of materials, the text is a code of the label.
CODE = 0.9
#: The predictor of materials: folds over videos, L2 penalty, commonest words in the bag.
FOLDS, PENALTY, WORDS = 5, 1e-2, 500
SETTINGS = {"words": WORDS, "penalty": PENALTY, "folds": FOLDS}
#: Words of a share that are kept in its details.
LISTED_WORDS = 12
#: Metric of the shares, and the subjects of some.
SHARE, FLAGGED, NAMING = "share of captions", "flagged", "naming a material"
LABEL, VISUAL = "naming their label", "visual words"
#: Shares whose words a note lists.
WITH_WORDS = (NAMING, LABEL, VISUAL)


def check_captions(
    captions: Any,
    data: Any = None,
    *,
    split: Split | str | Path | None = None,
    seed: int = 0,
    progress: Progress = quiet,
    **options: Any,
) -> Results:
    """Check captions for labels in them, and for what makes them useless.

    Args:
        captions: folder of :func:`palpate.caption` or a table with ``id`` and ``text``; without
            ``data`` also a manifest with texts, or anything that :func:`palpate.load` reads.
        data: the samples: their materials, videos and contacts.
        split: also look for texts that train and test share.
        seed: of the folds.
        progress: progress callback.
        options: options of a table without ``data``, e.g. ``columns``.

    Returns:
        Scores: shares of captions, and accuracies of the material from the text alone. The share
        ``flagged`` is of those that name their label, have visual words or digits, are a refusal,
        empty or overlong.

    Raises:
        PalpateError: if there are no captions, or they are of other samples.
    """
    arguments = {"captions": captions, "data": data, "split": split, "seed": seed} | options
    call = Call.of("caption check", check_captions, arguments)
    manifest, flags = _read(captions, data, options)
    if split is not None:
        split = Split.load(split)
        require_joined(manifest.ids, split.parts, "The split")
    rows = _rows(manifest, flags, split)
    vocabulary = Vocabulary(sorted({*rows["label"]} - {""}))
    scores, notes = _faults(rows, vocabulary), list[Note]()
    if split is not None:
        scores.append(_copied(rows))
    if not any(rows["label"]):
        notes.append(Note("captions-no-labels"))
    else:
        accuracies, notes = _accuracies(rows, vocabulary, seed, progress)
        scores += accuracies
    digests = {"manifest": manifest.digest} | ({"split": split.digest} if split else {})
    return Results(
        title="Check of captions",
        scores=scores,
        notes=notes,
        settings={
            "digests": digests,
            "text source": manifest.facts.get("text_source", "unknown"),
            "options": {"seed": seed} | SETTINGS,
        },
        calls=[call.with_digests(digests)],
    )


def _read(
    captions: Any, data: Any, options: dict[str, Any]
) -> tuple[Manifest, dict[str, list[str]]]:
    """The samples with their captions as texts, and the flags by id where they were kept.

    Captions are what ``palpate caption`` wrote, or any samples that have texts.

    Raises:
        PalpateError: if there are none, or they are of other samples.
    """
    if isinstance(captions, str | Path):
        captions = Path(captions)
        captions = captions / TABLE if (captions / TABLE).is_file() else captions
    if data is None:
        manifest = load(captions, images=False, **options)
    elif isinstance(captions, Path):
        manifest = joined(load(data), read_texts(captions), captions, keep=False)
    else:
        must = "must be a folder or a table next to samples"
        raise PalpateError(must, type(captions).__name__, "", argument="captions")
    must, fix = "must hold captions", "Map the column text, or caption the samples first"
    texts, got = manifest.table["text"].count(), f"{captions} without any text"
    require(texts > 0, "captions", must, got, fix=fix)
    flags: dict[str, list[str]] = {}
    if isinstance(captions, Path) and captions.suffix == ".parquet":
        table = read_parquet(captions)
        if table.schema.get("flags") == pl.List(pl.String):
            flags = dict(table.select("id", "flags").iter_rows())
    return manifest, flags


def _rows(manifest: Manifest, flags: dict[str, list[str]], split: Split | None) -> pl.DataFrame:
    """A row for each different text of a contact.

    Returns:
        ``text``, ``label`` and ``part`` of the split, ``""`` for none; ``group``, the recording;
        and ``refused``, whether it was marked as a refusal when it came.
    """
    parts = {} if split is None else split.parts
    rows = manifest.table.select(
        "id",
        unit=pl.coalesce(pl.col("contact"), pl.col("id")),
        text=pl.col("text").fill_null("").str.strip_chars(),
        label=pl.col("material").fill_null(""),
        group=pl.coalesce(*(pl.col(c) for c in ("video", "session", "object", "contact", "id"))),
    ).unique(["unit", "text"], keep="first", maintain_order=True)
    return rows.with_columns(
        part=pl.Series([parts.get(name, "") for name in rows["id"]], dtype=pl.String),
        refused=pl.Series(["refusal" in flags.get(name, ()) for name in rows["id"]]),
    )


def _faults(rows: pl.DataFrame, vocabulary: Vocabulary) -> list[Score]:
    """The share of captions with each fault; first of those with any but naming a material.

    Naming another material than its own gives no label away.
    """
    words_by_fault: dict[str, Callable[[str], Sequence[str]]] = {
        NAMING: vocabulary.naming,
        VISUAL: visual_in,
        "digits": lambda text: [c for c in text if c.isdigit()],
        "refusals": lambda text: ["refusal"] if REFUSAL.search(text) else [],
        "empty": lambda text: [] if text else ["empty"],
        f"over {MOST_WORDS} words": lambda text: ["long"] * (len(words_of(text)) > MOST_WORDS),
    }
    texts, labels = rows["text"].to_list(), rows["label"].to_list()
    hits = {name: [function(text) for text in texts] for name, function in words_by_fault.items()}
    if any(labels):
        pairs = zip(texts, labels, strict=True)
        named = [vocabulary.naming(text, label) if label else [] for text, label in pairs]
        hits = {LABEL: named, **hits}
    pairs = zip(hits["refusals"], rows["refused"], strict=True)
    hits["refusals"] = [words or ["refusal"] * refused for words, refused in pairs]
    counted = [words for name, words in hits.items() if name != NAMING]
    flagged = [[word for words in row for word in words] for row in zip(*counted, strict=True)]
    scores = [_share_of(name, words, rows) for name, words in {FLAGGED: flagged, **hits}.items()]
    text, count = Counter(texts).most_common(1)[0]
    common = _share_of("the commonest text", [[t] * (t == text) for t in texts], rows)
    if count > max(1, COMMON * len(texts)) and text:
        common = replace(common, notes=[Note("captions-common", {"text": text, "count": count})])
    return [*scores, common]


def _share_of(name: str, words: Sequence[Sequence[str]], rows: pl.DataFrame) -> Score:
    """The share of captions with words of a kind, and those words."""
    hits = np.array([bool(row) for row in words])
    score = mean_of(SHARE, hits, rows["group"].to_list(), estimator="mean", subject=name).score
    counts = Counter(word for row in words for word in set(row))
    listed = dict(counts.most_common(LISTED_WORDS))
    notes = [Note("captions-words", {"words": listed})] if name in WITH_WORDS and listed else []
    return replace(score, higher_is_better=False, details={"words": listed}, notes=notes)


def _copied(rows: pl.DataFrame) -> Score:
    """The share of test captions that train has word for word."""
    train, test = (rows.filter(pl.col("part") == part) for part in ("train", "test"))
    texts = {text.lower() for text in train["text"] if text}
    must, got = "must have captions in train and test", f"{len(texts)} and {len(test)}"
    both = bool(texts) and len(test) > 0
    require(both, "split", must, got, fix="Use the split of these samples")
    words = [[text] * (text.lower() in texts) for text in test["text"]]
    return _share_of("test captions that train has", words, test)


def _accuracies(
    rows: pl.DataFrame, vocabulary: Vocabulary, seed: int, progress: Progress
) -> tuple[list[Score], list[Note]]:
    """Material accuracy from the text alone on new groups, without names, and of the majority."""
    rows = rows.filter((pl.col("label") != "") & (pl.col("text") != ""))
    labels, groups, lines = (rows[name].to_list() for name in ("label", "group", "text"))
    names, number = np.unique(np.array(groups), return_inverse=True)
    if len(names) < 2 * FOLDS or len(set(labels)) < 2:
        return [], [Note("captions-few", {"groups": len(names), "materials": len(set(labels))})]
    fold = np.argsort(rng_for(seed, "caption folds").permutation(len(names)))[number] % FOLDS
    masked = [vocabulary.masked(text) for text in lines]
    predicted: dict[str, NDArray[Any]] = {}
    texts = {"text": lines, "text without names of materials": masked}
    for subject, each in track(list(texts.items()), "predicting materials from texts", progress):
        predicted[subject] = _predicted(each, labels, groups, fold)
    predicted["commonest material"] = _majority(labels, fold)
    scores: list[Score] = []
    for subject, materials in predicted.items():
        hits = materials == np.array(labels)
        metric, settings = "material accuracy from the text", dict(SETTINGS)
        result = mean_of(
            metric, hits, groups, subject=subject, estimator="mean", settings=settings, seed=seed
        )
        scores.append(replace(result.score, higher_is_better=False))
    without_names = scores[1].value or 0.0
    notes = [Note("captions-code", {"accuracy": without_names})] if without_names > CODE else []
    return [replace(scores[0], notes=notes), *scores[1:]], []


def _predicted(
    texts: Sequence[str], labels: Sequence[str], groups: Sequence[str], fold: NDArray[np.intp]
) -> NDArray[Any]:
    """Materials predicted by a bag of words fitted to the other folds: (n,)."""
    bags = [set(words_of(text)) for text in texts]
    predicted = np.empty(len(texts), dtype=object)
    for k in range(FOLDS):
        train, test = np.flatnonzero(fold != k), np.flatnonzero(fold == k)
        counts = Counter(word for row in train for word in bags[row])
        words = [word for word, count in counts.most_common(WORDS) if count > 1]
        column = {word: c for c, word in enumerate(words)}
        features = np.zeros((len(texts), len(words) + 1))
        for row, bag in enumerate(bags):
            features[row, [column[word] for word in bag if word in column]] = 1
        label, group = ([str(items[row]) for row in train.tolist()] for items in (labels, groups))
        names = [str(row) for row in train]
        probe = fit_probe(FeatureSet(names, features[train], label, group), l2=PENALTY)
        predicted[test] = probe.predict(features[test])
    return predicted


def _majority(labels: Sequence[str], fold: NDArray[np.intp]) -> NDArray[Any]:
    """The commonest material of the other folds: (n,)."""
    names = np.array(labels)
    common = [Counter(names[fold != k].tolist()).most_common(1)[0][0] for k in range(FOLDS)]
    return np.array(common)[fold]
