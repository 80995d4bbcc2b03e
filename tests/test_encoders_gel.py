"""The learned ruler of residuals, and its training by all that data say or by touches alone."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from dataclasses import replace  # noqa: E402
from io import BytesIO  # noqa: E402

from PIL import Image  # noqa: E402

from forge.errors import fails  # noqa: E402
from palpate import score, train_encoder  # noqa: E402
from palpate.core import PalpateError, Split, image_bytes  # noqa: E402
from palpate.data.images import load_images  # noqa: E402
from palpate.data.manifest import Manifest  # noqa: E402
from palpate.data.residuals import Residual  # noqa: E402
from palpate.encoders.embed import embed  # noqa: E402
from palpate.encoders.encoder_set import EncoderSet, load_clip  # noqa: E402
from palpate.encoders.gel import CODECS, GelEncoder  # noqa: E402
from palpate.encoders.gel_training import Touches, contrast, held_out, train_ruler, units_of, views  # noqa: E402
from palpate.encoders.presets import PRESETS, Gel  # noqa: E402
from palpate.sim import WorldOptions, write_world  # noqa: E402
from palpate.training.run import TrainingRun  # noqa: E402
from palpate.training.steps import Step  # noqa: E402

SMALL = (4, 4, 8, 8, 8), 6, 32


def preset(name, **changes):
    """A preset of a few steps and small layers."""
    chosen = PRESETS[name]
    course = replace(chosen.tactile_course, **{"steps": 4, "batch": 8, "evaluations": 2} | changes)
    widths = replace(chosen.tactile, widths=SMALL[0])
    return replace(chosen, tactile=widths, tactile_course=course, image=32)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    folder = tmp_path_factory.mktemp("gel") / "world"
    options = WorldOptions(
        seed=4, size=32, materials=4, objects_per_material=3, contacts_per_video=2, mixed=0.0
    )
    write_world(folder, options)
    return Manifest.load(folder), Split.load(folder / "splits" / "Orig.json")


@pytest.fixture(scope="module")
def trained(world):
    return train_encoder(*world, preset=preset("gel"))


def residuals(n, side=32, seed=0):
    return 5 * torch.randn(n, 3, side, side, generator=torch.Generator().manual_seed(seed))


def test_numbers_see_no_even_shift_and_a_stronger_contact():
    ruler, x = GelEncoder(*SMALL), residuals(5)
    numbers = ruler.numbers(x)
    assert numbers.shape == (5, 16)
    torch.testing.assert_close(ruler.numbers(x + torch.tensor([3.0, -9, 0]).view(3, 1, 1)), numbers)
    assert not torch.allclose(ruler.numbers(2 * x), numbers, rtol=0.1)


def test_layers_keep_the_variance_and_no_scale_of_their_weights():
    ruler = GelEncoder((16, 32, 64, 128, 128), 128, 96)
    x = torch.randn(4, 3, 96, 96)
    for layer in ruler.layers:
        x = layer(x)
        assert 0.3 < float(x.detach().var()) < 3
    with torch.no_grad():
        before = ruler.numbers(residuals(2, 96))
        ruler.layers[1].weight.mul_(7).add_(0.3)
        torch.testing.assert_close(ruler.numbers(residuals(2, 96)), before, rtol=1e-3, atol=1e-3)


def test_a_saved_ruler_is_what_it_was(trained, tmp_path):
    trained.save(tmp_path / "set")
    again = EncoderSet.load(tmp_path / "set")
    assert again.digest("tactile") == trained.digest("tactile")
    assert (again.width("tactile"), again.shared_width, again.dim) == (16, 128, 128)
    x = residuals(3)
    torch.testing.assert_close(again.encode("tactile", x), trained.encode("tactile", x))
    rows = again.shared(again.encode("tactile", x).numpy())
    np.testing.assert_allclose(np.linalg.norm(rows, axis=1), 1, rtol=1e-5)
    assert again.preprocess("tactile") == Residual(32, 32)
    assert again.with_tactile(trained).digest("tactile") == trained.digest("tactile")


def test_a_codec_moves_numbers_less_without_its_direction(world, trained):
    data, split = world
    held, ruler = data.part(split, "test"), trained.tactile
    torch.testing.assert_close(ruler.codecs @ ruler.codecs.T, torch.eye(CODECS))
    frames = ruler.preprocess.frames(held, "tactile").files
    small = [Image.open(image).resize((240, 240)) for image, *_ in frames]
    files = [
        (Image.open(BytesIO(image_bytes(x, "JPEG", quality=40))), *gel)
        for x, (_, *gel) in zip(small, frames, strict=True)
    ]
    plain, coded = (
        torch.from_numpy(load_images(f, ruler.preprocess)).permute(0, 3, 1, 2).float()
        for f in (frames, files)
    )
    with torch.no_grad():
        whole = ((ruler.numbers(coded) - ruler.numbers(plain)) / ruler.spread).mean(0)
        left = (ruler(coded) - ruler(plain)).mean(0)
    assert float(left.norm()) < 0.8 * float(whole.norm())


def test_partners_are_of_the_same_object_and_seldom_the_row_itself(world):
    data, split = world
    train, val = data.part(split, "train"), data.part(split, "test")
    touches = Touches(train, val, None, TrainingRun(None), 32)
    every, contact = (train.table[c].to_numpy() for c in ("object", "contact"))
    rows = np.arange(len(train))
    several = np.array([len({*contact[every == o]}) > 1 for o in every])
    rng, far = np.random.default_rng(0), []
    for _ in range(50):
        partner = touches.partners(rows, rng.random((len(rows), 2)))
        assert (partner < len(train)).all()  # none of the other part, which has the same objects
        assert (every[partner] == every).all()
        assert (partner != rows).all()
        far.append((contact[partner] != contact)[several].mean())
    assert 0.4 < np.mean(far) < 0.6
    edge = np.stack([np.zeros(len(rows)), np.full(len(rows), 1 - 1e-12)], 1)
    assert (every[touches.partners(rows, edge)] == every).all()


def test_a_touch_alone_is_its_own_partner(world):
    data, split = world
    train = data.part(split, "train")
    objects = train.column("object")
    others = [i for i, o in zip(train.ids, objects, strict=True) if o != objects[0]]
    some = train.take([train.ids[0], *others])
    touches = Touches(some, some.take([]), None, TrainingRun(None), 32)
    assert touches.partners(np.array([0]), np.array([[0.3, 0.9]])).tolist() == [0]
    alone = train.take([train.ids[0]])
    fails("two touches of one object", Touches, alone, alone.take([]), None, TrainingRun(None), 32)


def test_views_without_a_draw_leave_images_and_gray_stays_gray():
    x = residuals(4)
    still = {"uniform": torch.tensor([0, 0, 0.49, 0.9, 0.9, 0, 0]).repeat(4, 1)}
    still |= {"normal": torch.zeros(4, 4), "noise": torch.zeros_like(x)}
    zoom = np.log(1 / 0.7) / np.log(1.45 / 0.7)
    still["uniform"][:, 2] = float(zoom)
    torch.testing.assert_close(views(x, still), x, rtol=1e-3, atol=1e-3)
    gray = x.mean(1, keepdim=True).expand(-1, 3, -1, -1)
    turned = {**still, "uniform": still["uniform"].clone()}
    turned["uniform"][:, 1], turned["uniform"][:, 4] = torch.rand(4), torch.tensor([0.0, 0, 1, 1])
    torch.testing.assert_close(views(gray, turned), gray, rtol=1e-3, atol=1e-3)
    assert not torch.allclose(views(x, turned), x, atol=0.5)


def test_contrast_is_a_plain_sum():
    z, unit = torch.randn(6, 3), torch.tensor([0, 1, 1, 0, 1, 1])
    rows = torch.nn.functional.normalize(z, dim=1).numpy()
    total = 0.0
    for i in range(6):
        partner = (i + 3) % 6
        others = [j for j in range(6) if j == partner or unit[j] != unit[i]]
        logits = np.array([rows[i] @ rows[j] / 0.15 for j in others])
        total += np.log(np.exp(logits).sum()) - rows[i] @ rows[partner] / 0.15
    assert float(contrast(z, unit)) == pytest.approx(total / 6, rel=1e-5)


def test_batches_do_not_depend_on_the_number_of_processes(world):
    data, split = world
    train = data.part(split, "train")
    touches = Touches(train, train.take([]), load_clip("palpate/mini"), TrainingRun(None), 32)
    rows = np.arange(8)
    whole = touches.load(Step(3, rows, 0))
    parts = [touches.load(Step(3, rows, 0, (k, 2))) for k in range(2)]
    for name in ("unit", "numbers", "name", "text", "vision", "caption", "photo"):
        assert torch.equal(whole[name], parts[0][name])
    for name in ("images", "uniform", "normal", "noise"):
        both = [p[name].unflatten(0, (2, -1)) for p in parts]
        assert torch.equal(torch.cat(both, 1).flatten(0, 1), whole[name])


def test_training_repeats_and_says_what_it_saw(world, trained):
    data, split = world
    again = train_encoder(data, split, preset=preset("gel"))
    assert again.digest("tactile") == trained.digest("tactile")
    card = trained.card
    assert card["recordings"]["names"] == sorted({*data.part(split, "train").column("object")})
    assert {"contrast", "numbers", "names", "text", "vision"} <= card["loss"][0].keys()
    assert trained.saw("tactile", data.part(split, "train")).all()
    assert not trained.saw("tactile", data.part(split, "test")).any()
    rows = embed(data, trained).features
    np.testing.assert_allclose(np.linalg.norm(rows, axis=1), 1, rtol=1e-5)
    raw = embed(data.part(split, "train"), trained, raw=True).features
    np.testing.assert_allclose(raw.mean(0), 0, atol=0.05)
    assert 0.5 < raw.std(0).max() < 1.05
    np.testing.assert_allclose(raw @ trained.tactile.codecs.numpy().T, 0, atol=0.01)


def test_touches_alone_teach_and_own_frames_are_refused(world, trained, tmp_path):
    data, split = world
    trained.save(tmp_path / "start")
    blind = data.table.with_columns(**dict.fromkeys(("vision", "text", "material"), None)).cast(
        data.table.schema
    )
    blind = replace(data, table=blind)
    split = Split.from_ids(
        train=split.ids("train"),
        test=split.ids("test"),
        rule=dict(split.rule),
        manifest=blind.digest,
    )
    own = train_encoder(blind, split, preset=preset("self"), clip=tmp_path / "start")
    assert own.digest("tactile") != trained.digest("tactile")
    assert own.modalities == ["tactile"]
    assert {*own.card["loss"][0]} >= {"contrast", "numbers"}
    assert "text" not in own.card["loss"][0]
    train = blind.part(split, "train")
    kept, held = held_out(train, 0)
    assert own.card["recordings"]["names"] == sorted({u.split("\n")[1] for u in units_of(kept, "")})
    assert {*units_of(kept, "")}.isdisjoint(units_of(held, ""))
    assert own.saw("tactile", kept).all()
    assert own.card["train_samples"] == len(kept)
    assert own.card["start_card"]["preset"] == "gel"
    with pytest.raises(PalpateError, match="that it was trained on"):
        score(kept, kept, encoder=own)
    fails("learned ruler", train_encoder, blind, split, preset=preset("self"), clip="palpate/mini")
    other = replace(preset("self"), image=64)  # equal weights, residuals of another side
    fails("learned ruler", train_encoder, blind, split, preset=other, clip=tmp_path / "start")
    own.save(tmp_path / "own")
    assert EncoderSet.load(tmp_path / "own").digest("tactile") == own.digest("tactile")
    file = tmp_path / "own" / "tactile" / "model.safetensors"  # does not know what it saw
    fails(f"Pass {tmp_path / 'own'}", EncoderSet.load, file)


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"image": 16}, "32 or more"),
        ({"fitting": "pad"}, "crop and none"),
        ({"turn": "left"}, "crop and none"),
        ({"tactile": Gel((8, 8))}, "must be 5"),
    ],
)
def test_what_a_ruler_cannot_be(changes, word):
    fails(word, replace, PRESETS["gel"], **changes)


def test_touches_alone_need_a_ruler():
    fails("ruler to go on from", replace, PRESETS["mini"], alone=True, pretrained="palpate/mini")
    fails("ruler to go on from", replace, PRESETS["gel"], alone=True, pretrained=None)


@pytest.mark.parametrize("known", [True, False])
def test_going_on_keeps_what_the_start_saw(world, trained, known, tmp_path):
    data, split = world
    rule = {"name": "every second sample"}
    other = Split.from_ids(train=data.ids[1::2], rule=rule, manifest=data.digest)
    start = trained if known else replace(trained, seen={})
    own = train_ruler(data, other, start, preset("self", steps=2), TrainingRun(tmp_path))
    assert own.knows_seen("tactile") == known
    only_start = data.take([*{*split.ids("train")}.difference(data.ids[1::2])])
    assert {*own.saw("tactile", only_start).tolist()} == {known}
    assert own.saw("tactile", held_out(data.take(data.ids[1::2]), 0)[0]).all()


def test_a_tenth_but_three_at_least_are_held_out_by_recording(world):
    data, _ = world
    kept, held = held_out(data, 3)
    assert len({*units_of(held, "")}) == 3
    assert len(kept) + len(held) == len(data)
    units = units_of(data, "")
    few = [i for i, u in zip(data.ids, units, strict=True) if u in sorted({*units})[:5]]
    fails("6 objects or videos", held_out, data.take(few), 3)
