"""Questions of a study over its seeds: cells and points are means, and verdicts know the seeds."""

from types import SimpleNamespace

import pytest

from palpate.core import Score
from palpate.report.results import Results
from palpate.report.study import Curve, Line, StudyTable
from palpate.studies import questions
from palpate.studies.controls import NEAREST
from palpate.studies.questions import curve_over_seeds, table_over_seeds
from palpate.studies.utility import GAIN, Draws


def score(value, subject="Ours"):
    return Score("accuracy", subject, value, (value - 0.05, value + 0.05))


def table_of(*cells):
    return StudyTable("T", "", ["trained on", "k = 1", "k = 2"], [[f"{GAIN}Ours", *cells]])


def test_cells_are_means_and_what_a_seed_lacks_is_left_out():
    tables = [table_of(score(0.1), score(0.5)), table_of(score(0.3), None)]
    (label, mean, none), *_ = table_over_seeds(tables).rows
    assert label == f"{GAIN}Ours"
    assert mean.value == pytest.approx(0.2)
    assert mean.details["by_seed"] == [0.1, 0.3]
    assert mean.interval[1] - mean.interval[0] > 0.1  # wider than that of one seed
    assert none is None


def test_points_are_means_over_the_same_numbers():
    curves = [
        Curve("C", "", "k", "accuracy", [Line("real", [(1.0, score(a)), (2.0, score(b))])])
        for a, b in ((0.1, 0.5), (0.3, 0.9))
    ]
    (line,) = curve_over_seeds(curves).lines
    assert [(x, s.value) for x, s in line.points] == [(1, pytest.approx(0.2)), (2, 0.7)]


@pytest.mark.parametrize(
    ("gains", "verdict"), [((0.1,), "holds"), ((0.1, -0.08, 0.02), "undecided")]
)
def test_whether_images_help_is_decided_by_all_seeds(tmp_path, monkeypatch, gains, verdict):
    """One training may gain where the next loses."""
    left = list(gains)

    def forged(manifest, split, judge, images, draws, *, controls, progress):
        assert controls == [NEAREST]
        assert images[NEAREST].name == "real-nearest-photo"
        gain = score(left.pop(0), images["Ours"].parent.name)
        assert judge == tmp_path / f"encoder-{gain.subject[-1]}" / "encoders"
        gain = score(gain.value)
        return [table_of(gain, gain)], Curve("C", "", "k", "y", [Line("Ours", [(1.0, gain)])])

    monkeypatch.setattr(questions, "utility", forged)
    monkeypatch.setattr(questions, "data_of", lambda after, name: (None, None))
    load = SimpleNamespace(load=lambda folder, device: folder)
    monkeypatch.setattr(questions, "EncoderSet", load)
    runs = {f"encoder-{k}": {"Ours": f"images-{k}"} for k in range(len(gains))}
    names = [n for encoders, made in runs.items() for n in (encoders, *made.values())]
    names.append("controls-NoLeak")
    after = {name: tmp_path / name for name in names}
    (after["controls-NoLeak"] / "real-nearest-photo").mkdir(parents=True)
    how = {"runs": runs, "controls": [NEAREST, "mean image"], "draws": Draws(), "device": "cpu"}
    questions.measure_utility(tmp_path, after, lambda *_: None, **how)
    results = Results.load(tmp_path / "results.json")
    assert results.claims[0].verdict == verdict
    assert results.tables[0].rows[0][1].details["by_seed"] == list(gains)
    assert results.curves[0].lines[0].points[0][1].value == pytest.approx(sum(gains) / len(gains))


def test_controls_are_ranked_and_have_no_part_in_the_agreement(tmp_path, monkeypatch):
    places = {"a": 0.1, "b": 0.2, "c": 0.3, NEAREST: 0.05, "mean image": 9.0}

    def forged(rulers, folders, manifest, split, **options):
        assert {name for name, _ in folders} == {*places}
        return {ruler: {g: Score("TMMD", g[0], places[g[0]]) for g in folders} for ruler in rulers}

    monkeypatch.setattr(questions, "measure_rulers", forged)
    monkeypatch.setattr(questions, "data_of", lambda after, name: (None, None))
    monkeypatch.setattr(questions, "cache_of", lambda place: None)
    load = SimpleNamespace(load=lambda folder, device: folder)
    monkeypatch.setattr(questions, "EncoderSet", load)
    after = {name: tmp_path / name for name in ("controls-NoLeak", "x", "y", "i")}
    for name in ("real-nearest-photo", "mean-image"):
        (after["controls-NoLeak"] / name).mkdir(parents=True)
    images = {(name, seed): "i" for name in "abc" for seed in (3, 5)}
    how = {"rulers": {"one": "x", "two": "y"}, "images": images, "device": "cpu"}
    questions.compare_rulers(
        tmp_path, after, lambda *_: None, controls=[NEAREST, "mean image", "absent"], **how
    )
    results = Results.load(tmp_path / "results.json")
    assert results.claims[0].evidence[0].n == 6
    ranks = {row[0]: float(row[1]) for row in results.tables[1].rows}
    assert ranks == {"a": 1, "b": 2, "c": 3, NEAREST: 1, "mean image": 4}
    assert results.tables[1].controls == [NEAREST, "mean image"]
