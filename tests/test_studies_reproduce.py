"""Studies: their objects and nodes, controls against planted truths, tables from forged scores."""

import json
import shutil
from dataclasses import replace
from functools import partial
from itertools import combinations

import numpy as np
import polars as pl
import pytest

from palpate.cli import main
from palpate.core import FeatureSet, Measure, PalpateError, Score, Split, digest_file
from palpate.core.digest import canonical_json
from palpate.encoders.models import shipped_folder
from palpate.preference.scoring import PREFERENCE, STRENGTH
from palpate.report.results import Results
from palpate.sim import WorldOptions
from palpate.sim.presets import MINI_SEEDS
from palpate.studies import collecting, controls, demo, judging, reproduce
from palpate.studies.controls import CONTROLS, FLOOR, NEAREST
from palpate.studies.graph import in_order
from palpate.studies.making import slug
from palpate.studies.methods import METHODS, OURS, Method, Setting
from palpate.studies.reproduce import nodes_of, plan_of
from palpate.studies.stages import stage_digest
from palpate.studies.study import NOLEAK, ORIG, STUDIES, Study
from palpate.studies.study_tables import Scores, study_tables
from palpate.studies.verifying import verify

WORLD = STUDIES["world-gelsight"]


TRAINED = [m for m in METHODS.values() if m.make is None]


def test_no_two_names_share_a_folder():
    names = [slug(n) for n in (*METHODS, *CONTROLS)]
    assert len({*names}) == len(names)


def test_compared_methods_differ_in_what_their_row_says():
    rows = [(m.condition, m.background, m.vq) for m in TRAINED if not m.text_of]
    assert all(a != b for a, b in combinations(rows, 2))
    for preset in WORLD.presets.values():
        made = {m.name: m.preset(preset.diffusion) for m in TRAINED}
        for other in made.values():
            assert replace(other, condition=made[OURS].condition) == made[OURS]


def test_no_shipped_model_has_seen_the_worlds():
    for study in STUDIES.values():
        for preset in study.presets.values():
            if study.world is not None:
                world = replace(preset.world, **study.world)
                assert isinstance(world, WorldOptions)
                assert world.seed not in MINI_SEEDS
    seen = replace(WORLD, name="seen", world={**(WORLD.world or {}), "seed": MINI_SEEDS[0]})
    with pytest.raises(PalpateError, match="must be one that no shipped model saw"):
        plan_of(seen)


def test_nodes_train_once_for_each_split_and_seed():
    nodes = {n.name: n for n in nodes_of(plan_of(WORLD, preset="smoke", seeds=(0, 1)))}
    for seed, split in ((s, p) for s in (0, 1) for p in (ORIG, NOLEAK)):
        assert {f"encoder-{split}-{seed}", f"ours-{split}-{seed}"} <= {*nodes}
        for judge in (ORIG, NOLEAK):  # both encoders judge both generators
            after = nodes[f"scores-{split}-by-{judge}-{seed}"].after
            assert {f"encoder-{judge}-{seed}", f"images-ours-{split}-{seed}"} <= {*after}
    assert "gvst-Orig-0" not in nodes
    assert "ours-by-text-NoLeak-0" not in nodes
    assert "ours-NoLeak-0" in nodes["images-ours-by-text-NoLeak-0"].after
    judged = nodes["scores-NoLeak-by-NoLeak-1"]
    assert {*judged.inputs["methods"]} == {*METHODS}
    assert judged.inputs["controls"] == [*CONTROLS]


def test_another_seed_leaves_the_nodes_of_the_first(tmp_path):
    one, two = (
        {n.name: (n.inputs, n.after, n.version) for n in nodes_of(plan_of(WORLD, seeds=seeds))}
        for seeds in ((0,), (0, 1))
    )
    changed = {name for name in one if one[name] != two[name]}
    assert changed == {"results", "utility"}
    read = {n.name: n for n in nodes_of(plan_of(WORLD, seeds=(0, 1)))}["utility"].after
    assert {"images-ours-NoLeak-0", "images-ours-NoLeak-1"} <= {*read}


def digests(study, **options):
    """Name -> digest of what the stage reads."""
    read = {}
    for n in in_order(nodes_of(plan_of(study, preset="smoke", **options))):
        inputs = {**n.inputs, "after": {name: read[name] for name in n.after}}
        read[n.name] = stage_digest(n.name, inputs, n.version)
    return read


def test_other_weights_under_one_name_build_what_reads_them(tmp_path):
    clip = tmp_path / "clip"
    shutil.copytree(shipped_folder("palpate/mini", "clip"), clip)
    own = Method("mine", "", make=controls.mean_image)
    smoke = replace(WORLD.presets["smoke"], clip=str(clip))
    study = replace(WORLD, name="mine", methods=[*WORLD.methods, own], presets={"smoke": smoke})
    before = digests(study)
    weights = clip / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1] + b"x")
    after = digests(study)
    same = {name for name in before if before[name] == after[name]}
    assert same == {"world", "data", "split", *(n for n in before if n.startswith("autoencoder"))}


def test_other_shipped_weights_build_what_reads_them(monkeypatch):
    before, known = digests(WORLD), reproduce.model_stamp
    monkeypatch.setattr(
        reproduce, "model_stamp", lambda p, s: known(p, s) if p == "clip" else f"other {p}"
    )
    after = digests(WORLD)
    trained = [n for n in before if n.startswith(("encoder", "ours", "gvst", "images-ours"))]
    assert all(before[name] == after[name] for name in trained)
    assert before["images-palpate-mini-NoLeak-0"] != after["images-palpate-mini-NoLeak-0"]


@pytest.mark.parametrize("part", ["clip", "encoders", "autoencoder", "generator"])
def test_the_words_of_a_card_build_nothing_again(monkeypatch, tmp_path, part):
    before = reproduce.model_stamp(part, "palpate/mini")
    record = json.loads((shipped_folder("palpate/mini", part) / "palpate.json").read_text())
    monkeypatch.setattr(demo, "shipped_folder", lambda *_: tmp_path)

    def stamp(record):
        (tmp_path / "palpate.json").write_text(json.dumps(record))
        return reproduce.model_stamp(part, "palpate/mini")

    [words] = {"card", "training"} & set(record)
    record[words]["summary"] = "Other words."
    assert stamp(record) == before
    digest = "digest" if "digest" in record else "digests"
    assert stamp(record | {digest: "other weights"}) != before


@pytest.mark.parametrize("name", ["world-gelsight", "world-digit"])
def test_what_a_stage_reads_is_the_same_from_its_record(name):
    """Keys of JSON are words: a number as a key would come back as another digest."""
    for node in nodes_of(plan_of(STUDIES[name], seeds=(0, 1))):
        written = canonical_json(node.inputs)
        assert canonical_json(json.loads(written)) == written, node.name


def test_the_size_of_the_paper_needs_its_autoencoder(tmp_path):
    tag = STUDIES["tag"]
    with pytest.raises(PalpateError, match="must be given for preset paper"):
        plan_of(tag, preset="paper", root=tmp_path)
    with pytest.raises(PalpateError, match="must be at least 4"):
        plan_of(tag, preset="mini", root=tmp_path, steps=3)
    file = tmp_path / "vq-f4.ckpt"
    file.write_bytes(b"weights")
    made = {}
    for preset in ("paper", "mini"):
        plan = plan_of(tag, preset=preset, root=tmp_path, vq=file, steps=400)
        made[preset] = {n.name: n for n in nodes_of(plan)}
        assert made[preset]["autoencoder-vq-NoLeak"].inputs["options"] == digest_file(file)
        assert made[preset]["ours-vq-NoLeak-0"].inputs["steps"] == 400
    assert made["paper"].keys() == made["mini"].keys()


def closed(by):
    return lambda setting: by


def made_by(make):
    study = replace(WORLD, name="mine", methods=[METHODS[OURS], Method("mine", "", make=make)])
    return digests(study)["images-mine-NoLeak-0"]


@pytest.mark.parametrize("make", [closed(1), len, partial(controls.mean_image, by=1)])
def test_a_function_without_source_or_with_values_of_another_is_refused(make):
    assert made_by(controls.mean_image) != made_by(controls.one_image)
    with pytest.raises(PalpateError, match="must be a function of a file"):
        made_by(make)


def test_a_method_of_your_own_trains_nothing():
    mine = Method("mine", "", make=controls.mean_image)
    study = replace(WORLD, name="mine", methods=[METHODS[OURS], mine])
    nodes = {n.name: n for n in nodes_of(plan_of(study, preset="smoke"))}
    assert "images-mine-NoLeak-0" in nodes
    assert "mine-NoLeak-0" not in nodes
    assert "mine" in nodes["scores-NoLeak-by-NoLeak-0"].inputs["methods"]


def test_a_dry_run_writes_nothing(tmp_path, capsys):
    run = tmp_path / "run"
    assert main(["reproduce", "world-digit", "-o", str(run), "--dry-run", "--json"]) == 0
    stages = json.loads(capsys.readouterr().out)["stages"]
    assert not run.exists()
    assert [*stages][:2] == ["world", "data"]
    assert [*stages][-1] == "results"
    assert not any(stages.values())


def test_a_human_study_must_be_one(tmp_path):
    Results("t", scores=[Score("TMMD", "Ours", 0.1)]).save(tmp_path / "scores.json")
    with pytest.raises(PalpateError, match="must hold scores of palpate preference score"):
        plan_of(WORLD, people=tmp_path / "scores.json")


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["world-gelsigt", "-o", "r"], "study"),
        (["world-gelsight", "-o", "r", "--preset", "huge"], "--preset must be one of smoke, mini"),
        (["world-gelsight", "-o", "r", "--seeds", "1", "1"], "--seeds must hold"),
        (["world-gelsight", "-o", "r", "--root", "x"], "--root must be left out"),
        (["world-gelsight", "-o", "r", "--method", "dir"], "--method must be NAME=FOLDER"),
        (["world-gelsight", "-o", "r", "--method", "a=dir"], "a must be a folder of images"),
        (["world-gelsight", "-o", "r", "--method", "GVST=dir"], "a name of its own"),
    ],
)
def test_mistakes_are_reported_in_one_line(args, words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["reproduce", *args]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert words in lines[0]
    assert not (tmp_path / "r").exists()


def test_another_study_has_another_name():
    with pytest.raises(PalpateError, match="must have a name of its own"):
        plan_of(replace(WORLD, methods=WORLD.methods[:1]))


def test_a_study_on_disk_needs_a_root(small_manifest, tmp_path):
    study = Study("mine", "Mine", (1, 3, 4))
    with pytest.raises(PalpateError, match="must be given for the study mine"):
        plan_of(study)
    small_manifest.save(tmp_path / "data" / "manifest.parquet")
    names = [n.name for n in nodes_of(plan_of(study, root=tmp_path / "data"))]
    assert "world" not in names
    assert names[0] == "data"


@pytest.fixture
def setting(small_manifest, tmp_path):
    """A train and a test video of each of three materials."""
    split = Split({i: "train" if i < "v3" else "test" for i in small_manifest.ids})
    train, test = (small_manifest.part(split, part) for part in ("train", "test"))
    return Setting(train, test, 32, 0, 1, "palpate/mini", tmp_path / "cache", tmp_path)


def rows_of(setting, images):
    """The rows of train that images are copies of."""
    train = setting.pixels(setting.train)
    return [int(np.flatnonzero((train == image).all(axis=(1, 2, 3)))[0]) for image in images]


def columns_of(setting, rows, name):
    return np.array(setting.train.column(name))[rows], np.array(setting.test.column(name))


def test_the_floor_is_of_other_videos_of_the_material(setting):
    rows = rows_of(setting, controls.other_videos(setting))
    material, wanted = columns_of(setting, rows, "material")
    video, own = columns_of(setting, rows, "video")
    assert (material == wanted).all()
    assert len({*zip(video, own, strict=True)}) == len({*own}) == 3


def test_a_wrong_material_is_never_right(setting):
    rows = rows_of(setting, controls.wrong_material(setting))
    material, wanted = columns_of(setting, rows, "material")
    assert (material != wanted).all()
    video, own = columns_of(setting, rows, "video")
    assert len({*zip(video, own, strict=True)}) == len({*own}) == 3  # whole videos


def with_materials(setting, train, test):
    """The setting with other materials of its samples."""
    parts = (setting.train, train), (setting.test, test)
    train, test = (
        replace(p, table=p.table.with_columns(pl.Series("material", m, pl.String)))
        for p, m in parts
    )
    return replace(setting, train=train, test=test)


def test_controls_use_the_material_of_an_image_and_known_ones_alone(setting):
    """Train videos of two materials, and unlabeled images; a test video of wood."""
    known = ["wood", "grass", "grass", "wood", *["grass"] * 4, *["wood", "grass"] * 4, *[None] * 8]
    mixed = with_materials(setting, known, ["wood"] * 24)
    for make, material in (
        ("memorized", "wood"),
        ("other_videos", "wood"),
        ("wrong_material", "grass"),
    ):
        rows = rows_of(mixed, getattr(controls, make)(mixed))
        assert {known[k] for k in rows} == {material}, make
    lacking = with_materials(setting, known, ["sand"] * 24)
    assert controls.memorized(lacking) is None
    assert controls.other_videos(lacking) is None


def test_without_materials_none_is_wrong(setting):
    none = pl.lit(None, pl.String).alias("material")
    parts = (setting.train, setting.test)
    train, test = (replace(p, table=p.table.with_columns(none)) for p in parts)
    bare = replace(setting, train=train, test=test)
    assert controls.wrong_material(bare) is None
    video, own = columns_of(bare, rows_of(bare, controls.other_videos(bare)), "video")
    assert len({*zip(video, own, strict=True)}) == len({*own}) == 3


def test_a_memorized_video_is_one_a_material(setting):
    rows = rows_of(setting, controls.memorized(setting))
    material, wanted = columns_of(setting, rows, "material")
    video, _ = columns_of(setting, rows, "video")
    assert (material == wanted).all()
    assert len({*video}) == len({*wanted}) == 3


def test_constant_controls(setting):
    mean, one = controls.mean_image(setting), controls.one_image(setting)
    train = np.asarray(setting.pixels(setting.train), float)
    assert np.abs(mean[0] - train.mean(axis=0)).max() <= 0.5
    assert (mean == mean[0]).all()
    assert (one == one[0]).all()
    assert len(one) == len(setting.test)
    rows_of(setting, one[:1])  # a train image


def test_the_nearest_photo_by_a_slow_loop(setting):
    from palpate.encoders.embed import embed
    from palpate.encoders.encoder_set import EncoderSet

    encoders = EncoderSet.load("palpate/mini")
    photos, queries = (
        embed(part, encoders, "vision").features for part in (setting.train, setting.test)
    )
    slow = [max(range(len(photos)), key=lambda k: float(q @ photos[k])) for q in queries]
    expected = setting.pixels(setting.train)[slow]
    assert (controls.nearest_photo(setting) == expected).all()


def forged(subject, metric, value, stage="s", half=0.1, **fields):
    return Score(
        metric,
        subject,
        value,
        (value - half, value + half),
        settings={"preset": "grouped"},
        details={"stage": stage},
        n=10,
        **fields,
    )


def test_cells_are_means_over_seeds_that_name_their_stages():
    seeds = [
        [forged(OURS, "TMMD", v, f"scores-{k}", floor=v / 10)] for k, v in enumerate((1, 2, 6))
    ]
    score = Scores.over_seeds(seeds, "results").get(Measure("TMMD"), OURS)
    assert score is not None
    assert score.value == pytest.approx(3)
    assert score.floor == pytest.approx(0.3)
    assert score.details["by_seed"] == [1, 2, 6]
    assert score.details["stage"] == "results"
    assert score.details["of"] == ["scores-0", "scores-1", "scores-2"]
    assert score.interval is not None
    assert score.interval[1] - score.interval[0] > 0.2  # wider than that of one seed


def test_tables_hold_methods_controls_and_both_judges():
    values = {
        (s, j): 1.0 + 10 * a + b
        for a, s in enumerate((ORIG, NOLEAK))
        for b, j in enumerate((ORIG, NOLEAK))
    }
    metrics = ("SSIM", "TMMD", "I-TMMD", "CI-TMMD", "D-TMMD")
    subjects = (OURS, "GVST", "other", FLOOR, NEAREST)
    judged = {
        pair: Scores.over_seeds(
            [
                [forged(judging.HALF_PROBES, "material accuracy", 0.5)]
                + [forged(n, m, v) for n in subjects for m in metrics]
            ],
            "results",
        )
        for pair, v in values.items()
    }
    probed = [forged(split, "material accuracy", 0.5) for split in (ORIG, NOLEAK)]
    names = {"methods": [*METHODS, "other"], "controls": [*CONTROLS]}
    one, three, four = study_tables(WORLD, judged, probed, **names)
    assert one.columns[:3] == ["images", "judged by encoder of", "material accuracy, real images"]
    cells = {(row[0], row[1]): row for row in one.rows}
    for split in (ORIG, NOLEAK):
        assert cells[f"{OURS}, {split}", split][2].value == 0.5
        for judge in (ORIG, NOLEAK):
            for name in (OURS, FLOOR):
                assert cells[f"{name}, {split}", judge][3].value == values[split, judge]
    listed = [OURS, "GVST", "other", FLOOR, NEAREST, judging.HALF_PROBES]
    assert [row[0] for row in three.rows] == listed
    assert not [row for row in one.rows if str(row[0]).startswith(judging.HALF_PROBES)]
    assert [row[0] for row in four.rows] == [OURS, "GVST", "other", FLOOR, NEAREST]
    assert three.controls == [FLOOR, NEAREST, judging.HALF_PROBES]
    assert three.columns[:2] == ["images", "SSIM"]
    assert "All methods but other are trained from random weights" in three.text
    for table in (one, three, four):
        assert all(len(row) == len(table.columns) for row in table.rows)
        assert not any("paper" in str(row[0]) for row in table.rows)


def test_people_are_columns_of_table_three():
    judged = {
        (s, j): Scores.over_seeds([[forged(n, "TMMD", 1.0) for n in (OURS, "GVST")]], "results")
        for s in (ORIG, NOLEAK)
        for j in (ORIG, NOLEAK)
    }
    votes = [forged(n, m, 0.7) for m in (PREFERENCE, STRENGTH) for n in (OURS, "theirs")]
    votes.append(forged(OURS, "human accuracy of material", 0.4))
    how = {"methods": [OURS, "GVST"], "controls": [], "people": votes}
    one, three, four = study_tables(WORLD, judged, [], **how)
    assert three.columns == ["images", "TMMD", PREFERENCE, STRENGTH]
    assert [None if c is None else c.value for c in three.rows[0][1:]] == [1.0, 0.7, 0.7]
    assert three.rows[1][2:] == [None, None]
    assert PREFERENCE not in {*one.columns, *four.columns}
    how["people"] = [forged("theirs", PREFERENCE, 0.7)]
    assert study_tables(WORLD, judged, [], **how)[1].columns == ["images", "TMMD"]


def test_the_papers_numbers_stand_beside_its_own_data_alone():
    judged = {
        (s, j): Scores.over_seeds(
            [[forged(OURS, "TMMD", 1.0), forged(OURS, "SSIM", 0.5)]], "results"
        )
        for s in (ORIG, NOLEAK)
        for j in (ORIG, NOLEAK)
    }
    study = replace(WORLD, paper=True)
    one, three, four = study_tables(study, judged, [], methods=[OURS], controls=[])
    assert {row[0]: row[3] for row in one.rows}["paper, NoLeak"] == "1.37"
    assert {row[0]: row[1] for row in three.rows}["paper, Ours w/ BG"] == "0.54"
    assert {row[0]: row[1] for row in four.rows}["paper, GVST"] == "1.98"
    digit = replace(STUDIES["world-digit"], paper=True)
    assert {
        r[0]: r[1] for r in study_tables(digit, judged, [], methods=[OURS], controls=[])[1].rows
    }["paper, GVST"] == "2.67"


def test_the_papers_numbers_are_of_its_own_metrics_alone():
    """FID of another network is not the paper's FID."""
    networks = ("Inception", "palpate/mini vision")
    scores = [forged(OURS, "SSIM", 1.0)]
    scores += [forged(OURS, "FID", 1.0, features=network) for network in networks]
    judged = {
        (s, j): Scores.over_seeds([scores], "results")
        for s in (ORIG, NOLEAK)
        for j in (ORIG, NOLEAK)
    }
    study = replace(WORLD, paper=True)
    three = study_tables(study, judged, [], methods=[OURS], controls=[])[1]
    [printed] = [row for row in three.rows if row[0] == "paper, Ours"]
    cells = dict(zip(three.columns, printed, strict=True))
    assert (cells["SSIM"], cells["FID (Inception)"]) == ("0.49", "43.9")
    assert cells["FID (palpate/mini vision)"] is None


def test_differences_that_are_stored_are_of_a_method_and_not_of_e():
    score = forged("x", "I-TMMD", 1.0, kind="difference", b=OURS)
    assert judging._compares(score, [OURS])
    assert not judging._compares(score, ["other"])
    assert not judging._compares(replace(score, kind="excess"), [OURS])
    assert judging._compares(forged(FLOOR, "I-TMMD", 1.0, kind="excess"), [OURS])
    assert collecting._compares(score, [OURS, "x"])  # in either order
    assert not collecting._compares(score, [OURS])


def test_half_probes_name_train_images_beside_the_real_ones_of_labeled_samples():
    """Videos of two materials; the nearest photo is right for wood, wrong for half of the grass."""
    rng, materials = np.random.default_rng(0), ["wood", "grass"] * 4
    x = np.array([[m == "wood", m == "grass"] for m in materials], float)
    x = (x + 0.05 * rng.normal(size=x.shape)).astype("f4")
    ids = [f"t{k}" for k in range(8)]
    train = FeatureSet(ids, x, materials, [f"{m}{k // 2}" for k, m in enumerate(materials)])
    rows = np.array([0, 2, 1, 4, 3, 5])
    labels = ["wood", "wood", "grass", "grass", "", ""]
    videos = [f"v{k}" for k in range(6)]
    real = FeatureSet(videos, x[[0, 2, 1, 3, 0, 0]], labels, videos)
    images = replace(real, features=x[rows])
    split = Split.from_ids(train=ids, test=videos, rule={}, manifest="m" * 64)
    near, of_real = judging._cross_fitted(train, images, real, rows, split)
    assert (near.a, near.value, near.n) == (NEAREST, 0.75, 4)
    assert (of_real.a, of_real.value, of_real.n) == (judging.HALF_PROBES, 1, 4)


@pytest.mark.slow
def test_the_study_at_smoke(tmp_path):
    """Every table, method and control; other people's images; running again builds nothing."""
    run, command = tmp_path / "run", ["reproduce", "world-gelsight", "--preset", "smoke", "-q"]
    assert main([*command, "-o", str(run)]) == 0
    for name in ("results.json", "page.html", "page.md", "tables.tex"):
        assert (run / name).stat().st_size > 0, name
    results = Results.load(run / "results.json")
    titles = [table.title.partition(":")[0] for table in results.tables]
    assert titles[:3] == ["Table 1", "Table 3", "Table 4"]
    assert "Material accuracy by training data" in {table.title for table in results.tables}
    assert "beyond the paper" in {claim.source for claim in results.claims}
    rows = [row[0] for row in results.tables[1].rows]
    assert {*METHODS, *CONTROLS, controls.HALVES, judging.HALF_PROBES} == {*rows}
    assert len(results.audits) == 2
    assert results.audits[1].leaked_fraction == 0 < results.audits[0].leaked_fraction
    assert results.claims
    for table in results.tables:
        for cell in (c for row in table.rows for c in row if isinstance(c, Score)):
            assert (run / cell.details["stage"] / "stage.json").is_file()
    checked = verify(run / "results.json").counts
    assert checked["same"] > 300
    assert checked["differs"] == checked["cannot check"] == 0
    times = {p: p.stat().st_mtime_ns for p in run.glob("*/stage.json")}
    # The images of a method, given as another system's, score as that method's.
    given = f"theirs={run / 'images-gvst-NoLeak-0' / 'images'}"
    assert main([*command, "-o", str(run), "--method", given]) == 0
    changed = {p.parent.name for p, t in times.items() if p.stat().st_mtime_ns != t}
    assert changed == {"scores-NoLeak-by-NoLeak-0", "results"}
    again = Results.load(run / "results.json")
    for metric in ("TMMD", "SSIM", "material accuracy"):
        assert again[metric, "theirs"].value == pytest.approx(again[metric, "GVST"].value)
        assert again[metric, "GVST"].value == pytest.approx(results[metric, "GVST"].value)
