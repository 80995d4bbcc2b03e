"""Near-duplicate images in vision and tactile, which no metadata reveals.

Every test sample gets the train sample with the most similar image, a score in [0, 1], and, at or
over a threshold calibrated on the data, the cause:

=================  ===============================================================================
cause              when
=================  ===============================================================================
content            the images are similar (tactile: what the contact adds to the passive gel); only
                   this is a leak
nothing touched    both show nothing: blank photos, or no more than untouched gel (``pool``)
sensor drift       tactile images similar only in what varies slowly over the image, or in what the
                   passive gel shows at another time: light, gel and residue, not contact. With
                   videos known, an image whose score is near the threshold (0.8 of it as z) is
                   content if what varies slowly matches the same train image: then both indicate
                   a copy
=================  ===============================================================================

Steps: thumbnails and backgrounds (``pool``), candidates and similarity (``similarity``), score and
threshold (``matches``, ``calibration``), causes (``causes``).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from palpate.core import PalpateError, Progress, quiet
from palpate.data.manifest import Manifest
from palpate.leakage import calibration
from palpate.leakage.causes import blank_matches, gel_similarity
from palpate.leakage.matches import Entries, Matcher, Matches
from palpate.leakage.neighbors import Floats, Ints
from palpate.leakage.pool import Pool, codes, pool
from palpate.leakage.signals import Flags
from palpate.leakage.similarity import CosineSimilarity, ImageSimilarity, close_pairs

#: Share of a pair's similarity that the passive gel must reach to be the reason for it.
GEL_SHARE = 0.65
#: Share of the threshold, as z, from which a tactile image is a copy if what varies slowly agrees.
AGREED = 0.8
#: Nearest images that an image may be linked to in a cluster.
LINKS = 16


def near_duplicates(
    train: Manifest,
    test: Manifest,
    modality: str,
    *,
    false_positives: float = 0.001,
    features: tuple[object, object] | None = None,
    cache: Path | None = None,
    threads: int | None = None,
    progress: Progress = quiet,
) -> Flags:
    """Flag test samples whose image is nearly that of a train sample.

    Args:
        train: the samples to compare with.
        test: the samples in question.
        modality: ``vision`` or ``tactile``.
        false_positives: share of unrelated samples that may be flagged, in (0, 0.1].
        features: embeddings of train and test, (n_train, d) and (n_test, d), to compare instead of
            the images; causes are then all ``content``.
        cache: folder for thumbnails, so that a rerun is quick; None keeps nothing.
        threads: that decode.
        progress: callback.

    Raises:
        PalpateError: if the embeddings do not fit the samples.
    """
    if features is None:
        images = pool(train, test, modality, cache=cache, threads=threads, progress=progress)
        matcher = Matcher(ImageSimilarity(images.images), false_positives, images.blank, progress)
        item, videos = images.item, images.videos
    else:
        vectors = _embeddings(features, (len(train), len(test)))
        images, matcher = None, Matcher(CosineSimilarity(vectors), false_positives, None, progress)
        item, videos = np.arange(len(vectors)), codes((train, test), "video")
    cut = len(train)
    base, queries = Entries.of(item[:cut], videos[:cut]), Entries.of(item[cut:], videos[cut:])
    matches = matcher.match(base, queries)
    if images is not None:
        matches = blank_matches(images, base, queries, matches)
        if modality == "tactile":
            matches = _name_drift(matches, images, matcher, base, queries)
    flags = _flags(modality, matches, base, queries)
    notes = [*(images.notes if images is not None else []), *flags.notes]
    return replace(flags, false_positives=false_positives, notes=notes)


def near_groups(
    manifest: Manifest,
    modality: str,
    *,
    false_positives: float = 0.001,
    cache: Path | None = None,
    threads: int | None = None,
    progress: Progress = quiet,
) -> Ints:
    """Clusters of near-duplicates, to be kept whole by a split.

    Two images are linked if each is near the other by the rules of :func:`near_duplicates` and the
    cause is content; a cluster is a connected component. Clusters chain: the first and the last
    frame of a long slide may share nothing, so a cluster may be as large as a recording. That is
    what a split needs, but a cluster is no list of duplicates.

    Args:
        manifest: (n) samples.
        modality: as in :func:`near_duplicates`.
        false_positives: as in :func:`near_duplicates`.
        cache: folder for thumbnails, or None.
        threads: that decode.
        progress: callback.

    Returns:
        (n,) the number of each sample's cluster; -1 for samples that are near no other image, that
        show nothing, or that cannot be read.
    """
    none = Manifest(manifest.table.clear(), manifest.root)
    images = pool(manifest, none, modality, cache=cache, threads=threads, progress=progress)
    matcher = Matcher(ImageSimilarity(images.images), false_positives, images.blank, progress)
    entries = Entries.of(images.item, images.videos)
    entries = entries.only(np.unique(entries.item, return_index=True)[1])
    entries = entries.only(~images.blank[entries.item])
    i, j, similarity = close_pairs(matcher.similarity, entries.item, LINKS, progress)
    score, threshold, by_videos = _pair_scores(matcher, entries, i, j, similarity)
    linked = (score >= threshold) | (similarity >= matcher.similarity.same)
    if modality == "tactile":
        if by_videos:
            close = np.flatnonzero(~linked & (score >= _agreed(threshold)))
            linked[close] = _slow_agrees(images, matcher, entries, i[close], j[close])
        rows = np.unique(np.concatenate([i[linked], j[linked]]))
        gel = np.zeros(len(entries), np.float32)
        gel[rows] = gel_similarity(images, entries.only(rows))
        linked &= np.maximum(gel[i], gel[j]) < similarity * GEL_SHARE
    return _clusters(images.item, images.blank, entries.item[i[linked]], entries.item[j[linked]])


def _embeddings(features: tuple[object, object], counts: tuple[int, int]) -> Floats:
    """Train and test in one array, float32."""
    train, test = (np.asarray(f, np.float32) for f in features)
    shapes = [train.shape, test.shape]
    if (
        any(len(s) != 2 for s in shapes)
        or train.shape[1:] != test.shape[1:]
        or ((len(train), len(test)) != counts)
    ):
        raise PalpateError(
            f"The embeddings must be (n, d): {counts[0]} of train, {counts[1]} of test",
            " and ".join(map(str, shapes)),
            "Embed the same samples",
        )
    vectors = np.concatenate([train, test])
    if not np.isfinite(vectors).all():
        raise PalpateError(
            "The embeddings must be finite", "a number that is not", "Embed the images again"
        )
    return vectors


def _pair_scores(
    matcher: Matcher, entries: Entries, i: Ints, j: Ints, similarity: Floats
) -> tuple[Floats, float, bool]:
    """Scores of pairs of entries, the threshold, and whether it comes from videos."""
    limit, by_videos = matcher.calibrate(entries, entries)
    level = np.zeros(len(entries), np.float32)
    if by_videos:
        rows = np.unique(np.concatenate([i, j]))
        best = _best_elsewhere(entries, i, j, similarity)[rows]
        level[rows] = matcher.levels(entries, entries.only(rows), best)
    z = calibration.fisher(similarity)
    return calibration.score(z, np.maximum(level[i], level[j])), limit.threshold, by_videos


def _best_elsewhere(entries: Entries, i: Ints, j: Ints, similarity: Floats) -> Ints:
    """For each entry its most similar candidate in another video; -1 where there is none."""
    apart = np.flatnonzero((entries.videos[i] != entries.videos[j]) | (entries.videos[i] < 0))
    apart = apart[np.lexsort((j[apart], similarity[apart]))]
    best = np.full(len(entries), -1, np.int64)
    best[i[apart]] = j[apart]  # of several, the last written is the most similar
    return best


def _clusters(item: Ints, blank: NDArray[np.bool_], i: Ints, j: Ints) -> Ints:
    """Components of images that are linked, or belong to several samples; -1 for samples alone."""
    count = len(blank)
    graph = coo_matrix((np.ones(len(i), np.int8), (i, j)), shape=(count, count))
    component = connected_components(graph, directed=False)[1] if count else np.zeros(1, np.int64)
    usable = item >= 0
    usable[usable] = ~blank[item[usable]]
    label = np.where(usable, component[item], -1).astype(np.int64)
    sizes = np.bincount(label[usable], minlength=count + 1)
    return np.where(usable & (sizes[label] > 1), label, -1)


def _name_drift(
    matches: Matches, images: Pool, matcher: Matcher, base: Entries, queries: Entries
) -> Matches:
    """Name the tactile images that are similar through the state of the sensor alone."""
    cause, score, threshold = matches.cause.copy(), matches.score, matches.calibration.threshold
    slow = _slow(images, matcher).match(base, queries)
    only_slow = (slow.cause == "content") & (cause == "") & ~images.blank[queries.item]
    if matches.by_videos:
        # Images that share no more than the gel are as similar in fine structure as any two: a
        # score near the threshold shows more.
        agreed = only_slow & (slow.place == matches.place) & (score >= _agreed(threshold))
        cause[agreed], only_slow = "content", only_slow & ~agreed
        score = np.where(agreed, np.maximum(score, threshold), score)
    content = np.flatnonzero(cause == "content")
    gel = gel_similarity(images, queries.only(content))
    cause[content[gel >= matches.similarity[content] * GEL_SHARE]] = "sensor drift"
    cause[only_slow] = "sensor drift"
    score = np.where(only_slow, np.maximum(slow.score, threshold), score).astype(np.float32)
    place = np.where(only_slow, slow.place, matches.place)
    return replace(matches, cause=cause, score=score, place=place)


def _slow(images: Pool, matcher: Matcher) -> Matcher:
    """The same for what varies slowly over the image."""
    filtered, _ = images.filtered(slow=True, progress=matcher.progress)
    return replace(matcher, similarity=ImageSimilarity(filtered), blank=None)


def _agreed(threshold: float) -> float:
    """The score from which what varies slowly may decide."""
    return float(np.tanh(AGREED * np.arctanh(threshold)))


def _slow_agrees(
    images: Pool, matcher: Matcher, entries: Entries, i: Ints, j: Ints
) -> NDArray[np.bool_]:
    """Whether pairs of entries are similar in what varies slowly, by its threshold."""
    if not len(i):
        return np.zeros(0, bool)
    slow = _slow(images, matcher)
    similarity = slow.similarity.pairs(entries.item[i], entries.item[j], matcher.progress)
    score, threshold, _ = _pair_scores(slow, entries, i, j, similarity)
    return score >= threshold


def _flags(modality: str, matches: Matches, base: Entries, queries: Entries) -> Flags:
    """From entries to the samples of test."""
    count, limit = len(queries.back), matches.calibration
    score, nearest = np.full(count, np.nan, np.float32), np.full(count, -1, np.int64)
    cause = np.full(count, "", "<U15")
    known = queries.back >= 0
    if len(base):
        at = queries.back[known]
        score[known], cause[known] = matches.score[at], matches.cause[at]
        place = matches.place[at]
        nearest[known] = np.where(place >= 0, base.sample[place], -1)
    edges, unrelated, histogram = calibration.histograms(limit.unrelated, score)
    return Flags(
        f"near-duplicate {modality}",
        score,
        cause == "content",
        nearest,
        limit.threshold,
        edges=edges,
        unrelated=unrelated,
        matches=histogram,
        cause=cause,
        notes=limit.notes,
    )
