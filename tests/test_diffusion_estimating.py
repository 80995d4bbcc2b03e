"""What a call of generate will take: counted exactly, timed by a batch with few steps."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from diffusion_fixtures import make_pipeline, photos
from mini_fixtures import write_shipped
from palpate.cli import main
from palpate.core import PalpateError
from palpate.diffusion.estimating import estimate
from palpate.diffusion.generation import generate


@pytest.fixture
def files(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for k, image in enumerate(photos(20)):
        Image.fromarray(image).save(folder / f"{k:02}.png")
    return folder


class Counted:
    """Counts the network evaluations of a pipeline, an image of the batch each."""

    def __init__(self, pipeline):
        self.count, self.forward = 0, pipeline.denoiser.unet.forward
        pipeline.denoiser.unet.forward = self

    def __call__(self, x, *args, **options):
        self.count += len(x)
        return self.forward(x, *args, **options)


@pytest.mark.parametrize("change", [{}, {"guidance": 1.0}, {"low": 0.2, "high": 0.8}])
@pytest.mark.parametrize("method", ["dpm", "ddim"])
def test_evaluations_are_those_of_the_call(files, change, method):
    pipeline = make_pipeline()
    chosen = {"method": method, "steps": 6, "guidance": 2.0, "batch": 10} | change
    pipeline.sampler = replace(pipeline.sampler, **chosen)
    needed = estimate(files, model=pipeline)
    counted = Counted(pipeline)
    generate(files, model=pipeline)
    assert (needed.images, needed.missing, needed.steps) == (20, 20, 6)
    assert needed.evaluations == counted.count
    if not change:  # two passes in every step: the last one of dpm, at t = 0, too
        assert counted.count == 20 * 6 * 2
    assert needed.seconds > 0


def test_nothing_is_written_and_images_that_are_there_cost_nothing(files, tmp_path):
    pipeline, out = make_pipeline(), tmp_path / "out"
    needed = estimate(files, model=pipeline, output=out, steps=2)
    assert not out.exists()
    made = generate(files, model=pipeline, output=out, steps=2)
    size = sum(path.stat().st_size for path in made.paths)
    assert 0.5 * size < needed.bytes < 2 * size
    for k in range(15, 20):
        made.path(f"{k}.png").unlink()
    before = sorted(out.rglob("*"))
    again = estimate(files, model=pipeline, output=out, steps=2)
    assert (again.images, again.missing) == (20, 5)
    assert 4 * again.evaluations == needed.evaluations
    assert sorted(out.rglob("*")) == before
    generate(files, model=pipeline, output=out, steps=2)
    done = estimate(files, model=pipeline, output=out, steps=2)
    assert (done.missing, done.seconds, done.bytes) == (0, 0, 0)
    with pytest.raises(PalpateError, match="another seed"):
        estimate(files, model=pipeline, output=out, steps=2, seed=1)


def test_arrays_are_estimated_too():
    images = np.zeros((3, 16, 16, 3), np.uint8)
    assert estimate(images, model=make_pipeline()).images == 3


def test_the_dry_run_prints_the_estimate(files, tmp_path, monkeypatch, capsys):
    write_shipped(tmp_path / "root", monkeypatch)
    command = ["generate", str(files), "-o", str(tmp_path / "out"), "--dry-run", "--steps", "4"]
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert all(word in printed for word in ("Nothing was written", "network evaluations", "MB"))
    assert main([*command, "--json"]) == 0
    needed = json.loads(capsys.readouterr().out)
    assert (needed["images"], needed["steps"]) == (20, 4)
    assert 80 < needed["evaluations"] <= 160
    assert not (tmp_path / "out").exists()
