"""Best of n: the image most similar to its condition; the encoder that chose it may not score."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from diffusion_fixtures import make_pipeline, photos
from mini_fixtures import make_encoders
from palpate import score
from palpate.cli import main
from palpate.core import PalpateError
from palpate.diffusion.generation import Generated, generate
from palpate.encoders.encoder import Encoder
from palpate.encoders.encoder_set import EncoderSet


@pytest.fixture(scope="module")
def encoders():
    return make_encoders()


@pytest.fixture(scope="module")
def pipeline(encoders):
    return replace(make_pipeline(width=encoders.dim), encoders=EncoderSet(encoders.clip))


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photos")
    for k, image in enumerate(photos(4)):
        Image.fromarray(image).save(folder / f"{k}.png")
    return folder


@pytest.mark.parametrize("text", [None, "a rough wall"])
def test_the_most_similar_of_n_images_is_kept(pipeline, encoders, files, text):
    n, tactile = 4, Encoder(encoders, "tactile")
    made = generate(files, model=pipeline, text=text, weight=0.3, best_of=n, best_by=encoders)
    kept = set()
    for name, image in made.memory.items():
        condition = Encoder(encoders, "vision").encode(files / name)[0]
        if text:
            condition = 0.3 * condition + 0.7 * Encoder(encoders, "text").encode(text)[0]
        ids = [name] + [f"{name}\n{k}" for k in range(1, n)]
        same = dict.fromkeys(ids, files / name)
        some = generate(same, model=pipeline, text=text, weight=0.3).images
        best = int(np.argmax([tactile.encode(one)[0] @ condition for one in some]))
        kept.add(best)
        assert np.abs(np.asarray(some[best], int) - np.asarray(image)).max() <= 1
    assert len(kept) > 1, "else nothing was chosen"


def test_the_choosing_encoder_is_kept_and_may_not_score(pipeline, encoders, files, tmp_path):
    out = tmp_path / "best"
    generate(files, model=pipeline, output=out, best_of=2, best_by=encoders)
    kept = Generated.load(out).settings
    assert (kept["best_of"], kept["chosen_by"]) == (2, encoders.digest("tactile"))
    with pytest.raises(PalpateError, match="another best_of, chosen_by"):
        generate(files, model=pipeline, output=out)
    how = {"permutations": 0, "companions": []}
    with pytest.raises(PalpateError, match="'best', the best of 2 by this encoder"):
        score(out, files, encoder=encoders, **how)
    for encoder, same in ((encoders, True), (make_encoders(3), False)):
        results = score(out, files, encoder=encoder, allow_seen=same, **how)
        notes = [n.params["same"] for s in results for n in s.notes if n.code == "chosen"]
        assert notes
        assert set(notes) == {same}
    plain = tmp_path / "plain"
    generate(files, model=pipeline, output=plain)
    assert "best_of" not in Generated.load(plain).settings
    results = score(plain, files, encoder=encoders, **how)
    assert not [n for s in results for n in s.notes if n.code == "chosen"]


def test_wrong_choosers_are_explained(pipeline, encoders, files, capsys):
    bare = EncoderSet(encoders.clip)
    for options, words in (
        ({"best_of": 0}, "must be at least 1"),
        ({"best_of": 2}, "`best_by` must be given"),
        ({"best_of": 2, "best_by": bare}, "must hold a tactile encoder"),
        ({"best_of": 2, "best_by": make_encoders(5)}, "trained with the generator's vision"),
    ):
        with pytest.raises(PalpateError, match=words):
            generate(files, model=pipeline, **options)
    status = main(["generate", str(files), "-o", "never", "--best-of", "2"])
    assert (status, "--best-by must be given" in capsys.readouterr().err) == (2, True)
