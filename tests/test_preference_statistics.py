"""Statistics of votes, each against a direct computation from its textbook definition."""

from itertools import permutations

import numpy as np
import pytest
from scipy import stats

from palpate.preference import statistics as s

PAIRS = [(0, 1), (0, 2), (1, 2)]


def table(seed, raters=4, units=30, missing=0.2):
    """Codes of raters who often agree, -1 where there is none."""
    rng = np.random.default_rng(seed)
    truth = rng.integers(0, 3, units)
    codes = np.where(rng.random((raters, units)) < 0.7, truth, rng.integers(0, 3, (raters, units)))
    return np.where(rng.random((raters, units)) < missing, -1, codes)


@pytest.mark.parametrize("seed", range(3))
def test_alpha_is_one_less_observed_over_expected_disagreement(seed):
    codes = table(seed)
    units = [column[column >= 0] for column in codes.T]
    units = [u for u in units if len(u) > 1]
    pooled = np.concatenate(units)
    observed = sum(
        sum(a != b for a, b in permutations(u.tolist(), 2)) / (len(u) - 1) for u in units
    ) / len(pooled)
    expected = sum(a != b for a, b in permutations(pooled.tolist(), 2)) / (
        len(pooled) * (len(pooled) - 1)
    )
    assert s.krippendorff_alpha(codes) == pytest.approx(1 - observed / expected)


def test_alpha_of_the_published_example():
    """Krippendorff 2011, "Computing Krippendorff's Alpha-Reliability", section C: 0.743."""
    a = [1, 2, 3, 3, 2, 1, 4, 1, 2, -1, -1, -1]
    b = [1, 2, 3, 3, 2, 2, 4, 1, 2, 5, -1, 3]
    c = [-1, 3, 3, 3, 2, 3, 4, 2, 2, 5, 1, -1]
    d = [1, 2, 3, 3, 2, 4, 4, 1, 2, 5, 1, -1]
    assert s.krippendorff_alpha(np.array([a, b, c, d])) == pytest.approx(0.743, abs=5e-4)


def coins(pairs, raters=4, items=200):
    """Codes (R, C, N) of raters who toss a coin between the two methods of each comparison."""
    heads = np.random.default_rng(0).random((raters, len(pairs), items)) < 0.5
    first, second = np.array(pairs).T[:, None, :, None]
    return np.where(heads, first, second)


@pytest.mark.parametrize("pairs", [PAIRS, [(0, 1), (0, 2)]], ids=["all pairs", "the paper's"])
def test_raters_who_toss_coins_agree_no_more_than_chance(pairs):
    """A method that is not on the screen is no answer that chance could give."""
    codes = coins(pairs)
    assert abs(s.krippendorff_alpha(codes)) < 0.06
    assert abs(s.cohen_kappa(codes)) < 0.06
    pooled = codes.reshape(len(codes), -1)
    assert s.krippendorff_alpha(pooled) > 0.15


def test_agreement_of_one_comparison_is_that_of_its_units():
    codes = table(0)
    for value in (s.krippendorff_alpha, s.cohen_kappa):
        assert value(codes[:, None]) == pytest.approx(value(codes))


def test_kappa_is_agreement_beyond_chance():
    x, y = table(0, raters=2, missing=0)
    cells = np.zeros((3, 3))
    np.add.at(cells, (x, y), 1 / len(x))
    chance = cells.sum(axis=1) @ cells.sum(axis=0)
    assert s.cohen_kappa(np.array([x, y])) == pytest.approx(
        (np.trace(cells) - chance) / (1 - chance)
    )
    assert s.raw_agreement(np.array([x, y])) == pytest.approx(np.trace(cells))


def test_agreement_without_anything_in_common_is_not_known():
    apart = np.array([[0, -1], [-1, 1]])
    for value in (s.raw_agreement, s.cohen_kappa, s.krippendorff_alpha):
        assert np.isnan(value(apart))


def bradley_terry(wins, sweeps=2000):
    """Strengths without ties by Zermelo's iteration; ``wins[i, j]``: how often i beat j."""
    pi = np.ones(len(wins))
    for _ in range(sweeps):
        games = (wins + wins.T) / np.add.outer(pi, pi)
        pi = wins.sum(axis=1) / games.sum(axis=1)
        pi /= pi.prod() ** (1 / len(pi))
    return np.log(pi)


def test_davidson_without_ties_is_bradley_terry(monkeypatch):
    monkeypatch.setattr(s, "PRIOR", 1e3)
    counts = np.array([[30.0, 0, 10], [26, 0, 14], [15, 0, 25]])
    wins = np.zeros((3, 3))
    for (a, b), (x, _, y) in zip(PAIRS, counts, strict=True):
        wins[a, b], wins[b, a] = x, y
    assert s.davidson(counts, PAIRS, 3)[:3] == pytest.approx(bradley_terry(wins), abs=1e-4)


def test_davidson_with_ties_is_where_its_likelihood_has_no_slope(monkeypatch):
    monkeypatch.setattr(s, "PRIOR", 1e3)
    counts = np.array([[30.0, 12, 10], [26, 5, 14], [15, 9, 25]])
    x = s.davidson(counts, PAIRS, 3)

    def log_likelihood(x):
        total, pi, nu = 0.0, np.exp(x[:3]), np.exp(x[3])
        for (a, b), row in zip(PAIRS, counts, strict=True):
            tie = nu * np.sqrt(pi[a] * pi[b])
            total += row @ np.log(np.array([pi[a], tie, pi[b]]) / (pi[a] + tie + pi[b]))
        return total

    best = log_likelihood(x)
    for step in np.vstack([np.eye(4), -np.eye(4)]) * 0.02:
        assert log_likelihood(x + step) < best


def test_davidson_of_a_method_that_always_wins_is_finite():
    strengths = s.davidson(np.array([[40.0, 0, 0], [40, 0, 0], [0, 0, 40]]), PAIRS, 3)[:3]
    assert np.abs(strengths).max() < 10
    assert strengths[0] > strengths[2] > strengths[1]


def test_sign_test_is_the_binomial_test():
    for a, b in ((3, 9), (5, 5), (0, 7), (40, 22)):
        assert s.sign_test(a, b) == pytest.approx(stats.binomtest(a, a + b).pvalue)
    assert np.isnan(s.sign_test(0, 0))


def test_tau_is_scipys_where_every_observation_weighs_one():
    rng = np.random.default_rng(0)
    x, y = rng.integers(0, 6, 30).astype(float), rng.integers(0, 6, 30).astype(float)
    assert s.tau_b(x, y, np.ones(30)) == pytest.approx(stats.kendalltau(x, y).statistic)
    mirrored = stats.kendalltau(np.r_[x, -x], np.r_[y, -y]).statistic
    assert s.tau_b(x, y, np.ones(30), mirrored=True) == pytest.approx(mirrored)
    twice = np.r_[x, x[:5]], np.r_[y, y[:5]]
    weights = np.r_[np.full(5, 2.0), np.ones(25)]
    assert s.tau_b(x, y, weights) == pytest.approx(stats.kendalltau(*twice).statistic)


def test_preferences_count_ties_as_half_and_skip_what_was_not_answered():
    votes = np.array([[[1, 0, -1, np.nan]], [[1, 1, np.nan, np.nan]]])
    counts = s.outcome_counts(votes, s.Weights.once(2, 4))
    assert counts.tolist() == [[[3, 1, 1]]]
    assert s.preferences(counts)[0, 0] == 3.5 / 5
    assert np.isnan(s.preferences(np.zeros(3)))


def test_replicates_weigh_a_vote_by_rater_and_item():
    rng = np.random.default_rng(0)
    votes = rng.integers(-1, 2, (3, 2, 5)).astype(float)
    weights = s.Weights.draw(3, 5, rng, 4)
    counts = s.outcome_counts(votes, weights)
    for b in range(4):
        for c in range(2):
            direct = sum(
                weights.raters[b, r] * weights.items[b, i] * (votes[r, c, i] == 1)
                for r in range(3)
                for i in range(5)
            )
            assert counts[b, c, 0] == direct


def test_two_raters_are_not_resampled():
    weights = s.Weights.draw(2, 40, np.random.default_rng(0), 10)
    assert (weights.raters == 1).all()
    assert (s.Weights.draw(3, 40, np.random.default_rng(0), 10).raters != 1).any()


def test_methods_are_preferred_on_average_over_their_comparisons():
    shares = np.array([0.8, 0.6, 0.3])
    assert s.method_preferences(shares, PAIRS, 3) == pytest.approx([0.7, 0.25, 0.55])
    assert s.method_preferences(shares, PAIRS, 3).mean() == pytest.approx(0.5)


def test_intervals_need_variation():
    assert s.percentiles(np.full(100, 0.5)) is None
    assert s.percentiles(np.full(100, np.nan)) is None
    low, high = s.percentiles(np.linspace(0, 1, 1001))
    assert (low, high) == pytest.approx((0.025, 0.975))


def test_studies_too_small_for_an_interval_have_no_expected_width():
    """Counted as width 0 they would look the most precise of all."""
    assert np.isnan(s.expected_half_width(1, 1))
    assert s.expected_half_width(3, 1) > s.expected_half_width(20, 1)


def test_the_bound_of_unanimous_votes_is_clopper_and_pearsons():
    exact = stats.binomtest(24, 24).proportion_ci(0.95, "exact")
    assert s.unanimous_bound(1.0, 24) == pytest.approx((exact.low, 1))
    assert s.unanimous_bound(0.0, 24) == pytest.approx((0, 1 - exact.low))
    assert s.unanimous_bound(0.5, 24) == pytest.approx((exact.low / 2, 1 - exact.low / 2))


def test_strengths_are_the_priors_where_a_method_only_wins():
    won, mixed, tied = [9.0, 0, 0], [5.0, 0, 4], [8.0, 1, 0]
    assert s.prior_decides(np.array([won, won, mixed]), PAIRS, 3)
    assert not s.prior_decides(np.array([won, tied, mixed]), PAIRS, 3)
    assert not s.prior_decides(np.array([won, [0.0, 0, 9], won]), PAIRS, 3)  # a circle


def test_more_items_and_raters_make_the_expected_interval_narrower():
    few, more = s.expected_half_width(20, 5), s.expected_half_width(80, 20)
    assert few == s.expected_half_width(20, 5)
    assert 0.05 < more < few < 0.25
