"""Several processes, and one that is killed: the same images as those of one process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from PIL import Image

from forge.pictures import write_photos
from palpate.diffusion.generated import Generated


@pytest.mark.nightly
@pytest.mark.slow
def test_two_processes_make_the_images_of_one(tmp_path):
    write_photos(folder := tmp_path / "photos", 7, 64)[5].write_text("broken")
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
    write_photos(folder := tmp_path / "photos", 24, 64)
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
