"""Studies: their objects and nodes, controls against planted truths, tables from forged scores."""

import json
import shutil
from dataclasses import replace
from functools import partial
from itertools import combinations, product

import numpy as np
import polars as pl
import pytest
from PIL import Image

from forge.commands import call, mistake
from forge.errors import fails
from forge.studies import TINY, forge_touch_and_go
from palpate.cli import main
from palpate.core import FeatureSet, Measure, Score, Split, digest_file
from palpate.core.files import canonical_json
from palpate.data.manifest import Manifest
from palpate.encoders.models import shipped_folder
from palpate.preference.scoring import PREFERENCE, STRENGTH
from palpate.report.results import Results
from palpate.sim import WorldOptions
from palpate.sim.presets import MINI_SEEDS
from palpate.studies import collecting, controls, judging, reproduce, stamps, utility
from palpate.studies.controls import CONTROLS
from palpate.studies.graph import Work, digests_of
from palpate.studies.making import write_made
from palpate.studies.methods import METHODS, Method, Setting
from palpate.studies.names import (
    FLOOR,
    HALF_PROBES,
    HALVES,
    NEAREST,
    NOLEAK,
    ORIG,
    OURS,
    SPLITS,
    slug,
)
from palpate.studies.reproduce import Plan
from palpate.studies.study import STUDIES
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


def test_no_shipped_model_has_seen_the_worlds_and_another_study_has_another_name():
    for study in STUDIES.values():
        for preset in study.presets.values():
            if study.world is not None:
                world = replace(preset.world, **study.world)
                assert isinstance(world, WorldOptions)
                assert world.seed not in MINI_SEEDS
    seen = replace(WORLD, name="seen", world={**(WORLD.world or {}), "seed": MINI_SEEDS[0]})
    other = replace(WORLD, methods=WORLD.methods[:1])
    for study, words in ((seen, "one that no shipped model saw"), (other, "a name of its own")):
        fails(words, Plan, study)


def test_nodes_train_once_for_each_split_and_seed():
    nodes = {n.name: n for n in Plan(WORLD, preset="smoke", seeds=(0, 1)).nodes()}
    for seed, split in ((s, p) for s in (0, 1) for p in (ORIG, NOLEAK)):
        assert {f"encoder-{split}-{seed}", f"ours-{split}-{seed}"} <= {*nodes}
        for judge in (ORIG, NOLEAK):  # both encoders judge both generators
            after = nodes[f"scores-{split}-by-{judge}-{seed}"].after
            assert {f"encoder-{judge}-{seed}", f"images-ours-{split}-{seed}"} <= {*after}
    assert "gvst-Orig-0" not in nodes
    assert "ours-by-text-NoLeak-0" not in nodes
    assert "ours-NoLeak-0" in nodes["images-ours-by-text-NoLeak-0"].after
    judged = nodes["scores-NoLeak-by-NoLeak-1"]
    assert {*judged.options["methods"]} == {*METHODS}
    assert judged.options["study"].stamp["controls"] == [*CONTROLS]


def test_another_seed_leaves_the_nodes_of_the_first():
    one, two = (
        {n.name: (n.options, n.after, n.version) for n in Plan(WORLD, seeds=seeds).nodes()}
        for seeds in ((0,), (0, 1))
    )
    changed = {name for name in one if one[name] != two[name]}
    assert changed == {"results", "utility"}
    read = {n.name: n for n in Plan(WORLD, seeds=(0, 1)).nodes()}["utility"].after
    assert {"images-ours-NoLeak-0", "images-ours-NoLeak-1"} <= {*read}


def digests(study, **options):
    """Name -> digest of what the stage reads."""
    return digests_of(Plan(study, preset="smoke", **options).nodes())


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
    before, stamp = digests(WORLD), reproduce.model_stamp
    monkeypatch.setattr(
        reproduce, "model_stamp", lambda p, s: stamp(p, s) if p == "clip" else f"other {p}"
    )
    after = digests(WORLD)
    trained = [n for n in before if n.startswith(("encoder", "ours", "gvst", "images-ours"))]
    assert all(before[name] == after[name] for name in trained)
    assert before["images-palpate-mini-NoLeak-0"] != after["images-palpate-mini-NoLeak-0"]


@pytest.mark.parametrize("part", ["clip", "encoders", "autoencoder", "generator"])
def test_the_words_of_a_card_build_nothing_again(monkeypatch, tmp_path, part):
    before = reproduce.model_stamp(part, "palpate/mini")
    record = json.loads((shipped_folder("palpate/mini", part) / "palpate.json").read_text())
    monkeypatch.setattr(stamps, "shipped_folder", lambda *_: tmp_path)

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
    nodes = Plan(STUDIES[name], seeds=(0, 1)).nodes()
    for node in nodes:
        written = canonical_json(node.inputs(digests_of(nodes)))
        assert canonical_json(json.loads(written)) == written, node.name


def test_the_size_of_the_paper_takes_its_autoencoder(tmp_path):
    tag, file = STUDIES["tag"], tmp_path / "vq-f4.ckpt"
    file.write_bytes(b"weights")
    made = {}
    for preset in ("paper", "mini"):
        plan = Plan(tag, preset=preset, root=tmp_path, vq=file, steps=400)
        made[preset] = {n.name: n for n in plan.nodes()}
        assert made[preset]["autoencoder-vq-NoLeak"].options["options"].stamp == digest_file(file)
        assert made[preset]["ours-vq-NoLeak-0"].options["training"].diffusion.loop.steps == 400
    assert made["paper"].keys() == made["mini"].keys()
    assert "world" not in made["mini"]


def closed(by):
    return lambda setting: by


def nodes_of(make):
    """The nodes of a study with a method of one's own."""
    study = replace(WORLD, name="mine", methods=[METHODS[OURS], Method("mine", "", make=make)])
    return {n.name: n for n in Plan(study, preset="smoke").nodes()}


@pytest.mark.parametrize("make", [closed(1), len, partial(controls.mean_image, by=1)])
def test_a_method_of_your_own_is_a_function_of_a_file_and_trains_nothing(make):
    one, two = nodes_of(controls.mean_image), nodes_of(controls.one_image)
    each = [digests_of([*nodes.values()])["images-mine-NoLeak-0"] for nodes in (one, two)]
    assert each[0] != each[1]
    assert "mine-NoLeak-0" not in one
    assert "mine" in one["scores-NoLeak-by-NoLeak-0"].options["methods"]
    fails("must be a function of a file", nodes_of, make)


def test_a_dry_run_writes_nothing(tmp_path, capsys):
    run = tmp_path / "run"
    _, out, _ = call(capsys, "reproduce", "world-digit", "-o", run, "--dry-run", "--json")
    stages = json.loads(out)["stages"]
    assert not run.exists()
    assert [*stages][:2] == ["world", "data"]
    assert [*stages][-1] == "results"
    assert not any(stages.values())


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["world-gelsigt"], "must be one of clips, hct, tag, world-digit, world-gelsight"),
        (["world-gelsight", "--preset", "huge"], "--preset must be one of smoke, mini"),
        (["world-gelsight", "--seeds", "1", "1"], "--seeds must hold"),
        (["world-gelsight", "--root", "."], "--root must be left out"),
        (["tag"], "--root must be given for the study tag"),
        (["tag", "--root", "x"], "--root must exist"),
        (["tag", "--root", ".", "--preset", "paper"], "--vq must be given for preset paper"),
        (["tag", "--root", ".", "--steps", "3"], "--steps must be at least 4"),
        (
            ["world-gelsight", "--people", "s.json"],
            "--people must hold scores of palpate preference",
        ),
        (["world-gelsight", "--method", "dir"], "--method must be NAME=FOLDER"),
        (["world-gelsight", "--method", "a=dir"], "a must be a folder of images"),
        (["world-gelsight", "--method", "GVST=dir"], "a name of its own"),
    ],
)
def test_mistakes_are_reported_in_one_line(args, words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Results("t", scores=[Score("TMMD", "Ours", 0.1)]).save(tmp_path / "s.json")
    mistake(capsys, words, "reproduce", *args, "-o", "r")
    assert not (tmp_path / "r").exists()


@pytest.fixture
def setting(small_manifest, tmp_path):
    """A train and a test video of each of three materials."""
    split = Split({i: "train" if i < "v3" else "test" for i in small_manifest.ids})
    train, test = (small_manifest.part(split, part) for part in ("train", "test"))
    return Setting(train, test, Work(tmp_path, cache=tmp_path / "cache"), 32, 0, 1, "palpate/mini")


def of_whole_videos(setting, rows):
    """Materials of train rows and of the test samples; whole videos stand for whole videos."""
    video, own = np.array(setting.train.column("video"))[rows], setting.test.column("video")
    assert len({*zip(video, own, strict=True)}) == len({*own}) == 3
    return np.array(setting.train.column("material"))[rows], setting.test.column("material")


def test_the_floor_is_of_other_videos_of_the_material_and_a_wrong_one_never_right(setting):
    material, own = of_whole_videos(setting, controls.other_videos(setting))
    assert (material == own).all()
    material, own = of_whole_videos(setting, controls.wrong_material(setting))
    assert (material != own).all()


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
        rows = getattr(controls, make)(mixed)
        assert {known[k] for k in rows} == {material}, make
    lacking = with_materials(setting, known, ["sand"] * 24)
    assert controls.memorized(lacking) is None
    assert controls.other_videos(lacking) is None


def test_without_materials_none_is_wrong(setting):
    bare = with_materials(setting, [None] * len(setting.train), [None] * len(setting.test))
    assert controls.wrong_material(bare) is None
    of_whole_videos(bare, controls.other_videos(bare))


def test_a_memorized_video_is_one_a_material(setting):
    rows, own = controls.memorized(setting), setting.test.column("material")
    columns = (np.array(setting.train.column(name))[rows] for name in ("material", "video"))
    material, video = columns
    assert (material == own).all()
    assert len({*video}) == len({*own}) == 3


def test_constant_controls(setting):
    mean, one = controls.mean_image(setting), controls.one_image(setting)
    train = np.asarray(setting.pixels(setting.train), float)
    assert np.abs(mean[0] - train.mean(axis=0)).max() <= 0.5
    assert (mean == mean[0]).all()
    assert (one == one[0]).all()
    assert len(one) == len(setting.test)
    assert 0 <= one[0] < len(setting.train)


def test_train_images_that_stand_for_test_images_keep_their_gels(setting):
    rows = controls.one_image(setting)
    make_images = {"one": controls.one_image, "mean": controls.mean_image}
    for name, make in make_images.items():
        write_made(setting.work.folder / name, name, make(setting), setting)
    one, mean = (Manifest.load(setting.work.folder / name) for name in make_images)
    assert one.ids == mean.ids == setting.test.ids
    for column in ("tactile", "background"):
        saved = np.asarray(Image.open(one.paths(column)[-1]))
        assert (saved == setting.pixels(setting.train, column)[rows[-1]]).all()
    assert mean.table["background"].null_count() == len(mean)


def test_the_nearest_photo_by_a_slow_loop(setting):
    from palpate.encoders.embed import embed
    from palpate.encoders.encoder_set import EncoderSet

    encoders = EncoderSet.load("palpate/mini")
    photos, queries = (
        embed(part, encoders, "vision").features for part in (setting.train, setting.test)
    )
    slow = [max(range(len(photos)), key=lambda k: float(q @ photos[k])) for q in queries]
    assert (controls.nearest_photo(setting) == slow).all()


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
    values = {pair: 1.0 + k for k, pair in enumerate(product(SPLITS, SPLITS))}
    metrics = ("SSIM", "TMMD", "I-TMMD", "CI-TMMD", "D-TMMD")
    subjects = (OURS, "GVST", "other", FLOOR, NEAREST)
    half = forged(HALF_PROBES, "material accuracy", 0.5)
    judged = {
        pair: Scores.over_seeds(
            [[half, *(forged(n, m, v) for n in subjects for m in metrics)]], "results"
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
    listed = [OURS, "GVST", "other", FLOOR, NEAREST, HALF_PROBES]
    assert [row[0] for row in three.rows] == listed
    assert not [row for row in one.rows if str(row[0]).startswith(HALF_PROBES)]
    assert [row[0] for row in four.rows] == [OURS, "GVST", "other", FLOOR, NEAREST]
    assert three.controls == [FLOOR, NEAREST, HALF_PROBES]
    assert three.columns[:2] == ["images", "SSIM"]
    assert "All methods but other are trained from random weights" in three.text
    for table in (one, three, four):
        assert all(len(row) == len(table.columns) for row in table.rows)
        assert not any("paper" in str(row[0]) for row in table.rows)


def judgments(*scores):
    """The same scores by every encoder of the images of both splits."""
    return {pair: Scores.over_seeds([scores], "results") for pair in product(SPLITS, SPLITS)}


def test_people_are_columns_of_table_three():
    judged = judgments(forged(OURS, "TMMD", 1.0), forged("GVST", "TMMD", 1.0))
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


def test_the_papers_numbers_stand_beside_its_own_data_and_metrics_alone():
    """FID of another network is not the paper's FID."""
    networks = ("Inception", "palpate/mini vision")
    scores = [forged(OURS, metric, 1.0) for metric in ("SSIM", "TMMD")]
    judged = judgments(*scores, *(forged(OURS, "FID", 1.0, features=n) for n in networks))
    study, digit = (replace(STUDIES[n], paper=True) for n in ("world-gelsight", "world-digit"))
    one, three, four = study_tables(study, judged, [], methods=[OURS], controls=[])
    by_name = [{row[0]: row for row in table.rows} for table in (one, three, four)]
    assert by_name[0]["paper, NoLeak"][3] == "1.37"
    assert by_name[1]["paper, Ours w/ BG"][1] == "0.54"
    assert by_name[2]["paper, GVST"][1] == "1.98"
    cells = dict(zip(three.columns, by_name[1]["paper, Ours"], strict=True))
    assert (cells["SSIM"], cells["FID (Inception)"]) == ("0.49", "43.9")
    assert cells["FID (palpate/mini vision)"] is None
    hct = study_tables(digit, judged, [], methods=[OURS], controls=[])[1]
    assert {row[0]: row[1] for row in hct.rows}["paper, GVST"] == "2.67"


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
    assert (of_real.a, of_real.value, of_real.n) == (HALF_PROBES, 1, 4)


@pytest.mark.nightly
def test_a_study_from_its_command_to_its_page(tmp_path, monkeypatch):
    """On the paper's data set: every table, method and control; other people's images as well;
    running again builds nothing."""
    monkeypatch.setitem(STUDIES, "tag", replace(STUDIES["tag"], presets={"smoke": TINY}))
    monkeypatch.setattr(reproduce, "Draws", partial(utility.Draws, shots=(1, 2), draws=2))
    run, root = tmp_path / "run", forge_touch_and_go(tmp_path)
    command = ["reproduce", "tag", "--root", str(root), "--preset", "smoke", "-q", "-o", str(run)]
    assert main(command) == 0
    for name in ("results.json", "page.html", "page.md", "tables.tex"):
        assert (run / name).stat().st_size > 0, name
    results = Results.load(run / "results.json")
    tables = {table.title.partition(":")[0]: table for table in results.tables}
    assert [*tables][:3] == ["Table 1", "Table 3", "Table 4"]
    assert "Material accuracy by training data" in tables
    assert "beyond the paper" in {claim.source for claim in results.claims}
    rows = {str(row[0]) for row in tables["Table 3"].rows}
    printed = {f"paper, {name}" for name in (OURS, "GVST", "Ours w/ BG")}
    assert rows == {*METHODS, *CONTROLS, HALVES, HALF_PROBES, *printed}
    assert {f"paper, {split}" for split in SPLITS} < {row[0] for row in tables["Table 1"].rows}
    assert results.settings["split rule"][NOLEAK]["name"] == "TaG-NoLeak"
    assert len(results.audits) == 2
    assert results.audits[1].leaked_fraction == 0 < results.audits[0].leaked_fraction
    for table in results.tables:
        for cell in (c for row in table.rows for c in row if isinstance(c, Score)):
            assert (run / cell.details["stage"] / "stage.json").is_file()
    checked = verify(run / "results.json").counts
    assert checked["same"] > 300
    assert checked["differs"] == checked["cannot check"] == 0
    times = {p: p.stat().st_mtime_ns for p in run.glob("*/stage.json")}
    # The images of a method, given as another system's, score as that method's.
    given = f"theirs={run / 'images-gvst-NoLeak-0' / 'images'}"
    assert main([*command, "--method", given]) == 0
    changed = {p.parent.name for p, t in times.items() if p.stat().st_mtime_ns != t}
    assert changed == {"scores-NoLeak-by-NoLeak-0", "results"}
    again = Results.load(run / "results.json")
    for metric in ("TMMD", "SSIM", "material accuracy"):
        assert again[metric, "theirs"].value == pytest.approx(again[metric, "GVST"].value)
        assert again[metric, "GVST"].value == pytest.approx(results[metric, "GVST"].value)
