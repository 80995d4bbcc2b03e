"""Votes of simulated raters become scores; what is wrong with votes is said."""

import json
from contextlib import closing
from dataclasses import replace
from itertools import combinations, product

import numpy as np
import pytest
from scipy import stats

from forge.commands import python
from forge.errors import fails
from forge.people import Crowd, signed, write_folders
from palpate import preference
from palpate.core import Note, PalpateError, quiet
from palpate.preference.agreement import agreement_scores, of_images
from palpate.preference.arrays import VoteArrays
from palpate.preference.plan import Plan
from palpate.preference.raters import rater_facts
from palpate.preference.store import CELLS, VoteStore
from palpate.preference.votes import read_votes
from palpate.report.results import Results

CROWD = Crowd({"ours": 2.0, "gvst": 0.5, "wbg": -1.0})


@pytest.fixture(scope="module")
def study(rated, tmp_path_factory):
    top = tmp_path_factory.mktemp("study") / "study"
    rated.make(top, items=24, raters=12, size=32)
    return top


@pytest.fixture(scope="module")
def plan(study):
    return Plan.load(study)


@pytest.fixture(scope="module")
def downloads(plan, tmp_path_factory):
    return CROWD.write(plan, tmp_path_factory.mktemp("votes") / "votes")


@pytest.fixture(scope="module")
def results(study, downloads):
    return preference.score(study, downloads, replicates=400)


def codes(results):
    return {note.code: note.params for note in results.notes}


def test_planted_preferences_lie_in_their_intervals(results):
    for row in results.settings["preference"]["comparisons"]:
        low, high = row["interval"]
        assert low <= CROWD.preference(row["a"], row["b"]) <= high
        assert row["votes_a"] + row["ties"] + row["votes_b"] == 24 * 12
    strengths = [results["human strength", name].value for name in ("ours", "gvst", "wbg")]
    assert strengths == sorted(strengths, reverse=True)
    assert sum(strengths) == pytest.approx(0, abs=1e-6)
    details = results["human preference difference", "ours - wbg"].details
    assert (details["better"], details["decided"], details["p_adjusted"] < 0.05) == (
        "ours",
        True,
        True,
    )


def counted(plan, downloads):
    """Counts of raters and items of 100 replicates; (rater, a, b, item) -> the chosen method."""
    votes = read_votes(plan, [downloads])
    drawn = VoteArrays(plan, votes, [r.code for r in plan.raters], 0, 100).resampled
    chosen = {
        (r, v.trial.left, v.trial.right, v.trial.item): v.chosen
        for r, own in votes.by_rater.items()
        for v in own.values()
        if v.trial.kind == "pair"
    }
    return list(zip(drawn.raters, drawn.items, strict=True)), chosen


def test_preferences_and_differences_are_those_of_a_slow_count(plan, study, downloads):
    drawn, chosen = counted(plan, downloads)
    results = preference.score(study, downloads, replicates=100)
    codes, ids = ([x.code for x in plan.raters], [x.id for x in plan.items])

    def share(a, b, raters, items):
        weight = {r: {i: n * m for i, m in zip(ids, items, strict=True)} for r, n in raters}
        cells = [(weight[r][i], c) for (r, x, y, i), c in chosen.items() if (x, y) == (a, b)]
        points = sum(w * ((c == a) + 0.5 * (c == "same")) for w, c in cells)
        return points / sum(w for w, _ in cells)

    once = [(np.ones(12), np.ones(24))]
    shares = {
        pair: [share(*pair, list(zip(codes, r, strict=True)), i) for r, i in [*once, *drawn]]
        for pair in combinations(plan.methods, 2)
    }

    def require_equal(score, values):
        assert score.value == pytest.approx(values[0])
        assert score.interval == pytest.approx(np.quantile(values[1:], [0.025, 0.975]))

    for pair, values in shares.items():
        difference = results["human preference difference", f"{pair[0]} - {pair[1]}"]
        require_equal(difference, 2 * np.array(values) - 1)
    for name in plan.methods:
        of = [v if p[0] == name else 1 - np.array(v) for p, v in shares.items() if name in p]
        require_equal(results["human preference", name], np.mean(of, axis=0))


def test_davidson_expects_as_many_ties_as_there_are(results):
    rows = results.settings["preference"]["comparisons"]
    strength = {s.a: np.exp(s.value) for s in results.scores if s.metric == "human strength"}
    nu, expected = results["human strength", "ours"].details["nu"], 0.0
    for row in rows:
        a, b = strength[row["a"]], strength[row["b"]]
        tie = nu * np.sqrt(a * b)
        expected += (row["votes_a"] + row["ties"] + row["votes_b"]) * tie / (a + b + tie)
    assert expected == pytest.approx(sum(row["ties"] for row in rows), rel=0.02)


def test_resamples_without_a_vote_say_nothing_about_who_is_better(plan, study, tmp_path):
    """Of one comparison two items alone are answered, one for each method: no one is ahead."""
    first, second = (item.id for item in plan.items[:2])
    for code in ("r01", "r02", "r03"):
        download, shown = CROWD.download(plan, code), plan.shown(code)
        kept = []
        for vote in download["votes"]:
            trial, swapped = shown[vote["trial"]]
            if (trial.kind, trial.left, trial.right) == ("pair", "gvst", "wbg"):
                if trial.item not in (first, second):
                    continue
                vote["choice"] = "left" if (trial.item == first) is not swapped else "right"
            kept.append(vote)
        (tmp_path / f"{code}.json").write_text(json.dumps(signed(download | {"votes": kept})))
    results = preference.score(study, tmp_path, replicates=4000)
    details = results["human preference difference", "gvst - wbg"].details
    assert details["p_better"] == pytest.approx(0.5, abs=0.03)  # not 0.44


def test_results_are_tables_pages_and_files_as_others(results, tmp_path):
    assert "human preference" in str(results)
    latex = results.to_latex()
    assert r"human preference $\uparrow$" in latex
    assert "items and raters resampled" in latex
    results.save(tmp_path / "people.json")
    again = Results.load(tmp_path / "people.json")
    assert again["human preference", "ours"] == results["human preference", "ours"]
    results.to_html(tmp_path / "page.html")
    assert "Raters agree in" in (tmp_path / "page.html").read_text()
    assert {"human preference", "human strength"} < set(results.to_frame()["metric"])


def test_sides_are_unswapped(plan, study, tmp_path):
    """A rater who always takes the image of one method, wherever it is shown."""
    fan = Crowd({"ours": 99.0, "gvst": 0.0, "wbg": -99.0}, item_sd=0, rater_sd=0)
    results = preference.score(study, fan.write(plan, tmp_path / "votes", ["r01"]), replicates=100)
    assert results["human preference", "ours"].value == 1
    assert results["human preference", "wbg"].value == 0
    agreement = results.settings["preference"]["agreement"]
    assert agreement["self"] == 1
    assert 0.4 < agreement["left"] < 0.6


@pytest.mark.parametrize(
    ("count", "code", "words"),
    [
        (1, "these-raters", ("For this 1 rater only", "whether raters agree is not known")),
        (2, "these-raters", ("For these 2 raters only",)),
        (4, "few-raters", ()),
    ],
)
def test_two_raters_stand_for_themselves_and_four_are_few(study, downloads, count, code, words):
    results = preference.score(study, sorted(downloads.iterdir())[:count], replicates=100)
    assert codes(results)[code] == {"count": count}
    alone = "for these raters alone" in results["human preference", "ours"].interval_method
    assert alone == (code == "these-raters")
    assert all(word in str(results) for word in words)
    assert "agree in not known" not in str(results)


def test_raters_are_excluded_by_rules_that_were_fixed_before(plan, study, tmp_path):
    folder = CROWD.write(plan, tmp_path / "votes")
    left = Crowd(CROWD.strengths, left_bias=99.0).download(plan, "r01")
    careless = Crowd(CROWD.strengths, lapses=1.0).download(plan, "r02")
    early = CROWD.download(plan, "r03")
    early["votes"] = early["votes"][:20]
    for download in (left, careless, early):
        path = folder / f"votes-{plan.study}-{download['rater']}.json"
        path.write_text(json.dumps(signed(download)))
    results = preference.score(study, folder, replicates=100)
    excluded = {n.params["rater"]: n.params["rule"] for n in results.notes if "rater" in n.params}
    assert excluded == {"r01": "side", "r02": "catches", "r03": "finished"}
    assert results.settings["preference"]["agreement"]["raters"] == 9
    assert "Rater r02 is excluded by the rule catches, fixed before the votes" in str(results)


def test_unanimous_votes_have_a_bound_and_say_so(plan, study, tmp_path):
    """Resampling cannot vary what does not vary; 24 items are the sample."""
    fan = Crowd({"ours": 99.0, "gvst": 0.0, "wbg": -99.0}, item_sd=0, rater_sd=0)
    results = preference.score(study, fan.write(plan, tmp_path / "votes"))
    best = results["human preference", "ours"]
    assert best.interval == pytest.approx((0.025 ** (1 / 24), 1))
    assert best.interval_method == "Clopper-Pearson, items as the sample, n = 24"
    assert [note.code for note in best.notes] == ["votes-agree"]
    difference = results["human preference difference", "ours - gvst"]
    assert difference.interval == pytest.approx((2 * 0.025 ** (1 / 24) - 1, 1))
    assert difference.details["decided"]
    assert difference.details["p_value"] < 0.01
    strength = results["human strength", "ours"]
    assert [note.code for note in strength.notes] == ["strength-of-prior"]
    assert "no resampled interval" in str(results)


def test_left_bias_is_noticed(plan, study, tmp_path):
    crowd = Crowd(CROWD.strengths, left_bias=1.5)
    results = preference.score(study, crowd.write(plan, tmp_path / "votes"), replicates=100)
    agreement = results.settings["preference"]["agreement"]
    assert agreement["left"] > 0.6
    assert agreement["p_left"] < 0.001


def compare(plan, votes, table):
    """Kendall's tau of the metrics of a table with people, by kind and metric."""
    known = read_votes(plan, [votes])
    kept = [rater.code for rater in rater_facts(plan, known) if not rater.excluded]
    cells = {name: {} for name in table[0] if name not in ("id", "method")}
    for row, name in product(table, cells):
        cells[name][row["id"], row["method"]] = row[name]
    metrics = [of_images(name, images) for name, images in cells.items()]
    arrays = VoteArrays(plan, known, kept, seed=0, replicates=100)
    return {(s.metric, s.a): s for s in agreement_scores(metrics, arrays, quiet)}


def test_metrics_that_agree_with_people_have_a_high_tau(plan, downloads, results):
    rng = np.random.default_rng(0)
    rows = [
        {
            "id": item.id,
            "method": method,
            "good": np.mean([CROWD.strength(r.code, item.id, method) for r in plan.raters]),
            "noise": rng.random(),
        }
        for item, method in product(plan.items, plan.methods)
    ]
    scores = compare(plan, downloads, rows)
    name = "Kendall's tau with people, by image"
    good, noise = (scores[name, metric] for metric in ("good", "noise"))
    assert good.value > 0.6
    assert good.interval[0] > 0.5
    assert noise.interval[0] < 0 < noise.interval[1]
    assert scores["Kendall's tau with people, by method", "good"].value == 1
    assert results[name, "SSIM (shown images)"].n == 3 * 24


def metric_table(plan, value):
    """Rows of a table of one metric ``q``, a function of item number and method number."""
    cells = [(k, item, m) for k, item in enumerate(plan.items) for m in range(len(plan.methods))]
    return [
        {"id": item.id, "method": plan.methods[m], "q": float(value(k, m))} for k, item, m in cells
    ]


def tau(plan, votes, table, how):
    """Kendall's tau of ``q`` with people."""
    return compare(plan, votes, table)[f"Kendall's tau with people, by {how}", "q"]


def test_tau_by_image_is_scipys_of_repeated_items(plan, downloads):
    """Value and interval: an item that is drawn twice is there twice, a rater's votes weigh."""
    rng = np.random.default_rng(0)
    table = metric_table(plan, lambda k, m: rng.integers(5) - m)
    q = {(row["id"], row["method"]): row["q"] for row in table}
    drawn, chosen = counted(plan, downloads)

    def slow(raters, items):
        x, y = [], []
        for a, b in combinations(plan.methods, 2):
            for item, count in zip(plan.items, items, strict=True):
                votes = [chosen[r.code, a, b, item.id] for r in plan.raters]
                net = sum(w * ((v == a) - (v == b)) for v, w in zip(votes, raters, strict=True))
                x += [q[item.id, a] - q[item.id, b]] * int(count)
                y += [net / sum(raters)] * int(count)
        return stats.kendalltau(np.r_[x, np.negative(x)], np.r_[y, np.negative(y)]).statistic

    score = tau(plan, downloads, table, "image")
    assert score.value == pytest.approx(slow(np.ones(12), np.ones(24)))
    replicates = [slow(*weights) for weights in drawn]
    assert score.interval == pytest.approx(np.quantile(replicates, [0.025, 0.975]))


def test_an_infinite_value_is_the_best(plan, downloads):
    """As the PSNR of a perfect image is: it counts, and two perfect images are equal."""
    best = metric_table(plan, lambda k, m: np.inf if m == 0 else 9 - m)
    perfect = tau(plan, downloads, best, "image")
    assert perfect.n == 3 * 24
    assert perfect.value > 0.4
    equal = tau(plan, downloads, metric_table(plan, lambda k, m: np.inf), "image")
    assert (equal.n, equal.value) == (3 * 24, None)


def test_by_method_the_items_of_a_metric_are_resampled_as_those_of_votes(plan, downloads):
    """Means over items that differ by chance alone order the methods by chance."""
    chance = metric_table(plan, lambda k, m: np.sin(7 * k + 3 * m) - m / 100)
    low, high = tau(plan, downloads, chance, "method").interval
    assert low < 0 < high
    sure = metric_table(plan, lambda k, m: np.sin(7 * k + 3 * m) - 100 * m)
    assert tau(plan, downloads, sure, "method").value == 1


def test_scores_of_methods_are_compared_too(study, downloads, results, tmp_path):
    results.save(tmp_path / "scores.json")  # any file of scores of the same methods
    again = preference.score(study, downloads, metrics=[tmp_path / "scores.json"], replicates=100)
    assert again["Kendall's tau with people, by method", "human strength"].value == 1


def test_votes_of_the_server_count_as_downloads_do(plan, study, downloads, results):
    database, files = study / "study.db", [json.loads(p.read_text()) for p in downloads.iterdir()]
    names = ("trial", "choice", "ms", "at", "undone")
    rows = [[f["rater"], *(v[n] for n in names), ""] for f in files for v in f["votes"]]
    write_database(database, plan, rows)
    try:
        served = preference.score(study, replicates=400)
        both = preference.score(study, downloads, replicates=400)
    finally:
        database.unlink()
    assert served.scores == results.scores == both.scores
    assert codes(both)["votes-twice"] == {"count": 12 * len(plan.trials)}


def changed(plan, **changes):
    return signed(CROWD.download(plan, "r01") | changes)


def read(plan, folder, *downloads):
    """The votes of files with this content."""
    paths = [folder / f"{k}.json" for k in range(len(downloads))]
    for path, content in zip(paths, downloads, strict=True):
        path.write_text(content if isinstance(content, str) else json.dumps(content))
    return read_votes(plan, paths)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: f[: len(f) // 2], "must be JSON"),
        (lambda f: f.replace('"left"', '"right"', 1), "digest .* must match"),
        (lambda f: f.replace('"r01"', '"r02"'), "digest .* must match"),
        (lambda f: "[]", "JSON object"),
        (lambda f: "{}", "format"),
    ],
)
def test_torn_and_edited_votes_are_said(plan, tmp_path, change, words):
    with pytest.raises(PalpateError, match=words) as error:
        read(plan, tmp_path, change(json.dumps(changed(plan))))
    assert "download the votes again" in str(error.value)


def with_vote(**fields):
    """A change of the fourth vote."""
    return lambda f: f | {"votes": [*f["votes"][:3], f["votes"][3] | fields, *f["votes"][4:]]}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: f | {"study": "0123456789ab"}, "of study"),
        (lambda f: f | {"rater": "r99"}, "r01 to r12"),
        (lambda f: f | {"rater": "r02"}, "a trial of this rater"),
        (lambda f: f | {"votes": [{"trial": "x"}]}, "a trial of this rater"),
        (lambda f: f | {"votes": 3}, "a trial of this rater"),
        (with_vote(choice="both"), "a trial of this rater"),
        (with_vote(ms=-1), "a trial of this rater"),
        (with_vote(ms=10**400), "a trial of this rater"),
        (with_vote(at="soon"), "a trial of this rater"),
        (with_vote(undone=None), "a trial of this rater"),
        (with_vote(undone=1000), "a trial of this rater"),
    ],
)
def test_votes_of_another_plan_or_of_no_page_are_said(plan, tmp_path, change, words):
    fails(words, read, plan, tmp_path, signed(change(CROWD.download(plan, "r01"))))


def test_the_same_votes_twice_count_once(plan, downloads):
    first = sorted(downloads.iterdir())[0]
    votes = read_votes(plan, [first, first])
    assert len(votes.by_rater["r01"]) == len(plan.trials)
    assert {n.code for n in votes.notes} == {"votes-twice"}


def test_of_an_undone_vote_the_last_counts(plan, tmp_path):
    download = changed(plan)
    first = download["votes"][0]
    other = "left" if first["choice"] != "left" else "right"
    later = changed(plan, votes=[first | {"choice": other, "undone": 1}])
    votes = read(plan, tmp_path, later, download)
    assert votes.by_rater["r01"][plan.raters[0].order[0]].choice == other
    assert not votes.notes


def test_different_answers_under_one_code_are_said(plan, tmp_path):
    other = Crowd(CROWD.strengths, seed=1).download(plan, "r01")
    notes = {note.code: note.params for note in read(plan, tmp_path, changed(plan), other).notes}
    assert notes["votes-differ"]["count"] > 5


def test_votes_after_the_last_day_do_not_count(rated, tmp_path):
    plan = replace(rated.make(items=4, raters=1), until="2026-10-01")
    early = changed(plan)
    fails(f"{len(plan.trials)} after 2026-10-01", read, plan, tmp_path, early)
    early["votes"][0]["at"] = "2026-09-30T10:00:00Z"
    votes = read(plan, tmp_path, signed(early))
    assert len(votes.by_rater["r01"]) == 1
    assert votes.notes == [Note("votes-late", {"count": len(plan.trials) - 1})]


def test_what_the_server_took_counts_whatever_the_clock_of_the_rater(plan, tmp_path):
    """Its own clock has refused what was late."""
    times = ["2099-01-01T00:00:00Z", "2026-02-03T10:00:00Z"]
    rows = [
        ("r01", name, "left", 900, at, 0, "2026-11-01T10:00:00+00:00")
        for name, at in zip(plan.shown("r01"), times, strict=False)
    ]
    for day in ("2026-10-01", "9999-12-31"):
        ended = replace(plan, until=day)
        write_database(tmp_path / f"{day}.db", ended, rows)
        votes = read_votes(ended, [tmp_path / f"{day}.db"])
        years = sorted(vote.at.year for vote in votes.by_rater["r01"].values())
        assert years == [2026, 2099]


@pytest.mark.parametrize("until", ["20301231", "2030-12-31"])
def test_the_last_day_is_kept_in_one_form(rated, until):
    plan = rated.make(items=4, raters=1, until=until)
    assert plan.until == plan.public()["until"] == "2030-12-31"


def write_database(path, plan, rows):
    """The server's file with these rows of votes."""
    with closing(VoteStore(path, plan.study)) as store:
        store.store([dict(zip(("rater", *CELLS, "received"), row, strict=True)) for row in rows])


def test_no_vote_is_nothing_to_score(study):
    fails("votes to score", preference.score, study)


def test_a_plan_that_was_edited_is_another_study(study, downloads, tmp_path):
    text = (study / "plan.json").read_text()
    (tmp_path / "plan.json").write_text(text.replace('"catches": 0.8', '"catches": 0.1'))
    fails("of study", preference.score, tmp_path, downloads)


def test_sorting_is_accuracy_by_material_against_chance(rated, tmp_path):
    study = tmp_path / "study"
    plan = rated.make(study, 1, items=15, raters=6, task="sort", size=32)
    crowd = Crowd({}, skill=0.8)
    for rater in plan.raters:
        download = crowd.download(plan, rater.code)
        download["votes"] = download["votes"][: 25 + 2 * int(rater.code[1:])]  # not all are done
        (tmp_path / f"{rater.code}.json").write_text(json.dumps(signed(download)))
    votes = [tmp_path / f"{rater.code}.json" for rater in plan.raters]
    results = preference.score(study, votes)
    accuracy = results["human accuracy of material", "ours"]
    assert accuracy.interval[0] <= 0.8 <= accuracy.interval[1]
    assert accuracy.details["chance"] == pytest.approx(1 / 3)
    material = {item.id: item.material for item in plan.items}
    for method, subject in (("ours", "ours"), ("reference", "real images")):
        right = {"brick": [], "grass": [], "wood": []}
        for vote in (v for own in read_votes(plan, votes).by_rater.values() for v in own.values()):
            if (vote.trial.kind, vote.trial.left) == ("sort", method):
                right[material[vote.trial.item]].append(vote.choice == material[vote.trial.item])
        score = results["human accuracy of material", subject]
        assert score.n == sum(map(len, right.values())) < 15 * 6
        assert score.value == pytest.approx(np.mean([x for of in right.values() for x in of]))
        means = {name: np.mean(of) for name, of in right.items()}
        assert score.details["by_material"] == pytest.approx(means)
        assert results["human accuracy of material", f"{subject}, wood"].value == means["wood"]
    results.to_html(tmp_path / "page.html")
    with pytest.raises(PalpateError, match=r"metrics. must be left out where people sort"):
        preference.score(study, votes, metrics=[tmp_path / "scores.json"])


def test_a_material_may_be_called_left(tmp_path):
    """It is no side: nobody is excluded for it."""
    folders = write_folders(tmp_path, videos=24, frames=1, materials=("left", "moss"))
    plan = folders.make(tmp_path / "s", 1, task="sort", items=12, raters=3, size=32)
    votes = Crowd({}, skill=0.9).write(plan, tmp_path / "votes")
    results = preference.score(tmp_path / "s", votes, replicates=100)
    agreement = results.settings["preference"]["agreement"]
    assert (agreement["raters"], agreement["sides"]) == (3, 0)


def test_a_material_that_was_not_shown_has_no_accuracy(tmp_path):
    materials = tuple(f"m{k}" for k in range(6))
    folders = write_folders(tmp_path, videos=12, frames=1, materials=materials)
    plan = folders.make(tmp_path / "s", 1, task="sort", items=4, raters=4, size=32)
    crowd = Crowd({}, skill=0.9)
    votes = crowd.write(plan, tmp_path / "votes")
    results = preference.score(tmp_path / "s", votes, replicates=100)
    details = results["human accuracy of material", "ours"].details
    shown = {item.material for item in plan.items}
    assert {m for m, share in details["by_material"].items() if share is not None} == shown
    rows = dict(zip(details["classes"], details["matrix"], strict=True))
    assert {m for m, row in rows.items() if row == [None] * 6} == {*materials} - shown
    assert codes(results)["materials-unshown"] == {"count": 2, "of": 6}
    name = next(item.material for item in plan.items)
    one = results["human accuracy of material", f"ours, {name}"]
    assert (one.n, one.interval) == (4, None)  # one item is no sample
    assert [note.code for note in one.notes] == ["one-item"]
    assert f"ours, {name} &" in results.to_latex()
    assert f"ours, {name}" in str(results)
    results.to_html(tmp_path / "page.html")


def test_neither_torch_nor_the_server_is_loaded(study, downloads, rated):
    code = f"""
import sys
from palpate import preference
preference.make({str(rated.reference)!r}, {[str(m) for m in rated.methods]!r}, dry_run=True)
preference.score({str(study)!r}, {str(downloads)!r}, replicates=100)
assert not {{"torch", "starlette", "uvicorn", "diffusers"}} & set(sys.modules)
"""
    python(code)
