"""Videos and several processes: the same images as one photo at a time in one process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from PIL import Image

from diffusion_fixtures import make_pipeline, photos
from palpate.core import PalpateError
from palpate.diffusion.generation import Generated, generate

av = pytest.importorskip("av")


@pytest.fixture
def clip(tmp_path):
    """Six frames of changing color, without loss."""
    path = tmp_path / "clip.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", 5)
        stream.width = stream.height = 16
        stream.pix_fmt = "bgr0"
        for k in range(6):
            image = np.full((16, 16, 3), 40 * k, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image)))
        container.mux(stream.encode(None))
    return path


def test_a_video_gives_an_image_a_frame_of_one_noise_and_a_video(clip, tmp_path):
    pipeline = make_pipeline()
    made = generate(clip, model=pipeline, output=tmp_path / "out")
    assert made.ids == [f"{k:06d}" for k in range(6)]
    with av.open(str(tmp_path / "out" / "tactile.mp4")) as container:
        stream = container.streams.video[0]
        assert stream.frames == 6
        assert float(stream.average_rate) == pytest.approx(5, rel=0.01)
    # Equal frames give equal images: the noise is one.
    frame = Image.fromarray(np.full((16, 16, 3), 80, np.uint8))
    frame.save(tmp_path / "a.png")
    frame.save(tmp_path / "b.png")
    alone = generate([tmp_path / "a.png", tmp_path / "b.png"], model=pipeline, noise=clip.name)
    first, second = (np.asarray(image, int) for image in alone.images)
    assert np.array_equal(first, second)
    assert np.abs(first - np.asarray(made.images[2], int)).max() <= 1
    # A second run finds all frames.
    assert generate(clip, model=pipeline, output=tmp_path / "out").made == 0


def test_videos_beside_photos_are_not_left_out_in_silence(clip, tmp_path):
    with pytest.raises(PalpateError, match=r"one video by itself.* clip\.mkv"):
        generate([clip, tmp_path / "photo.png"], model=make_pipeline())
    folder = tmp_path / "videos"
    folder.mkdir()
    clip.rename(folder / clip.name)
    with pytest.raises(PalpateError, match="a video is passed by itself"):
        generate(folder, model=make_pipeline())


def test_a_cut_video_is_named(clip, tmp_path):
    (tmp_path / "cut.mkv").write_bytes(clip.read_bytes()[:200])
    with pytest.raises(PalpateError, match=r"cut\.mkv must be whole"):
        generate(tmp_path / "cut.mkv", model=make_pipeline())


@pytest.mark.nightly
@pytest.mark.slow
def test_two_processes_make_the_images_of_one(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for k, image in enumerate(photos(7, 64)):
        Image.fromarray(image).save(folder / f"{k}.png")
    (folder / "5.png").write_text("broken")
    script = tmp_path / "run.py"
    script.write_text(
        "import sys; from palpate.cli import main; from palpate.training.processes import place;"
        "status = main(sys.argv[2:]); assert place()[1] == int(sys.argv[1]); sys.exit(status)"
    )
    command = ["generate", str(folder), "--steps", "2", "--skip-bad", "--batch", "4"]
    launch = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    env = os.environ | {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    for before, size, name in (([], "1", "one"), (launch, "2", "two")):
        done = subprocess.run(
            [sys.executable, *before, str(script), size, *command, "-o", str(tmp_path / name)],
            capture_output=True,
            text=True,
            env=env,
            check=False,
        )
        assert done.returncode == 0, done.stderr
    one, two = (Generated.load(tmp_path / name) for name in ("one", "two"))
    assert one.ids == two.ids == [f"{k}.png" for k in range(7) if k != 5]
    assert [p.where for p in two.skipped] == [p.where for p in one.skipped]
    for name in one.ids:
        a, b = (np.asarray(Image.open(g.path(name)), int) for g in (one, two))
        assert np.abs(a - b).max() <= 1


@pytest.mark.nightly
@pytest.mark.slow
def test_a_killed_run_goes_on_to_the_same_images(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for k, image in enumerate(photos(24, 64)):
        Image.fromarray(image).save(folder / f"{k:02}.png")
    command = [sys.executable, "-m", "palpate", "generate", str(folder), "--batch", "2", "-q"]
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    subprocess.run([*command, "-o", str(whole)], check=True)
    with subprocess.Popen([*command, "-o", str(killed)]) as run:
        while len([*killed.glob("images/*.png")]) < 3:
            assert run.poll() is None
            time.sleep(0.01)
        run.kill()
    assert run.returncode == -signal.SIGKILL
    assert len([*killed.glob("images/[!.]*.png")]) < 24
    subprocess.run([*command, "-o", str(killed)], check=True)
    names = sorted(p.name for p in (whole / "images").iterdir())
    assert names == sorted(p.name for p in (killed / "images").glob("[!.]*"))
    for name in names:
        assert (whole / "images" / name).read_bytes() == (killed / "images" / name).read_bytes()
    assert (whole / "index.json").read_bytes() == (killed / "index.json").read_bytes()
