"""Public tactile encoders: tiny checkpoints with the true names, against a short forward here."""

import argparse
import math
from dataclasses import replace

import numpy as np
import polars as pl
import pytest
import torch
from PIL import Image
from safetensors.torch import save_file
from torch.nn.functional import conv2d, gelu, layer_norm, linear, normalize

from forge.errors import Bomb, fails
from forge.worlds import by_video
from palpate import probe, score
from palpate.core import PalpateError
from palpate.data.images import cached_images
from palpate.data.manifest import Manifest
from palpate.encoders import Encoder, EncoderSet, train_encoder
from palpate.encoders.embed import embed
from palpate.encoders.presets import preset_of
from palpate.encoders.tactile import load_tactile

WIDTH, DEPTH, HEADS = 128, 2, 2


def weights(*shapes, seed=0):
    """Random tensors by name."""
    generator = torch.Generator().manual_seed(seed)
    return {name: torch.randn(shape, generator=generator) * 0.1 for name, *shape in shapes}


def norm(name):
    return [(f"{name}.weight", WIDTH), (f"{name}.bias", WIDTH)]


def dense(name, out, into):
    return [(f"{name}.weight", out, into), (f"{name}.bias", out)]


def blocks(*, scaled):
    names = []
    for k in range(DEPTH):
        b = f"blocks.{k}"
        names += norm(f"{b}.norm1") + dense(f"{b}.attn.qkv", 3 * WIDTH, WIDTH)
        names += dense(f"{b}.attn.proj", WIDTH, WIDTH) + norm(f"{b}.norm2")
        names += dense(f"{b}.mlp.fc1", 4 * WIDTH, WIDTH) + dense(f"{b}.mlp.fc2", WIDTH, 4 * WIDTH)
        names += [(f"{b}.{s}.gamma", WIDTH) for s in ("ls1", "ls2")] if scaled else []
    return names


def sparsh(registers=1):
    names = [("patch_embed.proj.weight", WIDTH, 6, 16, 16), ("patch_embed.proj.bias", WIDTH)]
    names += [("register_tokens", 1, registers, WIDTH)] if registers else []
    state = weights(*names, *blocks(scaled=True), *norm("norm"))
    bands = torch.linspace(0, 1, WIDTH // 4 + 1)[:-1]
    return state | {"pos_embed.frequency_bands": torch.stack([10000**-bands] * 2)}


def tvl():
    names = [("cls_token", 1, 1, WIDTH), ("pos_embed", 1, 17, WIDTH)]
    names += [("patch_embed.proj.weight", WIDTH, 3, 16, 16), ("patch_embed.proj.bias", WIDTH)]
    names += blocks(scaled=False) + norm("fc_norm") + dense("head", 48, WIDTH)
    state = {f"tactile_encoder.{k}": v for k, v in weights(*names).items()}
    return state | {"logit_scale": torch.tensor(2.0)}


def anytouch():
    t = "touch_model"
    names = [(f"{t}.embeddings.class_embedding", WIDTH), ("touch_projection.weight", 48, WIDTH)]
    names += [(f"{t}.embeddings.patch_embedding.weight", WIDTH, 3, 14, 14)]
    names += [
        (f"{t}.embeddings.position_embedding.weight", 17, WIDTH),
        ("sensor_token", 10, 5, WIDTH),
    ]
    names += norm(f"{t}.pre_layrnorm") + norm(f"{t}.post_layernorm")
    for k in range(DEPTH):
        b = f"{t}.encoder.layers.{k}"
        for part in "qkv":
            names += dense(f"{b}.self_attn.{part}_proj", WIDTH, WIDTH)
        names += dense(f"{b}.self_attn.out_proj", WIDTH, WIDTH)
        names += norm(f"{b}.layer_norm1") + norm(f"{b}.layer_norm2")
        names += dense(f"{b}.mlp.fc1", 4 * WIDTH, WIDTH) + dense(f"{b}.mlp.fc2", WIDTH, 4 * WIDTH)
    names += [("decoder_blocks.0.mlp.fc1.weight", 8, 8), ("mask_token", 1, 1, 8)]  # of no use here
    state = {f"touch_mae_model.{k}": v for k, v in weights(*names).items()}
    return state | {"clip_model.visual.weight": torch.zeros(3)}


STATES = {"sparsh": sparsh, "sparsh-mae": lambda: sparsh(0), "tvl": tvl, "anytouch": anytouch}


def write(kind, folder, state=None):
    """A checkpoint in its published nesting."""
    state = state or STATES[kind]()
    if kind.startswith("sparsh"):
        save_file(state, path := folder / "dino_vitbase.safetensors")
        return path
    content = {"model": state}
    if kind == "tvl":
        more = {"optimizer": {"lr": 1.0}, "epoch": 3, "args": argparse.Namespace(batch_size=256)}
        content |= more
    torch.save(content, path := folder / f"{kind}.pth")
    return path


def transformer(x, s, prefix, eps, names, *, fused):
    """Blocks of a vision transformer, by their equations."""
    n1, n2, attn, out, mlp = names
    for k in range(DEPTH):
        p = f"{prefix}{k}."

        def apply(name, y, p=p):
            return linear(y, s[f"{p}{name}.weight"], s[f"{p}{name}.bias"])

        def normed(name, y, p=p):
            return layer_norm(y, (WIDTH,), s[f"{p}{name}.weight"], s[f"{p}{name}.bias"], eps)

        y = normed(n1, x)
        if fused:
            q, key, v = apply(f"{attn}.qkv", y).chunk(3, dim=-1)
        else:
            q, key, v = (apply(f"{attn}.{part}_proj", y) for part in "qkv")
        heads = []
        for h in range(HEADS):
            at = slice(h * WIDTH // HEADS, (h + 1) * WIDTH // HEADS)
            logits = q[..., at] @ key[..., at].transpose(1, 2) / math.sqrt(WIDTH // HEADS)
            heads.append(logits.softmax(-1) @ v[..., at])
        x = x + s.get(f"{p}ls1.gamma", 1) * apply(f"{attn}.{out}", torch.cat(heads, -1))
        y = apply(f"{mlp}.fc2", gelu(apply(f"{mlp}.fc1", normed(n2, x))))
        x = x + s.get(f"{p}ls2.gamma", 1) * y
    return x


TIMM = ("norm1", "norm2", "attn", "proj", "mlp")
HF = ("layer_norm1", "layer_norm2", "self_attn", "out_proj", "mlp")


def want_sparsh(s, pixels):
    grid = conv2d(pixels, s["patch_embed.proj.weight"], s["patch_embed.proj.bias"], 16)
    rows, columns = grid.shape[2:]
    waves = []
    for row in range(rows):
        for column in range(columns):
            per = [
                torch.cat([(a * b).sin(), (a * b).cos()])
                for a, b in zip((row, column), s["pos_embed.frequency_bands"], strict=True)
            ]
            waves.append(torch.cat(per))
    x = grid.flatten(2).transpose(1, 2) + torch.stack(waves)
    registers = s.get("register_tokens", torch.empty(1, 0, WIDTH))
    x = torch.cat([registers.repeat(len(x), 1, 1), x], 1)
    x = transformer(x, s, "blocks.", 1e-6, TIMM, fused=True)
    x = layer_norm(x, (WIDTH,), s["norm.weight"], s["norm.bias"], 1e-6)
    return normalize(x[:, registers.shape[1] :].mean(1), dim=-1)


def want_tvl(s, pixels):
    s = {k.removeprefix("tactile_encoder."): v for k, v in s.items()}
    x = conv2d(pixels, s["patch_embed.proj.weight"], s["patch_embed.proj.bias"], 16)
    x = torch.cat([s["cls_token"].repeat(len(x), 1, 1), x.flatten(2).transpose(1, 2)], 1)
    x = transformer(x + s["pos_embed"], s, "blocks.", 1e-6, TIMM, fused=True)[:, 1:].mean(1)
    x = layer_norm(x, (WIDTH,), s["fc_norm.weight"], s["fc_norm.bias"], 1e-6)
    return normalize(linear(x, s["head.weight"], s["head.bias"]), dim=-1)


def want_anytouch(s, pixels, sensor):
    s = {k.removeprefix("touch_mae_model."): v for k, v in s.items()}
    e = "touch_model.embeddings."
    patches = conv2d(pixels, s[f"{e}patch_embedding.weight"], None, 14).flatten(2).transpose(1, 2)
    cls = s[f"{e}class_embedding"].repeat(len(patches), 1, 1)
    x = torch.cat([cls, patches], 1) + s[f"{e}position_embedding.weight"]
    tokens = s["sensor_token"][sensor].repeat(len(x), 1, 1)
    x = torch.cat([x[:, :1], tokens, x[:, 1:]], 1)

    def normed(name, y):
        weight, bias = (s[f"touch_model.{name}.{part}"] for part in ("weight", "bias"))
        return layer_norm(y, (WIDTH,), weight, bias, 1e-5)

    x = normed("pre_layrnorm", x)
    x = transformer(x, s, "touch_model.encoder.layers.", 1e-5, HF, fused=False)
    return normalize(normed("post_layernorm", x[:, 0]) @ s["touch_projection.weight"].T, dim=-1)


CASES = [
    ("sparsh", want_sparsh, (6, 320, 240)),
    ("sparsh-mae", want_sparsh, (6, 320, 240)),
    ("tvl", want_tvl, (3, 64, 64)),
    ("anytouch", lambda s, x: want_anytouch(s, x, 1), (3, 56, 56)),
]


@pytest.mark.parametrize(("kind", "want", "shape"), CASES, ids=[c[0] for c in CASES])
def test_the_published_names_give_the_published_features(tmp_path, kind, want, shape):
    path = write(kind, tmp_path)
    state = STATES[kind]()
    module = load_tactile(path)
    pixels = torch.randn(2, *shape, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        made = module.encode(pixels, ["DIGIT 7".lower()] * 2)
        assert torch.allclose(made, want(state, pixels), atol=1e-5)
    height, width, channels = module.preprocess.shape
    assert (channels, height, width) == shape
    assert made.shape == (2, module.dim)


@pytest.mark.parametrize("kind", ["sparsh", "tvl", "anytouch"])
def test_a_missing_further_or_permuted_name_is_refused(tmp_path, kind):
    good = STATES[kind]()
    prefix = {"sparsh": "", "tvl": "tactile_encoder.", "anytouch": "touch_mae_model.touch_model."}
    inside = [k for k in good if k.startswith(prefix[kind])]
    fc1, fc2 = (next(k for k in inside if f"{f}.weight" in k) for f in ("fc1", "fc2"))
    bias = next(k for k in inside if k.endswith(".bias"))
    changes = {
        "Missing key": {bias: None},
        "Unexpected key": {f"{prefix[kind]}blocks_of_others": torch.zeros(3)},
        "other names or shapes": {fc1: good[fc2], fc2: good[fc1]},
    }
    for message, change in changes.items():
        state = {k: v.clone() for k, v in (good | change).items() if v is not None}
        fails(message, load_tactile, write(kind, tmp_path, state))


def drawn(*shape):
    return torch.rand(shape, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize(
    ("kind", "name", "value"),
    [
        ("sparsh", "pos_embed.frequency_bands", drawn(2, 50)),  # one that would be cut
        ("sparsh", "pos_embed.frequency_bands", drawn(32)),  # one that would be spread
        ("sparsh", "pos_embed.frequency_bands", drawn(2, 10)),
        ("sparsh", "register_tokens", drawn(1, 2, WIDTH)),
        ("sparsh", "patch_embed.proj.weight", drawn(WIDTH, 6, 321, 321)),
        ("sparsh", "patch_embed.proj.weight", drawn(WIDTH, 3, 16, 16)),  # of one frame
        ("sparsh", "norm.weight", drawn(200)),
        ("sparsh", "norm.weight", torch.tensor(1.0)),
        ("tvl", "pos_embed", drawn(1, 18, WIDTH)),
        ("tvl", "pos_embed", drawn(1, 0, WIDTH)),
        ("tvl", "patch_embed.proj.weight", drawn(WIDTH, 6, 16, 16)),
        ("tvl", "head.weight", drawn(48, 200)),
        ("anytouch", "sensor_token", drawn(2, 5, WIDTH)),
        ("anytouch", "sensor_token", drawn(10, 1, WIDTH)),
        ("anytouch", "touch_projection.weight", torch.tensor(1.0)),
        ("anytouch", "touch_projection.weight", drawn(48, 200)),
        ("anytouch", "touch_model.embeddings.position_embedding.weight", drawn(0, WIDTH)),
        ("anytouch", "touch_model.encoder.layers.0.mlp.fc1.weight", torch.tensor(1.0)),
    ],
)
def test_what_no_published_file_holds_is_refused_not_cut_or_spread(tmp_path, kind, name, value):
    good = STATES[kind]()
    prefix = {"sparsh": "", "tvl": "tactile_encoder.", "anytouch": "touch_mae_model."}[kind]
    assert prefix + name in good
    with pytest.raises(PalpateError, match="must hold the weights of"):
        load_tactile(write(kind, tmp_path, good | {prefix + name: value}))


def test_pickles_with_code_and_other_files_are_refused(tmp_path):
    torch.save({"model": tvl(), "code": Bomb()}, tmp_path / "code.ckpt")
    save_file({"a": torch.zeros(2)}, tmp_path / "a.safetensors")
    weight, old = torch.zeros(2), tmp_path / "old.pth"
    torch.save({"model": {"a": weight}}, old, _use_new_zipfile_serialization=False)
    data, key = old.read_bytes(), str(weight.untyped_storage()._cdata).encode()
    at = data.rindex(key)
    old.write_bytes(data[:at] + b"0" + data[at + 1 :])
    (tmp_path / "b.safetensors").write_bytes(b"rubbish")
    for name, words in {
        "code.ckpt": r"nothing else\. Got a pickle that holds more than weig",
        "a.safetensors": "recognized by the names of its weights",
        "old.pth": "must hold weights and nothing else",
        "b.safetensors": "must hold weights and nothing else",
    }.items():
        fails(words, load_tactile, tmp_path / name)
    with pytest.raises(PalpateError, match=r"Pass the \.safetensors file of facebook/sparsh"):
        EncoderSet.load(tmp_path / "code.ckpt")


def gradient(width, height, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def test_each_prepares_images_in_its_own_way(tmp_path):
    wide = Image.fromarray(gradient(96, 48))
    pixels = np.asarray(wide)
    made = load_tactile(write("sparsh", tmp_path)).preprocess
    turned = np.rot90(pixels, -1)[16:-16]  # 96 x 48 (h x w), whose center of 4:3 is 64 x 48
    want = Image.fromarray(turned.copy()).resize((240, 320), Image.Resampling.BILINEAR)
    assert np.array_equal(made.prepare(wide), np.concatenate([np.asarray(want)] * 2, axis=2))
    gel, before = Image.fromarray(gradient(96, 48, 1)), Image.fromarray(gradient(96, 48, 2))
    both = made.prepare(wide, gel, before)
    for channels, image in ((both[..., :3], wide), (both[..., 3:], before)):
        minus = (np.asarray(image, float) - np.asarray(gel, float) + 127).clip(0, 255)
        alone = made.prepare(Image.fromarray(minus.astype(np.uint8)))
        assert np.array_equal(channels, alone[..., :3])
    made = load_tactile(write("tvl", tmp_path)).preprocess
    padded = np.zeros((96, 96, 3), np.uint8)
    padded[24:72] = pixels
    want = Image.fromarray(np.rot90(padded).copy()).resize((64, 64), Image.Resampling.BILINEAR)
    assert np.array_equal(made.prepare(wide), np.asarray(want))
    made = load_tactile(write("anytouch", tmp_path)).preprocess
    want = wide.resize((56, 56), Image.Resampling.BILINEAR)
    assert np.array_equal(made.prepare(wide), np.asarray(want))


@pytest.fixture
def digits(small_manifest):
    """The small manifest as of DIGIT sensors, with frames five apart."""
    table = small_manifest.table.with_columns(pl.lit("DIGIT").alias("sensor"), 5 * pl.col("frame"))
    return Manifest(table, small_manifest.root)


def test_frames_backgrounds_and_sensors_come_from_the_manifest(tmp_path, digits):
    encoders = EncoderSet.load(write("sparsh", tmp_path))
    some = digits.take([i for i in digits.ids if i.startswith("v0/")])
    features = embed(some, encoders, cache=tmp_path / "cache").features
    paths, gels = some.paths("tactile"), some.paths("background")
    frames = some.column("frame")
    for k, frame in enumerate(frames):
        before = paths[frames.index(frame - 5)] if frame - 5 in frames else paths[k]
        images = [Image.open(path).convert("RGB") for path in (paths[k], gels[k], before)]
        pixels = encoders.preprocess("tactile").prepare(*images)
        unit = torch.from_numpy(pixels).permute(2, 0, 1)[None] / 255
        with torch.no_grad():
            assert np.allclose(encoders.encode("tactile", unit).numpy(), features[k], atol=1e-5)
    still = embed(some, encoders, cache=tmp_path / "cache", still=True).features
    changed = np.abs(still - features).max(axis=1) > 1e-6
    assert changed.tolist() == [frame - 5 in frames for frame in frames]
    bare = Manifest(some.table.with_columns(background=pl.lit(None, pl.String)), some.root)
    fails("subtracts the no-contact image of DIGIT", embed, bare, encoders)
    other = Manifest(bare.table.with_columns(sensor=pl.lit("GelSight'17")), some.root)
    assert len(embed(other, encoders).features) == len(some)  # these never had one


def test_sensors_of_anytouch(tmp_path, digits):
    path = write("anytouch", tmp_path)
    encoders, fixed = EncoderSet.load(path), EncoderSet.load(f"{path}#mini")
    assert encoders.digest("tactile") != fixed.digest("tactile")
    table, made = digits.table.head(4), {}
    for name in ("DIGIT", "digit-3", "GelSight Mini", "GelSight'17"):
        sensors = Manifest(table.with_columns(sensor=pl.lit(name)), digits.root)
        made[name] = embed(sensors, encoders).features
        made[f"{name}, as Mini"] = embed(sensors, fixed).features
    for name in ("DIGIT", "GelSight'17"):
        assert np.allclose(made[f"{name}, as Mini"], made["GelSight Mini"])
    assert np.allclose(made["DIGIT"], made["digit-3"])
    assert not np.allclose(made["DIGIT"], made["GelSight'17"])
    unknown = Manifest(table.with_columns(sensor=pl.lit(None, pl.String)), digits.root)
    fails("names have one of digit", embed, unknown, encoders)
    with pytest.raises(PalpateError, match=r"checkpoint\.pth#digit"):
        Encoder(encoders, "tactile").encode(digits.paths("tactile")[:1])
    assert Encoder(fixed, "tactile").encode(digits.paths("tactile")[:1]).shape == (1, 48)


def test_they_score_probe_and_are_guarded_by_what_their_authors_name(tmp_path, digits):
    path = str(write("sparsh", tmp_path))
    seen = Manifest(digits.table, digits.root, {"dataset": "Touch and Go"})
    split = by_video(digits, "v0", "v1", "v2")
    with pytest.raises(PalpateError, match="images of Touch and Go, with which its authors"):
        probe(seen, split, encoder=path, top=())
    results = probe(seen, split, encoder=path, top=(), allow_seen=True)
    codes = [n.code for n in results.scores[0].notes]
    assert {"seen-dataset", "encoder-license"} <= {*codes}
    for k, i in enumerate(digits.ids):
        file = tmp_path / "g" / f"{i}.png"
        file.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(gradient(32, 32, k)).save(file)
    own = score(
        digits.root / "v0" / "tactile",
        digits.root / "v0" / "tactile",
        encoder=path,
        companions=[],
        permutations=0,
        normalize=True,
    )
    assert own["TMMD"] is not None
    results = score(tmp_path / "g", digits, encoder=path, companions=[], permutations=0)
    notes = [n for s in results["TMMD"] for n in s.notes if n.code == "encoder-license"]
    assert {(n.params["name"], n.params["license"]) for n in notes} == {("Sparsh", "CC-BY-NC-4.0")}


def test_an_encoder_trains_on_whole_turned_images(tmp_path, digits):
    kind = replace(preset_of("tiny"), fitting="pad", turn="left")
    split = by_video(digits, "v0", "v1", "v2")
    encoders = train_encoder(digits, split, preset=kind, device="cpu", output=tmp_path / "e")
    made = encoders.preprocess("tactile")
    assert (made.fitting, made.turn) == ("pad", "left")
    train = digits.part(split, "train")
    pixels = cached_images(train, "tactile", made)
    for row, path in zip(pixels, train.paths("tactile"), strict=True):
        assert np.array_equal(row, made.prepare(Image.open(path)))
    assert np.allclose(made.mean, pixels.mean(axis=(0, 1, 2)) / 255, atol=1e-5)
    cached = cached_images(train, "tactile", made, tmp_path / "cache")
    assert np.array_equal(cached, pixels)
    again = EncoderSet.load(tmp_path / "e")
    assert again.preprocess("tactile") == made
    assert again.digest("tactile") == encoders.digest("tactile")
    tactile = Encoder(again, "tactile")
    assert tactile.saw(train).all()
    assert not tactile.saw(digits.part(split, "test")).any()
