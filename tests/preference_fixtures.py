"""Studies by hand in the public form, as the page and the server get them, and a page on screen."""

import base64
import hashlib
import io

import numpy as np
from PIL import Image

#: What the names of methods are in these studies; they must be nowhere on the page.
METHODS = ("ours-secret", "gvst-secret")
MATERIALS = ("Brick", "Grass", "Wood")


def name_of(*parts):
    """A name that says nothing."""
    return hashlib.sha256("/".join(map(str, parts)).encode()).hexdigest()[:20]


def picture(*parts, side=64):
    """A texture as the page has it."""
    seed = int(name_of(*parts)[:8], 16)
    noise = np.random.default_rng(seed).integers(0, 256, (8, 8, 3), dtype=np.uint8)
    file = io.BytesIO()
    Image.fromarray(noise).resize((side, side), Image.Resampling.BICUBIC).save(file, "jpeg")
    source = f"data:image/jpeg;base64,{base64.b64encode(file.getvalue()).decode()}"
    return {"src": source, "w": side, "h": side}


def pair_study(trials=6, raters=2, **changes):
    """A study of pairs; with the first of :data:`METHODS` on the side that ``ours`` gives.

    Returns:
        The public form, and ``ours``: (rater, trial) -> "left" or "right".
    """
    items = [(k, slot) for k in range(trials) for slot in (*METHODS, "reference")]
    orders, ours = {}, {}
    for r in range(raters):
        code = f"r{r + 1:02}"
        rng = np.random.default_rng(r)
        orders[code] = []
        for k in rng.permutation(trials).tolist():
            swapped = bool(rng.integers(2))
            first, second = METHODS[::-1] if swapped else METHODS
            trial = name_of("trial", k)
            ours[code, trial] = "right" if swapped else "left"
            orders[code].append(
                {
                    "trial": trial,
                    "reference": name_of(k, "reference"),
                    "left": name_of(k, first),
                    "right": name_of(k, second),
                }
            )
    public = {
        "format": "palpate/preference-page@1",
        "study": name_of("study", trials, raters)[:12],
        "task": "pair",
        "title": "Tactile images",
        "question": "Which image is closer to the reference in the pattern of its material?",
        "until": None,
        "images": {name_of(*item): picture(*item) for item in items},
        "raters": orders,
        "choices": ["left", "right", "same"],
    }
    return public | changes, ours


def sort_study(trials=4, raters=1, materials=MATERIALS, **changes):
    """A study of sorting; every strip has three examples."""
    strips = [
        {"answer": m, "label": m, "images": [name_of(m, k) for k in range(3)]} for m in materials
    ]
    images = {name_of(m, k): picture(m, k) for m in materials for k in range(3)}
    images |= {name_of("sorted", k): picture("sorted", k) for k in range(trials)}
    rows = [{"trial": name_of("sort", k), "image": name_of("sorted", k)} for k in range(trials)]
    public, _ = pair_study(1, 1)
    return (
        public
        | {
            "study": name_of("sorting", trials)[:12],
            "task": "sort",
            "question": "Which material is this?",
            "images": images,
            "raters": {f"r{r + 1:02}": rows for r in range(raters)},
            "strips": strips,
            "choices": list(materials),
        }
        | changes
    )
