"""Means over samples, their differences, and what seeds add: by hand, and coverage by draws."""

import numpy as np
import pytest

from palpate.core import PalpateError
from palpate.metrics.means import mean_of, over_seeds, spread_of
from palpate.metrics.paired import differences_of_means


def draw(rng, videos, frames, video_effect, seed_effect=0.0, p=0.5):
    """Values of one training: a level, an effect a video and one of the seed, and noise."""
    names = np.repeat([f"v{k}" for k in range(len(video_effect))], frames)
    values = p + np.repeat(video_effect, frames) + seed_effect + 0.1 * rng.normal(size=len(names))
    return mean_of("m", values, names.tolist(), subject="a")


def test_a_video_is_left_out_of_both_sides_of_a_difference():
    """Two test parts of other frames of the same videos: what a video does to both cancels."""
    a = mean_of(
        "m", [1, 1, 0, 0, 1], list("ppqqr"), subject="a", split="1", settings={"axis": "split"}
    )
    b = mean_of("m", [1, 0, 0, 1], list("pqrr"), subject="b", split="2", settings={"axis": "split"})
    (score,) = differences_of_means({"a": [a], "b": [b]})
    assert score.value == pytest.approx(3 / 5 - 2 / 4)
    left = np.array([1 / 3 - 1 / 3, 3 / 3 - 2 / 3, 2 / 4 - 1 / 2])  # without p, q, r
    half = 4.302652729911275 * np.sqrt(2 / 3 * ((left - left.mean()) ** 2).sum())
    assert score.interval == pytest.approx((max(-1, 0.1 - half), min(1, 0.1 + half)))
    assert (score.a, score.b, score.details["better"]) == ("a", "b", "a")
    assert score.details["relative"] == pytest.approx(1 - 0.5 / 0.6)


def test_a_video_of_one_side_alone_changes_that_side_alone():
    a = mean_of("m", [1, 0], ["p", "q"], subject="a")
    assert a.without(np.array(["o", "p", "q"])) == pytest.approx([0.5, 0.0, 1.0])


def test_scores_of_two_splits_share_no_column_unless_the_split_is_the_axis():
    a, b = (mean_of("m", [1, 0], ["p", "q"], subject=s, split=s) for s in "ab")
    with pytest.raises(PalpateError, match="agree in split"):
        differences_of_means({"a": [a], "b": [b]})


def test_no_change_without_any_video_is_no_evidence_of_certainty():
    a, b = (mean_of("m", [1.0, 1.0], ["p", "q"], subject=s) for s in "ab")
    (score,) = differences_of_means({"a": [a], "b": [b]})
    assert (score.value, score.interval, score.details["p_value"]) == (0.0, None, None)
    assert [note.code for note in score.notes] == ["no-interval"]


def test_seeds_that_agree_without_any_variation_have_the_degrees_of_freedom_of_videos():
    spread = spread_of([[mean_of("m", [1, 1, 1], list("pqr"), subject="a")] * 2])
    assert (spread.value, spread.error, spread.df) == (1, 0, 2)


def test_seeds_widen_the_interval_by_their_deviation():
    runs = [mean_of("m", v, list("ppqq"), subject="a") for v in ([1, 0, 1, 1], [0, 0, 1, 1])]
    spread = spread_of([runs])
    left = np.array([1.0, 0.25])  # mean over seeds without p, without q
    of_videos = 1 / 2 * ((left - left.mean()) ** 2).sum()
    of_seeds = np.var([0.75, 0.5], ddof=1) / 2
    assert spread.value == pytest.approx(0.625)
    assert spread.error == pytest.approx(np.sqrt(of_videos + of_seeds))
    assert spread.df == pytest.approx((of_videos + of_seeds) ** 2 / (of_videos**2 + of_seeds**2))
    score = over_seeds(runs)
    assert score.details["by_seed"] == [0.75, 0.5]
    assert "2 seeds" in score.interval_method


@pytest.mark.parametrize(("seeds", "widest"), [(1, 0.12), (3, 0.4)])
def test_intervals_of_differences_cover_the_truth(seeds, widest):
    """True difference 0.1; what videos do to both splits cancels, what seeds do does not."""
    rng, hits, widths = np.random.default_rng(0), [], []
    for _ in range(200):
        shared, own = 0.3 * rng.normal(size=24), 0.05 * rng.normal(size=(2, 24))
        sets = {
            name: [
                draw(rng, 24, 5, shared + effect, 0.05 * rng.normal() * (seeds > 1), p)
                for _ in range(seeds)
            ]
            for name, effect, p in zip("ab", own, (0.6, 0.5), strict=True)
        }
        (score,) = differences_of_means(sets)
        hits.append(score.interval[0] <= 0.1 <= score.interval[1])
        widths.append(np.ptp(score.interval))
    assert np.mean(hits) >= 0.91
    assert np.mean(widths) < widest  # what both share would make it 0.36 if it did not cancel
