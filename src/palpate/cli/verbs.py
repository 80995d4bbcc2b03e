"""The verbs of the command, and its exit statuses."""

from __future__ import annotations

from typing import NamedTuple

#: Exit statuses (docs/concepts/recordings.md).
OK, FAILED_CHECK, USER_ERROR, UNKNOWN, BUG, INTERRUPTED = 0, 1, 2, 3, 70, 130


class Verb(NamedTuple):
    """A verb: its module, what it does, an example; whether it needs the extra ``all``."""

    module: str
    help: str
    example: str
    extra: bool = False


VERBS: dict[str, Verb] = {
    "import": Verb(
        "importing",
        "Turn a data set on disk into a manifest",
        "palpate import touch_and_go/ -o tag/",
    ),
    "validate": Verb(
        "validate",
        "List what is missing, invalid or suspicious in a data set",
        "palpate validate touch_and_go/",
    ),
    "background": Verb(
        "background",
        "Propose the gel before each contact as background of samples that have none",
        "palpate background tag/ -o tag_bg/",
    ),
    "caption": Verb(
        "caption",
        "Describe what each touch feels like, by a vision-language model",
        "palpate caption tag/ -o captions/ --server http://localhost:8000/v1",
    ),
    "caption check": Verb(
        "caption_check",
        "Check captions: labels in the text, refusals, words that no finger feels",
        "palpate caption check captions/ --data tag/ --split noleak.json",
    ),
    "audit": Verb(
        "audit",
        "Check whether a train/test split leaks",
        "palpate audit train.txt test.txt --fail-over 0.01",
    ),
    "split": Verb(
        "split",
        "Make a split that does not leak, stratified by material",
        "palpate split tag/ -o noleak.json",
    ),
    "world": Verb(
        "world", "Write the procedural world: a small synthetic data set", "palpate world -o world/"
    ),
    "train encoder": Verb(
        "encoder",
        "Train the tactile encoder against frozen vision and text encoders",
        "palpate train encoder tag/ --split noleak.json -o encoders/",
        extra=True,
    ),
    "train autoencoder": Verb(
        "autoencoder",
        "Train the autoencoder that a generator works in",
        "palpate train autoencoder tag/ --split noleak.json -o autoencoder/",
        extra=True,
    ),
    "train generator": Verb(
        "train",
        "Train a generator of tactile images",
        "palpate train generator tag/ --split noleak.json --clip encoders/ -o model/",
        extra=True,
    ),
    "presets": Verb(
        "presets",
        "List complete configurations of trainings and worlds, or the fields of one",
        "palpate presets mini",
    ),
    "generate": Verb(
        "generate",
        "Make tactile images for photos",
        "palpate generate photo.jpg -o tactile.png",
        extra=True,
    ),
    "embed": Verb(
        "embed",
        "Embed a data set into a folder that scores and probes read, by slices",
        "palpate embed tag/ --encoder palpate/mini -o embedded/ --slice 1/16",
        extra=True,
    ),
    "run": Verb(
        "run",
        "Make all slices of a verb: by processes, Slurm or Ray",
        "palpate run embed tag/ --encoder palpate/mini -o embedded/ --slices 16 --workers 4",
    ),
    "score": Verb(
        "score",
        "Score generated tactile images",
        "palpate score --generated generated/ --reference real/ --encoder palpate/mini",
    ),
    "preference make": Verb(
        "preference_make",
        "Plan a blinded study: whose images do people find closer to the real ones?",
        "palpate preference make --reference real/ --generated ours/ gvst/ -o study/",
    ),
    "view": Verb(
        "view", "Look at a data set or results in a browser, touch a photo", "palpate view tag/"
    ),
    "preference serve": Verb(
        "preference_serve",
        "Serve a study and keep its votes",
        "palpate preference serve study/ --invite 10",
    ),
    "preference score": Verb(
        "preference_score",
        "Score the votes of a study",
        "palpate preference score study/ votes/ -o people.json --latex people.tex",
    ),
    "probe": Verb(
        "probe",
        "Measure how well an encoder's embeddings predict the material",
        "palpate probe tag/ --split noleak.json --encoder encoders/",
        extra=True,
    ),
    "report": Verb(
        "report",
        "Write the page: audit, gallery, scores, settings",
        "palpate report audit.json scores.json -o page.html",
    ),
    "verify": Verb(
        "verify",
        "Make the numbers of a results file again, and compare",
        "palpate verify scores.json",
    ),
    "demo": Verb(
        "demo",
        "Run everything once, from photos to a page",
        "palpate demo --data touch_and_go/",
        extra=True,
    ),
    "reproduce": Verb(
        "reproduce",
        "Run a whole study of the paper: its tables, with controls, from one command",
        "palpate reproduce world-gelsight -o study/ --seeds 0 1 2",
        extra=True,
    ),
}
