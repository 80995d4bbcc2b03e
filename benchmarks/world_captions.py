"""How well a world's captions name its materials: a logistic regression on words, on new videos.

    python benchmarks/world_captions.py                          # label captions, then felt ones
    python benchmarks/world_captions.py --objects 40 --seeds 77 78 79

Words and phrases of a caption are its features (layout hct: a bare list); four folds by video.
Captions that are label codes reach 1; chance is one in the number of materials.
"""

import argparse

import numpy as np
from sklearn.feature_extraction.text import CountVectorizer
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import GroupKFold, cross_val_score

from palpate.sim import Video, WorldOptions, plan_world


def accuracy(options):
    """Mean accuracy over four folds by video."""
    texts, materials, videos = [], [], []
    for plan in plan_world(options):
        video = Video(options, plan)
        for contact in range(options.contacts_per_video):
            texts.append(video.text(contact))
            materials.append(plan.object_of(contact).material)
            videos.append(plan.name)
    words = CountVectorizer(tokenizer=lambda t: t.split(", "), token_pattern=None, binary=True)
    model = LogisticRegression(max_iter=500)
    folds = GroupKFold(4)
    return cross_val_score(
        model, words.fit_transform(texts), materials, groups=videos, cv=folds
    ).mean()


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--objects", type=int, default=20, help="objects a material")
    parser.add_argument("--seeds", type=int, nargs="+", default=[77, 78, 79])
    args = parser.parse_args()
    rows = {
        "label, half of them named": {"captions": "label"},
        "label, none named": {"captions": "label", "named": 0.0},
        **{f"felt, describer {d}": {"captions": "felt", "describer": d} for d in (0.0, 0.15, 0.3)},
    }
    for name, choice in rows.items():
        options = {"objects_per_material": args.objects, "contacts_per_video": 3, "layout": "hct"}
        values = [accuracy(WorldOptions(seed=s, **options, **choice)) for s in args.seeds]
        spread = f" +- {np.std(values, ddof=1):.3f} between seeds" if len(values) > 1 else ""
        print(f"{name:<28} {np.mean(values):.3f}{spread}")


if __name__ == "__main__":
    main()
