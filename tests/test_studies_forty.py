"""Forty items: chosen by seed and id, and honest about what they can tell apart."""

import numpy as np
import pytest

from mini_fixtures import make_encoders
from palpate.metrics import psnr, ssim
from palpate.studies.forty import companions_on_forty, forty_table, seeded_items


def test_forty_items_say_what_they_can_carry():
    rng = np.random.default_rng(0)
    ids, groups = [f"v{k // 5}/{k}" for k in range(400)], [f"v{k // 5}" for k in range(400)]
    base = rng.normal(0.5, 0.1, 400)
    values = {"SSIM": {"Ours": base, "GVST": base - 0.01 + rng.normal(0, 0.1, 400)}}
    table = forty_table(values, ids, groups, better={"SSIM": True})
    rows = seeded_items(ids)
    assert len(rows) == 40
    assert {ids[k] for k in rows} == {ids[::-1][k] for k in seeded_items(ids[::-1])}
    assert float(table.rows[0][2]) == pytest.approx(base[rows].mean())
    assert float(table.rows[0][3]) == pytest.approx(base.mean())
    assert "cannot decide" in table.text
    clear = {"SSIM": {"Ours": base, "GVST": base - 0.2 + rng.normal(0, 0.05, 400)}}
    assert "and decide the 0.2" in forty_table(clear, ids, groups, better={"SSIM": True}).text


def test_images_are_scored_on_forty_and_on_all():
    rng = np.random.default_rng(0)
    real = rng.integers(60, 200, (50, 16, 16, 3)).astype(np.uint8)
    made = {
        name: np.clip(real + noise * rng.normal(size=real.shape), 0, 255).astype(np.uint8)
        for name, noise in (("Ours", 10), ("GVST", 40))
    }
    ids, groups = [str(k) for k in range(50)], [f"v{k // 5}" for k in range(50)]
    table = companions_on_forty(made, real, ids, groups, make_encoders(), name="x")
    cells = {tuple(row[:2]): row[2:] for row in table.rows}
    rows = seeded_items(ids)
    for label, metric in (("SSIM ↑", ssim), ("PSNR ↑", psnr)):
        few, every = cells["GVST", label]
        assert float(few) == pytest.approx(float(metric(made["GVST"][rows], real[rows])))
        assert float(every) == pytest.approx(float(metric(made["GVST"], real)))
        assert few.n == 40
    near, far = (float(cells[n, "patch distance (x vision) ↓"][1]) for n in ("Ours", "GVST"))
    assert 0 < near < far
    assert "SSIM: 40 items" in table.text
    assert len(companions_on_forty(made, real, ids, groups).rows) == 4
