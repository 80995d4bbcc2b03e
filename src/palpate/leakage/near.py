"""Near-duplicate pictures in vision and touch, which no metadata reveals.

Every test sample gets the train sample that its picture is most like, a score in [0, 1], and, at or over a threshold calibrated on the data, the cause:

=================  ========================================================================================================
cause              when
=================  ========================================================================================================
content            the pictures themselves are alike (touch: what the contact adds to the passive gel); only this is a leak
nothing touched    both show nothing: blank photos, or tactile images that are no more than untouched gel (``pool``)
sensor drift       touches alike only in what varies slowly over the picture, or in what the passive gel shows at another time
                   (other backgrounds of the same video): light, gel and residue, not contact. With videos known, a touch whose score is near
                   the threshold (0.8 of it as z) is content if what varies slowly finds the same train touch: then both speak for a copy
=================  ========================================================================================================

Steps: thumbnails and background (``descriptors``, ``background``), candidates by nearest neighbors (``search``), similarity (``verify``), score and threshold (``calibrate``).
Between blank pictures the score is 1 - (root mean square difference of the thumbnails, the whole picture) / 32 gray levels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from palpate.core import PalpateError, Progress, quiet
from palpate.data.manifest import MODALITIES, Manifest
from palpate.leakage import calibrate
from palpate.leakage.causes import gel_at_other_times
from palpate.leakage.compare import Comparer, Embeddings, Plates, all_or_nearest
from palpate.leakage.matching import Entries, Found, calibrated, levels_of, match
from palpate.leakage.pool import Pool, codes, plates, pool
from palpate.leakage.verify import Floats, Ints

#: Share of a pair's similarity that the passive gel must reach to be the reason for it.
GEL_SHARE = 0.65
#: Share of the threshold, as z, from which a touch that is no copy by its fine structure alone is one if what varies slowly finds
#: the same train touch.
AGREED = 0.8
#: Nearest pictures that a picture may be linked to in a cluster.
LINKS = 16


@dataclass(frozen=True)
class NearMatches:
    """What near-duplicate detection found, sample by sample of test.

    Attributes:
        modality: ``vision`` or ``touch``.
        score: (n_test,) in [0, 1], of the most similar train sample (see ``calibrate``); NaN where the picture cannot be looked at.
        nearest: (n_test,) its row in train; -1 where there is none.
        flag: (n_test,) a near-duplicate of content: a leak.
        cause: (n_test,) one of ``palpate.core.CAUSES`` at or over the threshold, else ``""``.
        threshold: the score from which pictures are near-duplicates.
        false_positives: share of unrelated samples over it that it was calibrated to.
        edges, unrelated, found: histograms of the scores of unrelated best matches and of test against train, over the same bins.
        notes: sentences for people.
        settings: what was compared and how.
    """

    modality: str
    score: Floats
    nearest: Ints
    flag: NDArray[np.bool_]
    cause: NDArray[np.str_]
    threshold: float
    false_positives: float
    edges: list[float]
    unrelated: list[int]
    found: list[int]
    notes: list[str]
    settings: Mapping[str, Any] = field(default_factory=dict)


def near_duplicates(
    train: Manifest,
    test: Manifest,
    modality: str,
    *,
    false_positives: float = 0.001,
    features: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None,
    feature_name: str = "",
    cache: Path | None = None,
    processes: int | None = None,
    progress: Progress = quiet,
) -> NearMatches:
    """Finds test samples whose picture is nearly that of a train sample.

    Args:
        train: the samples to compare with.
        test: the samples to judge.
        modality: ``vision`` or ``touch``.
        false_positives: share of unrelated samples that may be flagged, in (0, 0.1].
        features: a trained encoder's embeddings of train and test, (n_train, d) and (n_test, d), to compare instead of the pictures; causes are then all ``content``.
        feature_name: names them, e.g. an encoder's digest.
        cache: folder for thumbnails, so that a rerun is quick; None keeps nothing.
        processes: that decode; None takes one a core.
        progress: told about the work.

    Raises:
        PalpateError: on an unknown modality, a rate out of range, or embeddings that do not fit the samples.
    """
    _check(modality, false_positives, features, (len(train), len(test)))
    if features is not None:
        comparer: Comparer = Embeddings(
            np.concatenate([np.asarray(f, np.float32) for f in features]),
            feature_name or "embeddings given",
        )
        item, videos, pictures = (
            np.arange(len(train) + len(test)),
            codes((train, test), "video"),
            None,
        )
    else:
        pictures, fine = pool(
            train, test, modality, cache=cache, processes=processes, progress=progress
        )
        comparer, item, videos = Plates(fine), pictures.item, pictures.videos
    cut = len(train)
    base, queries = Entries.of(item[:cut], videos[:cut]), Entries.of(item[cut:], videos[cut:])
    found = match(comparer, base, queries, false_positives, pictures, progress)
    if pictures is not None and modality == "tactile":
        found = _name_drift(found, pictures, comparer, base, queries, false_positives, progress)
    return _spread(found, modality, false_positives, comparer, base, queries, len(test), pictures)


def near_groups(
    manifest: Manifest,
    modality: str,
    *,
    false_positives: float = 0.001,
    features: NDArray[np.float32] | None = None,
    feature_name: str = "",
    cache: Path | None = None,
    processes: int | None = None,
    progress: Progress = quiet,
) -> NDArray[np.int64]:
    """Clusters of near-duplicates, to be kept whole by a split.

    Two pictures are linked if each is near the other by the rules of :func:`near_duplicates` and the cause is content; a cluster is a connected component. Clusters
    chain: the first and the last frame of a long slide may share nothing, and two videos are joined by one pair, so a cluster may be as large as a
    recording. That is what a split needs, but a cluster is no list of duplicates. Each picture is linked to its 16 nearest at most.

    Args:
        manifest: (n) samples.
        modality: as in :func:`near_duplicates`.
        false_positives: as in :func:`near_duplicates`.
        features: (n, d) embeddings instead of the pictures.
        feature_name: names them.
        cache: folder for thumbnails, or None.
        processes: that decode; None takes one a core.
        progress: told about the work.

    Returns:
        (n,) the number of each sample's cluster, 0, 1, ... by first occurrence; -1 for samples that are near no other picture, that show nothing, or that cannot be read.

    Raises:
        PalpateError: as :func:`near_duplicates`.
    """
    none = Manifest(manifest.table.clear(), manifest.root)
    both = None if features is None else (features, np.asarray(features)[:0])
    _check(modality, false_positives, both, (len(manifest), 0))
    if features is not None:
        comparer: Comparer = Embeddings(
            np.asarray(features, np.float32), feature_name or "embeddings given"
        )
        item, videos, pictures = np.arange(len(manifest)), codes((manifest,), "video"), None
    else:
        pictures, fine = pool(
            manifest, none, modality, cache=cache, processes=processes, progress=progress
        )
        comparer, item, videos = Plates(fine), pictures.item, pictures.videos
    entries = Entries.of(item, videos)
    if pictures is not None:
        entries = entries.only(~pictures.blank[entries.item])
    i, j, similarity = all_or_nearest(comparer, entries.item, LINKS, progress)
    calibration, by_videos = calibrated(
        comparer, entries, entries, false_positives, pictures, progress
    )
    level = np.zeros(len(entries), np.float32)
    if by_videos:
        level = levels_of(
            comparer, entries, entries, _best_elsewhere(entries, i, j, similarity), progress
        )
    score = calibrate.score(calibrate.fisher(similarity), np.maximum(level[i], level[j]))
    linked = (score >= calibration.threshold) | (similarity >= comparer.same)
    if by_videos and pictures is not None and modality == "tactile":
        close = np.flatnonzero(~linked & (score >= _least(calibration.threshold)))
        linked[close] = _slow_agrees(
            pictures, entries, i[close], j[close], false_positives, progress
        )
    i, j, similarity = i[linked], j[linked], similarity[linked]
    if pictures is not None and modality == "tactile" and len(i):
        some = np.unique(np.concatenate([i, j]))
        gel = np.zeros(len(entries), np.float32)
        gel[some] = gel_at_other_times(pictures, entries.item[some], entries.videos[some])
        kept = np.maximum(gel[i], gel[j]) < similarity * GEL_SHARE
        i, j = i[kept], j[kept]
    return _clusters(item, entries.item, i, j)


def _best_elsewhere(entries: Entries, i: Ints, j: Ints, similarity: Floats) -> Ints:
    """For each entry its most similar candidate in another video, whose video is then left out of its level; -1 where there is none."""
    apart = np.flatnonzero((entries.videos[i] != entries.videos[j]) | (entries.videos[i] < 0))
    apart = apart[np.lexsort((j[apart], similarity[apart]))]
    best = np.full(len(entries), -1, np.int64)
    best[i[apart]] = j[apart]  # of several, the last written is the most similar
    return best


def _clusters(item: Ints, nodes: Ints, i: Ints, j: Ints) -> Ints:
    """Components of pictures that are linked, or stand for several samples, numbered by first occurrence."""
    count = int(max(item.max(initial=-1), nodes.max(initial=-1))) + 1
    if not count:
        return np.full(len(item), -1, np.int64)
    graph = coo_matrix((np.ones(len(i), np.int8), (nodes[i], nodes[j])), shape=(count, count))
    component = connected_components(graph, directed=False)[1]
    allowed = np.zeros(count, bool)
    allowed[nodes] = True
    use = (item >= 0) & allowed[np.maximum(item, 0)]
    label = np.where(use, component[np.maximum(item, 0)], -1).astype(np.int64)
    sizes = np.bincount(label[use], minlength=count)
    label[use & (sizes[np.maximum(label, 0)] < 2)] = -1
    _, first, place = np.unique(label[label >= 0], return_index=True, return_inverse=True)
    label[label >= 0] = np.argsort(np.argsort(first))[place]
    return label


def _name_drift(
    found: Found,
    pictures: Pool,
    comparer: Comparer,
    base: Entries,
    queries: Entries,
    rate: float,
    progress: Progress,
) -> Found:
    """Tells touches that are alike through the state of the sensor from those alike in content."""
    cause, score = found.cause.copy(), found.score
    slow = match(Plates(plates(pictures, slow=True)[0]), base, queries, rate, None, progress)
    only = (slow.cause == "content") & (cause == "") & ~pictures.blank[queries.item]
    if found.by_videos:
        # Touches that share no more than the gel are as alike in fine structure as any two: a score near the threshold tells of more.
        agreed = only & (slow.place == found.place) & (score >= _least(found.calibration.threshold))
        cause[agreed], only = "content", only & ~agreed
        score = np.where(agreed, np.maximum(score, found.calibration.threshold), score)
    content = np.flatnonzero(cause == "content")
    if len(content):
        gel = gel_at_other_times(pictures, queries.item[content], queries.videos[content])
        cause[content[gel >= found.similarity[content] * GEL_SHARE]] = "sensor drift"
    score = np.where(only, np.maximum(slow.score, found.calibration.threshold), score).astype(
        np.float32
    )
    cause[only] = "sensor drift"
    return replace(found, cause=cause, score=score, place=np.where(only, slow.place, found.place))


def _least(threshold: float) -> float:
    """The score from which what varies slowly may decide."""
    return float(np.tanh(AGREED * np.arctanh(threshold)))


def _slow_agrees(
    pictures: Pool, entries: Entries, i: Ints, j: Ints, rate: float, progress: Progress
) -> NDArray[np.bool_]:
    """Whether the pairs (i, j) of entries are alike in what varies slowly, by a threshold of its own."""
    if not len(i):
        return np.zeros(0, bool)
    comparer = Plates(plates(pictures, slow=True)[0])
    calibration, by_videos = calibrated(comparer, entries, entries, rate, None, progress)
    similarity, level = (
        comparer.pairs(entries.item[i], entries.item[j], progress),
        np.zeros(len(entries), np.float32),
    )
    if by_videos:
        some = np.zeros(len(entries), bool)
        some[i], some[j] = True, True
        level[some] = levels_of(
            comparer,
            entries,
            entries.only(some),
            _best_elsewhere(entries, i, j, similarity)[some],
            progress,
        )
    return (
        calibrate.score(calibrate.fisher(similarity), np.maximum(level[i], level[j]))
        >= calibration.threshold
    )


def _spread(
    found: Found,
    modality: str,
    rate: float,
    comparer: Comparer,
    base: Entries,
    queries: Entries,
    count: int,
    pictures: Pool | None,
) -> NearMatches:
    """From entries to the samples of test."""
    has = queries.back >= 0
    score, nearest = np.full(count, np.nan, np.float32), np.full(count, -1, np.int64)
    cause = np.full(count, "", "<U15")
    if len(queries) and len(base):
        at = queries.back[has]
        score[has], cause[has] = found.score[at], found.cause[at]
        nearest[has] = np.where(
            found.place[at] >= 0, base.sample[np.maximum(found.place[at], 0)], -1
        )
    edges, unrelated, histogram = calibrate.histograms(found.calibration.unrelated, score)
    notes = [*(pictures.notes if pictures is not None else []), *found.calibration.notes]
    settings = {
        "features": comparer.name,
        "pictures": len(base) + len(queries),
        "false_positives": rate,
        "unrelated": len(found.calibration.unrelated),
        "blank_limit": pictures.limit if pictures is not None else None,
    }
    return NearMatches(
        modality,
        score,
        nearest,
        cause == "content",
        cause,
        found.calibration.threshold,
        rate,
        edges,
        unrelated,
        histogram,
        notes,
        settings,
    )


def _check(
    modality: str,
    rate: float,
    features: tuple[NDArray[np.float32], NDArray[np.float32]] | None,
    counts: tuple[int, int],
) -> None:
    if modality not in MODALITIES:
        raise PalpateError(
            "The modality must be vision or touch", repr(modality), "Pass one of them"
        )
    if not 0 < rate <= 0.1:
        raise PalpateError(
            "The false-positive rate must lie in (0, 0.1]", str(rate), "Pass e.g. 0.001"
        )
    if features is None:
        return
    shapes = [np.asarray(f).shape for f in features]
    if (
        any(len(s) != 2 for s in shapes)
        or tuple(s[0] for s in shapes) != counts
        or shapes[0][1] != shapes[1][1]
    ):
        raise PalpateError(
            f"The embeddings must be (n, d), a row a sample: {counts[0]} of train, {counts[1]} of test",
            " and ".join(str(s) for s in shapes),
            "Embed the same manifests",
        )
    if not all(np.isfinite(f).all() for f in features):
        raise PalpateError(
            "The embeddings must be finite", "a number that is not", "Embed the pictures again"
        )
